"""Inference from the experiments of a campaign by Bayes' rule from all data.

:class:`ExactLearner` starts from the prior at every step and uses every curve of every experiment
once, so errors of Gaussian approximations do not accumulate.
"""

from dataclasses import asdict, dataclass, field
from typing import Protocol

from imr_torch.assimilate import (
    Assimilation,
    FitOptions,
    SearchOptions,
    assimilate_estimating_noise,
    weigh,
)
from imr_torch.errors import check_at_least
from imr_torch.files import Document, without_nonfinite
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch, Noise
from imr_torch.random import child
from imr_torch.select import Evidence, evidences, update
from imr_torch.simulate import Simulator
from imr_torch.types import Progress


@dataclass(frozen=True)
class Observations:
    """All that a learner may use.

    Args:
        prior: belief before the first experiment.
        batch: all experiments, cut to the window that is assimilated.
        seed: of the campaign.

    >>> import torch
    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import Observations
    >>> from imr_torch.observe import Experiment, ExperimentBatch
    >>> times, radius = torch.tensor([[0.0, 0.5], [1.0, 0.84]], dtype=torch.float64)
    >>> batch, prior = ExperimentBatch((Experiment("shot 1", (400.0, 0.22), times, radius[None]),)), wide_prior(["nhkv"])
    >>> len(Observations(prior, batch=batch, seed=0).batch.experiments)
    1
    """

    prior: Belief
    batch: ExperimentBatch
    seed: int


@dataclass(frozen=True)
class Finding:
    """What a diagnosis says after the experiments of a campaign that looks for the cause of a gap.

    Args:
        verdict: ``"none"``, ``"effect"``, ``"class"``, ``"other"`` or ``"undecided"``.
        causes: names of the effects that the verdict names.
        probabilities: hypothesis -> probability, ``"none"`` and ``"other"`` among them; empty where
            no test rejects the base model.
        reason: one sentence on how the verdict came about.
        converged: whether the fits that the verdict is based on have converged.
        p_value: of the gap test.

    >>> from imr_torch.campaign import Finding
    >>> Finding("effect", ("wall",), {"wall": 0.9, "other": 0.1}, "Adequate.", True, 1e-6).leader
    'wall'
    """

    verdict: str
    causes: tuple[str, ...]
    probabilities: dict[str, float]
    reason: str
    converged: bool
    p_value: float

    @property
    def leader(self) -> str | None:
        """The most probable hypothesis; None where none was fitted."""
        return max(self.probabilities, key=self.probabilities.__getitem__, default=None)


@dataclass(frozen=True)
class Inference:
    """What a learner returns: the belief after the experiments, and what the journal records.

    Args:
        belief: after all experiments.
        evidence: of each model, all experiments together; empty if the method knows none.
        record: what else the journal keeps, JSON-ready.
        assimilation: the fits; None if the method makes none to all experiments.
        noise: of one curve, as the residuals have it; None if the method takes it as planned.
        finding: of a learner that diagnoses a gap.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import Inference
    >>> inference = Inference(wide_prior(["nhkv"]), record={"method": "none"})
    >>> inference.belief.keys, inference.evidence
    (('nhkv',), ())
    """

    belief: Belief
    evidence: tuple[Evidence, ...] = ()
    record: Document = field(default_factory=dict)
    assimilation: Assimilation | None = None
    noise: Noise | None = None
    finding: Finding | None = None


class Learner(Protocol):
    """Infers a belief from experiments; a frozen dataclass.

    >>> from imr_torch.campaign import CampaignSettings, ExactLearner, Learner
    >>> learner: Learner = ExactLearner()
    >>> CampaignSettings(learner=learner).learner == learner
    True
    """

    def infer_belief(
        self, observations: Observations, simulator: Simulator, *, progress: Progress = None
    ) -> Inference:
        """Infer the belief after all experiments; a function of the observations alone."""
        ...


@dataclass(frozen=True)
class ExactLearner:
    """Inference from the original prior and all data at once, with their own likelihood, and
    evidence by importance sampling.

    Args:
        samples: importance samples of each model and round, for evidence and moments.
        options: how gels are fitted, and by which method:
            :class:`imr_torch.assimilate.SearchOptions` or
            :class:`imr_torch.assimilate.En4DVarOptions`.
        noise_rounds: how often the noise is estimated from the residuals of all experiments, as
            measured curves need; with 0 it is as planned.

    >>> from imr_torch.campaign import CampaignSettings, ExactLearner
    >>> settings = CampaignSettings(learner=ExactLearner(samples=128, noise_rounds=1))
    >>> settings.learner.options.starts
    3
    """

    samples: int = 256
    options: FitOptions = field(default_factory=SearchOptions)
    noise_rounds: int = 0

    def __post_init__(self) -> None:
        check_at_least(self, 0, "noise_rounds")

    def infer_belief(
        self, observations: Observations, simulator: Simulator, *, progress: Progress = None
    ) -> Inference:
        """See :class:`Learner`."""
        number = len(observations.batch.experiments)
        result = assimilate_estimating_noise(
            observations.prior,
            observations.batch,
            simulator,
            rounds=self.noise_rounds,
            seed=child(observations.seed, "assimilate", number),
            options=self.options,
            progress=progress,
        )
        result = weigh(
            result,
            simulator,
            seed=child(observations.seed, "weigh", number),
            samples=self.samples,
            progress=progress,
        )
        evidence = evidences(result)
        record = {
            "certificates": {
                fit.model: without_nonfinite(asdict(fit.certificate))[0]
                for fit in result.fits
            },
            "gaussian_answer": {fit.model: fit.trust for fit in result.fits},
        }
        noise = result.batch.noise if self.noise_rounds else None
        return Inference(update(result, evidence), evidence, record, result, noise)
