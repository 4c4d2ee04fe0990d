"""The campaign: ask for a design, tell what was measured, learn, and ask again.

Every step's belief is computed from the prior and *all* experiments so far, each used once, so Gaussian approximations do
not pile up. Everything that is asked, measured or concluded is in the journal before the next thing starts; opening the
folder again continues where it stopped, with the same numbers bit for bit on one machine.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from imr_torch.assimilate import Assimilation, EnsembleOptions, assimilate, weigh
from imr_torch.campaign.journal import Journal
from imr_torch.design import (
    DesignOptimizer,
    DesignSearch,
    DesignSpace,
    Estimator,
    ExpectedInformationGain,
    InformationGain,
    Plan,
    Recommendation,
    search_design,
    tell_gain,
)
from imr_torch.errors import InputDataError
from imr_torch.material import Belief
from imr_torch.observe import Experiment, ExperimentBatch, collapse_time
from imr_torch.random import child
from imr_torch.select import Evidence, evidences, update
from imr_torch.simulate import Simulator
from imr_torch.types import Progress


@dataclass(frozen=True)
class CampaignSettings:
    """How a campaign searches and learns.

    Args:
        space: designs that may be asked for.
        plan: how each experiment will be observed.
        estimator: how the information gain of a design is estimated.
        evaluations: designs evaluated in each search.
        initial: of which space-filling.
        evidence_samples: importance samples of each model and round, for evidence and moments.
        ensemble: how the assimilation searches.
    """

    space: DesignSpace = field(default_factory=DesignSpace)
    plan: Plan = field(default_factory=lambda: Plan(repeats=100))
    estimator: Estimator = field(default_factory=lambda: Estimator(draws=48))
    evaluations: int = 25
    initial: int = 10
    evidence_samples: int = 256
    ensemble: EnsembleOptions = field(default_factory=EnsembleOptions)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values."""
        document = asdict(self)
        document["plan"]["times"] = self.plan.times.tolist()
        return document


@dataclass(frozen=True)
class Proposal:
    """A design to shoot next.

    Args:
        step: number of the experiment, from 1.
        design: ``2`` tensor, (We, R_inf*).
        gain: expected information gain there, nats (posterior mean of the surrogate).
        gain_sd: its standard deviation.
    """

    step: int
    design: Tensor
    gain: float
    gain_sd: float


@dataclass(frozen=True)
class Step:
    """What one experiment taught.

    Args:
        number: from 1.
        belief: after this experiment.
        evidence: evidence of each model, all experiments together.
        assimilation: the fits; None when the step was read back from the journal.
    """

    number: int
    belief: Belief
    evidence: tuple[Evidence, ...]
    assimilation: Assimilation | None = None


class Campaign:
    """A sequence of experiments on one gel.

    Args:
        folder: where the journal is kept. An existing journal of the same campaign is continued.
        prior: belief before the first experiment.
        simulator: makes the bubbles.
        settings: how to search and learn.
        seed: of everything random.
        note: what else identifies the campaign (JSON-ready); checked on resume.

    Raises:
        InputDataError: if the folder holds the journal of another campaign.
    """

    def __init__(
        self,
        folder: str | Path,
        prior: Belief,
        simulator: Simulator,
        *,
        settings: CampaignSettings | None = None,
        seed: int = 0,
        note: dict[str, Any] | None = None,
    ) -> None:
        self.prior, self.simulator, self.seed = prior, simulator, seed
        self.settings = settings or CampaignSettings()
        self.journal = Journal(folder)
        self.experiments: list[Experiment] = []
        self.steps: list[Step] = []
        self._identify(note or {})
        self._replay()

    def _identify(self, note: dict[str, Any]) -> None:
        """Start the journal, or check that it belongs to this campaign."""
        identity = {
            "prior": self.prior.to_dict(),
            "simulator": type(self.simulator).__name__ + " " + repr(self.simulator),
            "settings": self.settings.to_dict(),
            "seed": self.seed,
            "note": note,
        }
        identity = _through_json(identity)
        known = self.journal.find("start")
        if known is None:
            self.journal.append("start", **identity)
            return
        differing = [key for key, value in identity.items() if known.get(key) != value]
        if differing:
            raise InputDataError(
                f"{self.journal.path} is the journal of another campaign: {', '.join(differing)} differ. "
                "Resume with the same arguments, or give another folder."
            )

    def _replay(self) -> None:
        for event in self.journal.events:
            if event["event"] == "experiment":
                self.experiments.append(self.journal.restore(event["record"]))
            elif event["event"] == "belief":
                evidence = tuple(Evidence(**_infinite(entry)) for entry in event["evidence"])
                self.steps.append(Step(event["step"], Belief.from_dict(event["belief"]), evidence))

    @property
    def belief(self) -> Belief:
        """What is thought of the gel now."""
        return self.steps[-1].belief if self.steps else self.prior

    def ask(self, *, progress: Progress | None = None) -> Proposal:
        """The design of largest expected information gain under the present belief.

        A design that was asked before and not yet told is given again without another search.
        """
        number = len(self.experiments) + 1
        known = self.journal.find("ask", number)
        if known is not None:
            design = torch.tensor(known["design"], dtype=torch.float64)
            return Proposal(number, design, known["gain"], known["gain_sd"])
        settings = self.settings
        acquisition = ExpectedInformationGain(
            self.belief, self.simulator, plan=settings.plan, space=settings.space, estimator=settings.estimator
        )
        search = search_design(
            acquisition,
            seed=child(self.seed, "design", number),
            evaluations=settings.evaluations,
            initial=settings.initial,
            progress=progress,
        )
        best = search.recommendation
        gains = [asdict(g) | {"design": d.tolist()} for g, d in zip(search.gains, search.designs, strict=True)]
        self.journal.append("ask", step=number, design=best.design.tolist(), gain=best.mean, gain_sd=best.sd, evaluations=gains)
        return Proposal(number, best.design, best.mean, best.sd)

    def search(self, number: int) -> DesignSearch | None:
        """The search behind the proposal of a step, rebuilt from the journal; None when that step was never asked."""
        known = self.journal.find("ask", number)
        if known is None:
            return None
        rows = [dict(row) for row in known["evaluations"]]
        designs = torch.tensor([row.pop("design") for row in rows], dtype=torch.float64)
        gains = tuple(InformationGain(**row) for row in rows)
        optimizer = DesignOptimizer(self.settings.space, seed=child(self.seed, "design", number), initial=self.settings.initial)
        for design, gain in zip(designs, gains, strict=True):
            tell_gain(optimizer, design, gain)
        best = Recommendation(torch.tensor(known["design"], dtype=torch.float64), known["gain"], known["gain_sd"])
        return DesignSearch(best, designs, gains, optimizer)

    def tell(self, *experiments: Experiment, progress: Progress | None = None) -> Step:
        """Record what was measured, with its achieved design, and update the belief.

        Args:
            experiments: one or more experiments; each curve counts once.
            progress: called with one line per iteration.

        Returns:
            The new belief with evidences and fits.
        """
        if not experiments:
            raise InputDataError("tell needs at least one experiment.")
        for experiment in experiments:
            number = len(self.experiments) + 1
            record = self.journal.store(experiment, f"experiment_{number:03d}")
            self.journal.append("experiment", step=number, record=record)
            self.experiments.append(experiment)
        return self.learn(progress=progress)

    def learn(self, *, progress: Progress | None = None) -> Step:
        """Assimilate all experiments so far and record the belief; what :meth:`tell` does last."""
        number = len(self.experiments)
        batch = ExperimentBatch(tuple(self._window(e) for e in self.experiments), self.settings.plan.noise)
        result = assimilate(
            self.prior,
            batch,
            self.simulator,
            seed=child(self.seed, "assimilate", number),
            options=self.settings.ensemble,
            progress=progress,
        )
        seed = child(self.seed, "weigh", number)
        result = weigh(result, self.simulator, seed=seed, samples=self.settings.evidence_samples)
        evidence = evidences(result)
        belief = update(result, evidence)
        self.journal.append(
            "belief",
            step=number,
            belief=belief.to_dict(),
            evidence=[_finite(asdict(e)) for e in evidence],
            certificates={fit.model: _finite(asdict(fit.certificate)) for fit in result.fits},
            gaussian_answer={fit.model: fit.trust for fit in result.fits},
        )
        self.steps.append(Step(number, belief, evidence, result))
        return self.steps[-1]

    def _window(self, experiment: Experiment) -> Experiment:
        collapses = self.settings.plan.collapses
        if collapses is None:
            return experiment
        return experiment.until(collapse_time(experiment.times, experiment.radius.mean(0), collapses))

    def run(
        self, shoot: Callable[[Tensor, int], Experiment], designs: int, *, progress: Progress | None = None
    ) -> Sequence[Step]:
        """Ask and shoot until ``designs`` experiments are told.

        Args:
            shoot: makes an experiment at a design; second argument is its number.
            designs: experiments in all, those already told included.
            progress: called with one line per step of work.
        """
        if self.experiments and len(self.steps) < len(self.experiments):
            self.learn(progress=progress)  # the last run was cut off between measuring and learning
        while len(self.experiments) < designs:
            proposal = self.ask(progress=progress)
            self.tell(shoot(proposal.design, proposal.step), progress=progress)
        return self.steps


def _through_json(document: Any) -> Any:
    """As it will read when it comes back from the journal."""
    return json.loads(json.dumps(document))


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    return {k: (None if isinstance(v, float) and not math.isfinite(v) else v) for k, v in values.items()}


def _infinite(values: dict[str, Any]) -> dict[str, Any]:
    """Inverse of :func:`_finite`; the one number of an evidence that may be infinite is the shape of its tail."""
    return {k: (math.inf if v is None else v) for k, v in values.items()}
