"""Campaigns about the population that the gels of several shots are from: its median, and the
scatter between shots.

:class:`PopulationLearner` fits every shot by itself and infers the population from all
(:mod:`imr_torch.population`); the belief of the campaign is that of the population's median.
:class:`LearnPopulation` shoots where one more shot tells most of median and scatter. Repeats within
an experiment are taken to be of the same gel.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch

from imr_torch.campaign.learners import Inference, Observations
from imr_torch.campaign.policies import Optimal, Proposal, Situation
from imr_torch.design import PopulationInformation
from imr_torch.errors import InputDataError
from imr_torch.files import without_nonfinite
from imr_torch.float64 import arange
from imr_torch.material import Belief, ModelBelief
from imr_torch.material.belief import even_belief
from imr_torch.observe import Experiment, ExperimentBatch
from imr_torch.population import (
    SCALE,
    GaussianShots,
    ShotLikelihood,
    coordinate_units,
    fit_shots,
    infer_population,
)
from imr_torch.population.closed_form import grid_scatters
from imr_torch.population.sampling import Problem, sample_population
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Controls, Progress


@dataclass(frozen=True)
class PopulationLearner:
    """Fits every shot by itself, and infers the population that their gels are from; for one
    constitutive model.

    Args:
        samples: draws of the posterior of each shot.
        noise_rounds: how often the noise is estimated from the residuals of all shots, as measured
            curves need; with 0 it is as planned.
        first_draws: draws of the population after the first shot.

    >>> from imr_torch.campaign import PopulationLearner
    >>> PopulationLearner(noise_rounds=1).samples
    256
    """

    samples: int = 256
    noise_rounds: int = 0
    first_draws: int = 4000

    def __post_init__(self) -> None:
        if self.noise_rounds < 0:
            raise InputDataError(
                f"PopulationLearner.noise_rounds is {self.noise_rounds}; expected 0 or more."
            )

    def check_batch(self, batch: ExperimentBatch) -> None:
        """Raise for shots of collapse times alone; see :class:`imr_torch.campaign.Learner`."""
        if len(batch.curves) < len(batch.experiments):
            raise InputDataError(
                "PopulationLearner learns from curves; leave shots of collapse times out."
            )

    def infer_belief(
        self, observations: Observations, simulator: Simulator, *, progress: Progress = None
    ) -> Inference:
        """See :class:`imr_torch.campaign.Learner`.

        Raises:
            InputDataError: if the prior holds several models.
        """
        part = _only_model(observations.prior)
        batch = observations.batch
        own = child(observations.seed, "population", len(batch.experiments))
        fits = fit_shots(
            part,
            _named_apart(batch.curves),
            simulator,
            noise=batch.noise,
            rounds=self.noise_rounds,
            samples=self.samples,
            seed=own,
            progress=progress,
        )
        problem = Problem(tuple(map(ShotLikelihood.of, fits)), part, scatter_scales(part))
        noise = fits[0].batch.noise
        population = None
        if len(fits) > 1:
            found = infer_population(fits, scale=SCALE, seed=own)
            drawn = found.found
            population = without_nonfinite(found.to_dict())[0]
        else:
            source = generator(child(own, "first shot"))
            drawn = sample_population(problem, self.first_draws, source)
        mean = drawn.weights @ drawn.centre
        away = drawn.weights.sqrt()[:, None] * (drawn.centre - mean)
        median = part.with_gaussian(mean, torch.linalg.cholesky(away.mT @ away))
        return Inference(
            even_belief((median,)),
            noise=noise if self.noise_rounds else None,
            population=population,
            shots=problem.gaussian,
        )


def scatter_scales(prior: ModelBelief) -> Controls:
    """``d`` tensor, scale of the half-normal prior of each control's scatter.

    0 for what is inferred of the medium.
    """
    varying = torch.tensor([name in prior.of_gel for name in prior.names])
    return torch.where(varying, SCALE / coordinate_units(prior), 0.0)


@dataclass(frozen=True)
class LearnPopulation:
    """Shoots where one more shot, of a gel of its own, tells most of the population's median and
    scatter.

    Args:
        search: how the design is searched for; its estimator is not used.

    >>> from imr_torch.campaign import LearnPopulation
    >>> LearnPopulation().search.evaluations
    25
    """

    search: Optimal = field(default_factory=Optimal)

    def choose_design(self, situation: Situation, *, progress: Progress = None) -> Proposal:
        """See :class:`imr_torch.campaign.DesignPolicy`.

        Raises:
            InputDataError: if the prior holds several models.
        """
        prior = _only_model(situation.prior or situation.belief)
        if situation.shots is None and situation.batch is not None:
            raise InputDataError(
                "LearnPopulation needs the likelihood of each shot, which the learner of this "
                "campaign does not give; take PopulationLearner."
            )
        shots = situation.shots or GaussianShots.none(len(prior.names))
        estimator = information_about(shots, prior)
        found = replace(self.search, estimator=estimator).choose_design(
            situation, progress=progress
        )
        reason = (
            f"A shot that showed its gel without error would tell {estimator.largest_gain():.2f} "
            "nats of median and scatter."
        )
        return replace(found, reason=reason)


def information_about(
    shots: GaussianShots, prior: ModelBelief, *, scatters: int = 64
) -> PopulationInformation:
    """The information about a population after some shots, by the Gaussian parts of their
    likelihoods.

    Args:
        shots: none before the first.
        prior: of the population's median.
        scatters: that the gain is averaged over.
    """
    grid = grid_scatters(shots, prior, scatter_scales(prior))
    levels = (arange(scatters) + 0.5) / scatters
    scatter = grid.middle[
        torch.searchsorted(grid.weights.cumsum(0), levels).clamp_max(len(grid.middle) - 1)
    ]
    given = shots.given(scatter, prior.mean, prior.precision)
    return PopulationInformation(
        scatter, given.centre, torch.linalg.cholesky(torch.cholesky_inverse(given.chol))
    )


def _named_apart(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Shots with labels that differ."""
    seen = Counter[str]()
    named = []
    for experiment in experiments:
        seen[experiment.label] += 1
        count = seen[experiment.label]
        named.append(
            experiment if count == 1 else replace(experiment, label=f"{experiment.label} ({count})")
        )
    return named


def _only_model(prior: Belief) -> ModelBelief:
    """The only model of a prior."""
    if len(prior.models) != 1:
        raise InputDataError(
            f"A campaign about a population has one model, and its prior holds {len(prior.models)} "
            f"({', '.join(prior.keys)}); name one."
        )
    return prior.models[0]
