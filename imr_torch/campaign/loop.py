"""Campaigns: repeated choice of a design, measurement and inference, resumable from a journal.

What to shoot is a policy's choice (:mod:`~imr_torch.campaign.policies`), what is learnt a learner's
(:mod:`~imr_torch.campaign.learners`), and when to end a rule's (:mod:`~imr_torch.campaign.stopping`). Everything that is
asked, measured or concluded is in the journal before the next thing starts; opening the folder again continues where it
stopped, with the same numbers bit for bit on one machine.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from imr_torch.assimilate import Assimilation
from imr_torch.campaign.journal import Journal, differing
from imr_torch.campaign.learners import ExactLearner, Learner, Observations, PaperLearner, finite
from imr_torch.campaign.policies import PAPER_OPTIMAL, DesignPolicy, Optimal, Proposal, Situation
from imr_torch.campaign.stopping import Standing, StoppingRule
from imr_torch.design import DesignSearch, DesignSpace, Plan
from imr_torch.errors import InputDataError
from imr_torch.material import Belief
from imr_torch.observe import Experiment, ExperimentBatch, Noise, collapse_time
from imr_torch.select import Evidence
from imr_torch.simulate import Simulator
from imr_torch.types import Progress


@dataclass(frozen=True)
class CampaignSettings:
    """How a campaign chooses, learns and ends.

    Args:
        space: designs that may be asked for.
        plan: how each experiment will be observed.
        policy: chooses designs.
        learner: turns experiments into a belief.
        stop: ends the campaign; None to go on as long as :meth:`Campaign.run` is asked to.

    >>> from imr_torch.campaign import CampaignSettings, Designs, SpaceFilling
    >>> settings = CampaignSettings(policy=SpaceFilling(), stop=Designs(5))
    >>> settings.to_dict()["stop"]
    {'kind': 'Designs', 'count': 5}
    """

    space: DesignSpace = field(default_factory=DesignSpace)
    plan: Plan = field(default_factory=lambda: Plan(repeats=100))
    policy: DesignPolicy = field(default_factory=Optimal)
    learner: Learner = field(default_factory=ExactLearner)
    stop: StoppingRule | None = None

    @classmethod
    def paper(cls) -> "CampaignSettings":
        """Everything as in arXiv 2409.00011, defects included: its search, assimilation and model probability."""
        return cls(policy=PAPER_OPTIMAL, learner=PaperLearner())

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values, with the kind of every part."""
        return _described(self)


def _described(value: Any) -> Any:
    """A dataclass and what it is made of as JSON-ready values."""
    if is_dataclass(value):
        return {"kind": type(value).__name__} | {f.name: _described(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, tuple):
        return [_described(part) for part in value]
    return value.tolist() if isinstance(value, Tensor) else value


@dataclass(frozen=True)
class Step:
    """The state after one experiment: belief, evidence and fits.

    Args:
        number: from 1.
        belief: after this experiment.
        evidence: evidence of each model, all experiments together; empty if the learner knows none.
        assimilation: the fits; None when the step was read back from the journal, or the learner makes none.
        noise: of one curve, if the learner estimates it.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import Step
    >>> step = Step(1, wide_prior(["nhkv"]), evidence=())
    >>> step.number, step.belief.keys
    (1, ('nhkv',))
    """

    number: int
    belief: Belief
    evidence: tuple[Evidence, ...]
    assimilation: Assimilation | None = None
    noise: Noise | None = None


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

    >>> import tempfile
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions
    >>> from imr_torch.campaign import Campaign, CampaignSettings, ExactLearner, Fixed
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> learner = ExactLearner(64, SearchOptions(scouts=16, starts=2))
    >>> settings = CampaignSettings(policy=Fixed(((400.0, 0.22),)), learner=learner)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     campaign = Campaign(folder, case.prior, simulator, settings=settings, seed=0)
    ...     step = campaign.tell(laboratory.shoot(campaign.ask().design, seed=0))
    >>> step.number, campaign.belief.best.model
    (1, 'nhkv')
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
        known = {key: value for key, value in known.items() if key != "event"}
        if names := differing(known, identity):
            raise InputDataError(
                f"{self.journal.path} is the journal of another campaign: {', '.join(names)} differ. Resume with the same "
                "arguments; if another version of imr_torch began it, tell its curves to a campaign in a new folder."
            )

    def _replay(self) -> None:
        for event in self.journal.events:
            if event["event"] == "experiment":
                self.experiments.append(self.journal.restore(event["record"]))
            elif event["event"] == "belief":
                evidence = tuple(Evidence(**_infinite(entry)) for entry in event["evidence"])
                noise = Noise(**event["noise"]) if event.get("noise") else None
                self.steps.append(Step(event["step"], Belief.from_dict(event["belief"]), evidence, noise=noise))

    @property
    def belief(self) -> Belief:
        """The present belief."""
        return self.steps[-1].belief if self.steps else self.prior

    @property
    def plan(self) -> Plan:
        """How the next experiment will be observed: as the settings say, with the noise that was learnt so far."""
        noise = self.steps[-1].noise if self.steps else None
        return replace(self.settings.plan, noise=noise) if noise else self.settings.plan

    @property
    def _learnt(self) -> int:
        """Number of experiments that the present belief includes."""
        return self.steps[-1].number if self.steps else 0

    def reason_to_stop(self, proposal: Proposal | None = None) -> str | None:
        """Why the campaign should end, by what was told so far and, if given, what is proposed; None where it should not."""
        rule, gain = self.settings.stop, proposal.gain if proposal else None
        return rule.reason(Standing(self.belief, tuple(self.experiments), gain)) if rule else None

    def ask(self, *, progress: Progress | None = None) -> Proposal:
        """The design that the policy chooses under the present belief.

        A design that was asked before and not yet told is given again without another search.
        """
        return self.ask_several(1, progress=progress)[0]

    def ask_several(self, q: int, *, progress: Progress | None = None) -> tuple[Proposal, ...]:
        """Designs to prepare together: each chosen with those before it pending, all under the present belief.

        Args:
            q: how many; those asked before and not yet told count.
            progress: called with one line per evaluation.

        Returns:
            ``q`` proposals; the gain of each is what it adds to those before.
        """
        if q < 1:
            raise InputDataError(f"q is {q}; expected at least 1.")
        proposals: list[Proposal] = []
        for number in range(len(self.experiments) + 1, len(self.experiments) + 1 + q):
            pending = torch.stack([p.design for p in proposals]) if proposals else None
            proposals.append(self._propose(number, pending, progress))
        return tuple(proposals)

    def _propose(self, number: int, pending: Tensor | None, progress: Progress | None) -> Proposal:
        """The proposal of one step, from the journal if it was made before."""
        known = self.journal.find("ask", number)
        if known is not None:
            design = torch.tensor(known["design"], dtype=torch.float64)
            return Proposal(number, design, known["gain"], known["gain_sd"])
        settings = self.settings
        situation = Situation(number, self.belief, self.simulator, settings.space, self.plan, self.seed, pending)
        found = settings.policy.choose(situation, progress=progress)
        search = found.search
        tried = zip(search.gains, search.designs, strict=True) if search else ()
        self.journal.append(
            "ask",
            step=number,
            design=found.design.tolist(),
            gain=found.gain,
            gain_sd=found.gain_sd,
            pending=finite(asdict(search.pending)) if search and search.pending else None,
            evaluations=[finite(asdict(gain)) | {"design": design.tolist()} for gain, design in tried],
        )
        return found

    def search(self, number: int) -> DesignSearch | None:
        """The search behind the proposal of a step, rebuilt from the journal; None where there was none."""
        known = self.journal.find("ask", number)
        return None if known is None else self.settings.policy.rebuild(known, self.settings.space, self.seed)

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
        """Learn from all experiments so far and record the belief; what :meth:`tell` does last."""
        number, settings = len(self.experiments), self.settings
        batch = ExperimentBatch(tuple(self._window(e) for e in self.experiments), settings.plan.noise)
        inference = settings.learner.learn(
            Observations(self.prior, self.belief, batch, number - self._learnt, self.seed), self.simulator, progress=progress
        )
        self.journal.append(
            "belief",
            step=number,
            belief=inference.belief.to_dict(),
            evidence=[finite(asdict(e)) for e in inference.evidence],
            noise=vars(inference.noise) if inference.noise else None,
            **inference.record,
        )
        self.steps.append(Step(number, inference.belief, inference.evidence, inference.assimilation, inference.noise))
        return self.steps[-1]

    def _window(self, experiment: Experiment) -> Experiment:
        collapses = self.settings.plan.collapses
        if collapses is None:
            return experiment
        return experiment.until(collapse_time(experiment.times, experiment.mean, collapses))

    def run(
        self,
        shoot: Callable[[Tensor, int], Experiment],
        designs: int,
        *,
        q: int = 1,
        progress: Progress | None = None,
    ) -> Sequence[Step]:
        """Ask and shoot until ``designs`` experiments are told, or the stopping rule has a reason to end.

        Args:
            shoot: makes an experiment at a design; second argument is its number.
            designs: experiments in all, those already told included; it may be raised when a campaign is resumed.
            q: experiments that are chosen together, shot and then learnt from at once; the stopping rule looks at the belief
                before each such set.
            progress: called with one line per step of work.
        """
        if len(self.experiments) > self._learnt:  # the last run was cut off between measuring and learning
            self._complete(shoot, designs, progress)
        while len(self.experiments) < designs:
            if reason := self.reason_to_stop():
                return self._end(reason, progress)
            proposals = self.ask_several(min(q, designs - len(self.experiments)), progress=progress)
            if reason := self.reason_to_stop(proposals[0]):
                return self._end(reason, progress)
            worth = takewhile(lambda proposal: not self.reason_to_stop(proposal), proposals)
            self.tell(*[shoot(proposal.design, proposal.step) for proposal in worth], progress=progress)
        return self.steps

    def _complete(self, shoot: Callable[[Tensor, int], Experiment], designs: int, progress: Progress | None) -> None:
        """Shoot what was asked together with the last experiments and not told, and learn from all of them."""
        asked = takewhile(lambda number: self.journal.find("ask", number), range(len(self.experiments) + 1, designs + 1))
        proposals = [self._propose(number, None, progress) for number in asked]
        worth = list(takewhile(lambda proposal: not self.reason_to_stop(proposal), proposals))
        if worth:
            self.tell(*[shoot(proposal.design, proposal.step) for proposal in worth], progress=progress)
        else:
            self.learn(progress=progress)

    def _end(self, reason: str, progress: Progress | None) -> Sequence[Step]:
        """Write down why the campaign is over, once."""
        number = len(self.experiments)
        if self.journal.find("stop", number) is None:
            self.journal.append("stop", step=number, reason=reason)
        if progress:
            progress(f"stopped: {reason}")
        return self.steps


def _through_json(document: Any) -> Any:
    """As it will read when it comes back from the journal."""
    return json.loads(json.dumps(document))


def _infinite(values: dict[str, Any]) -> dict[str, Any]:
    """Inverse of :func:`finite`; the one number of an evidence that may be infinite is the shape of its tail."""
    return {k: (math.inf if v is None else v) for k, v in values.items()}
