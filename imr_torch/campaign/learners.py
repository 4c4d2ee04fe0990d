"""Inference from the experiments of a campaign: by Bayes' rule from all data, or by the published
method.

:class:`ExactLearner` starts from the prior at every step and uses every curve of every experiment
once, so errors of Gaussian approximations do not accumulate. :class:`PaperLearner` is the method of
arXiv 2409.00011, kept to compare with: it assimilates one design at a time with a tempered misfit,
multiplies the result into the belief it started from, and averages model probabilities over
designs.
"""

from dataclasses import asdict, dataclass, field
from typing import Protocol

import torch

from imr_torch.assimilate import (
    Assimilation,
    FitOptions,
    PublishedOptions,
    SearchOptions,
    assimilate_estimating_noise,
    assimilate_published,
    published_probabilities,
    weigh,
)
from imr_torch.errors import InputDataError
from imr_torch.files import Document, without_nonfinite
from imr_torch.material import Belief, ModelBelief
from imr_torch.observe import ExperimentBatch, Noise
from imr_torch.random import child
from imr_torch.select import Evidence, evidences, update
from imr_torch.simulate import Simulator
from imr_torch.types import Progress


@dataclass(frozen=True)
class Observations:
    """All that a learner may use: prior, present belief and experiments.

    Args:
        prior: belief before the first experiment.
        belief: belief before the last ``fresh`` of them.
        batch: all experiments, cut to the window that is assimilated.
        fresh: how many were told since ``belief``.
        seed: of the campaign.

    >>> import torch
    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import Observations
    >>> from imr_torch.observe import Experiment, ExperimentBatch
    >>> times, radius = torch.tensor([[0.0, 0.5], [1.0, 0.84]], dtype=torch.float64)
    >>> batch, prior = ExperimentBatch((Experiment("shot 1", (400.0, 0.22), times, radius[None]),)), wide_prior(["nhkv"])
    >>> Observations(prior, belief=prior, batch=batch, fresh=1, seed=0).fresh
    1
    """

    prior: Belief
    belief: Belief
    batch: ExperimentBatch
    fresh: int
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

    def check_batch(self, batch: ExperimentBatch) -> None:
        """Raise :class:`InputDataError` for experiments that the method cannot take.

        Called before they are recorded.
        """
        ...

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
        if self.noise_rounds < 0:
            raise InputDataError(
                f"ExactLearner.noise_rounds is {self.noise_rounds}; expected 0 or more."
            )

    def check_batch(self, batch: ExperimentBatch) -> None:
        """See :class:`Learner`; all are taken."""

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
            result, simulator, seed=child(observations.seed, "weigh", number), samples=self.samples
        )
        evidence = evidences(result)
        record = {
            "certificates": {
                fit.model: without_nonfinite(asdict(fit.certificate))[0] for fit in result.fits
            },
            "gaussian_answer": {fit.model: fit.trust for fit in result.fits},
        }
        noise = result.batch.noise if self.noise_rounds else None
        return Inference(update(result, evidence), evidence, record, result, noise)


@dataclass(frozen=True)
class PaperLearner:
    """The method of arXiv 2409.00011, defects included.

    Args:
        options: sizes of the assimilation.

    >>> from imr_torch.assimilate import PublishedOptions
    >>> from imr_torch.campaign import PaperLearner
    >>> PaperLearner(PublishedOptions(members=24)).options.members
    24
    """

    options: PublishedOptions = field(default_factory=PublishedOptions)

    def check_batch(self, batch: ExperimentBatch) -> None:
        """Raise if the design or the clock of an experiment is uncertain, which the method cannot
        express.
        """
        if bool((batch.nuisance_sds > 0.0).any()):
            raise InputDataError(
                "PaperLearner takes designs and clocks as exact; give experiments without "
                "nuisances."
            )
        if len(batch.curves) < len(batch.experiments):
            raise InputDataError(
                "PaperLearner learns from curves; leave shots of collapse times out."
            )

    def infer_belief(
        self, observations: Observations, simulator: Simulator, *, progress: Progress = None
    ) -> Inference:
        """See :class:`Learner`. Raises as :meth:`check_batch` does."""
        batch = observations.batch
        belief = observations.belief
        record = {}
        self.check_batch(batch)
        count = len(batch.experiments)
        for number in range(count - observations.fresh + 1, count + 1):
            experiment = batch.curves[number - 1]
            fits = assimilate_published(
                belief,
                experiment,
                batch.noise,
                simulator,
                seed=child(observations.seed, "assimilate", number),
                options=self.options,
                progress=progress,
            )
            here = published_probabilities(fits)
            so_far = belief.log_probabilities.exp() if number > 1 else torch.zeros_like(here)
            parts = tuple(multiply_gaussians(fit.prior, fit.posterior) for fit in fits)
            belief = Belief(parts, ((so_far * (number - 1) + here) / number).log())
            record = {
                "probabilities_of_this_design": dict(zip(belief.keys, here.tolist(), strict=True))
            }
        return Inference(belief, record=record)


def multiply_gaussians(first: ModelBelief, second: ModelBelief) -> ModelBelief:
    """The normalised product of the Gaussians of two beliefs that share their maps."""
    covariance = torch.linalg.inv(first.precision + second.precision)
    mean = covariance @ (first.precision @ first.mean + second.precision @ second.mean)
    return first.with_gaussian(mean, torch.linalg.cholesky(0.5 * (covariance + covariance.mT)))
