"""Importance sampling of a posterior: one set of draws gives evidence, moments and a diagnosis of
their reliability.

Draws ``v`` of a heavy-tailed proposal (:mod:`imr_torch.assimilate.proposals`) are weighted by the
exact posterior; the tail of the weights is smoothed by a generalised Pareto distribution, whose
shape ``k`` says whether the mean of the weights can be estimated (Vehtari, Simpson, Gelman, Yao &
Gabry, JMLR 25(72), 2024).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import MultivariateNormal, kl_divergence

from imr_torch.assimilate.noise_law import NoiseNodes
from imr_torch.float64 import arange, rand
from imr_torch.observe import Noise
from imr_torch.types import ControlMatrix, Controls, DrawnControls, DrawnValues


def effective_size(weights: DrawnValues) -> Float[Tensor, ""]:
    """Effective sample size of weights of any scale (Kish 1965), a 0-d tensor."""
    return weights.sum().square() / weights.square().sum()


def smooth_tail(
    log_weights: DrawnValues, *, shortest: int = 5
) -> tuple[DrawnValues, float]:
    """Pareto-smoothed log weights on the scale of the given ones, and the shape ``k`` of their
    tail.

    Args:
        log_weights: ``-inf`` for draws that count for nothing.
        shortest: weights in the tail, a fifth of all, to which a generalised Pareto distribution
            can be fitted.

    Returns:
        The smoothed weights, and ``k``: infinite where too few weights count for a tail to be
        fitted.
    """
    # here: where xarray is installed too, it takes a second to import
    from arviz_stats.base.array import (
        array_stats,
    )

    possible = log_weights.isfinite().nonzero()[:, 0]
    some = log_weights[possible]
    if len(some) < 5 * shortest:
        return log_weights, math.inf
    if some.amax() - some.amin() < 1e-9:
        return log_weights, 0.0
    # what is smaller is nothing beside the largest, and would underflow in the fit
    floor = some.amax() - 600.0
    with np.errstate(
        all="ignore"
    ):  # a tail that underflows gives NaN, which is dealt with below
        smoothed, shape = array_stats.psislw(-some.clamp_min(floor).numpy())
    least = int(some.argmin())
    # undo its normalisation
    values = torch.as_tensor(smoothed) - smoothed[least] + some[least].clamp_min(floor)
    shape = float(shape)
    if not math.isfinite(shape) or not values.isfinite().all():
        return log_weights, math.inf
    return log_weights.index_copy(0, possible, values), shape


def largest_shape(count: int) -> float:
    """The ``k`` up to which ``count`` weights give estimates with an error to be believed (Vehtari
    et al. 2024, 3.2).
    """
    return min(1.0 - 1.0 / math.log10(max(count, 2)), 0.7)


def are_reliable(pareto_k: float, effective_samples: float, samples: int) -> bool:
    """Whether estimates from weighted draws are reliable: a light tail, and twenty effective
    samples or a tenth of all.
    """
    return pareto_k <= largest_shape(samples) and effective_samples >= max(
        20.0, 0.1 * samples
    )


def weighted_quantiles(
    values: DrawnValues, weights: DrawnValues, levels: Float[Tensor, "levels"]
) -> Float[Tensor, "levels"]:
    """Quantiles of weighted draws, interpolated between them.

    >>> import torch
    >>> from imr_torch.assimilate.importance import weighted_quantiles
    >>> values, weights = torch.tensor([[3.0, 1.0, 2.0], [0.25, 0.25, 0.5]], dtype=torch.float64)
    >>> weighted_quantiles(values, weights, torch.tensor([0.5], dtype=torch.float64)).tolist()
    [2.0]
    """
    order = values.argsort()
    below = weights[order].cumsum(0) - 0.5 * weights[order]
    return torch.from_numpy(np.interp(levels.numpy(), below.numpy(), values[order].numpy()))


def weighted_moments(
    points: DrawnControls, weights: DrawnValues
) -> tuple[Controls, ControlMatrix]:
    """Mean and covariance of weighted draws.

    >>> import torch
    >>> from imr_torch.assimilate.importance import weighted_moments
    >>> mean, covariance = weighted_moments(torch.tensor([[0.0], [4.0]]), torch.tensor([0.75, 0.25]))
    >>> float(mean), float(covariance)
    (1.0, 3.0)
    """
    mean = weights @ points
    deviation = points - mean
    return mean, (weights[:, None] * deviation).mT @ deviation


@dataclass(frozen=True)
class NoiseSample:
    """Weighted draws under each of the noise laws over which they are integrated.

    Args:
        nodes: ``M`` laws with their weights.
        by_experiment: log likelihood of each experiment under each law, its nuisances integrated
            out.
        drawn: one law of each draw, from its conditional posterior.
    """

    nodes: NoiseNodes
    by_experiment: Float[Tensor, "draws laws experiments"]
    drawn: Int[Tensor, "draws"]

    @cached_property
    def log_likelihood(self) -> DrawnValues:
        """Log likelihood of all experiments, the noise integrated over its prior."""
        return torch.logsumexp(
            self.by_experiment.sum(2) + self.nodes.log_prior.flatten(), 1
        )


class SmoothedWeights:
    """What the weights of draws say once their tail is smoothed; a base class."""

    @cached_property
    def _smoothed_tail(self) -> tuple[Tensor, float]:
        """Log weights whose tail is smoothed, and its shape."""
        raise NotImplementedError

    @property
    def pareto_k(self) -> float:
        """Shape of the tail of the weights."""
        return self._smoothed_tail[1]

    @cached_property
    def weights(self) -> DrawnValues:
        """``n`` tensor of normalised, smoothed weights."""
        return torch.softmax(self._smoothed_tail[0], dim=0)

    @property
    def effective_samples(self) -> float:
        """Kish effective sample size of the smoothed weights."""
        return float(effective_size(self.weights))


@dataclass(frozen=True)
class ImportanceSample(SmoothedWeights):
    """Weighted draws of one model's posterior.

    Args:
        controls: draws of the gel's controls ``v``.
        log_prior: log density of ``v`` under the prior, a standard normal.
        by_experiment: log likelihood of each experiment given ``v``, its nuisances integrated out
            (without bias before the logarithm); ``-inf`` where a solve failed. Of the noise that
            the fit was made with.
        log_proposal: log density of the proposal.
        nuisances: one draw of the nuisances given ``v`` and the data for each draw.
        centre: mean of ``v`` that the proposal was made for.
        spread: Cholesky factor of the covariance that it was made for.
        behind: effective draws that these two rest on; infinite where on none.
        first_shape: ``k`` of the first round, whose proposal is the Gaussian with heavier tails.
        rounds: how many rounds of draws were made; these are of the last one, and its proposal does
            not depend on them.
        precisions: of the posterior about each draw; None where not known.
        noise: the draws under other noise laws, over which weights and all that follows are
            integrated; None where the noise is taken as known.

    >>> import torch
    >>> from imr_torch.assimilate import ImportanceSample
    >>> from imr_torch.random import generator
    >>> prior, zero, one = torch.distributions.Normal(0.0, 1.0), torch.zeros(1), torch.eye(1)
    >>> v = torch.randn(200, 1, generator=generator(0), dtype=torch.float64)  # draws of the prior are the proposal
    >>> likelihood = torch.distributions.Normal(1.0, 1.0).log_prob(v)  # a datum of 1 with unit noise: posterior mean 1/2
    >>> nuisances, density = torch.zeros(200, 1, 3), prior.log_prob(v)[:, 0]
    >>> sample = ImportanceSample(v, density, likelihood, density, nuisances, zero, one, first_shape=0.0, rounds=1)
    >>> sample.reliable, round(float(sample.mean), 1), round(sample.log_evidence, 1)
    (True, 0.5, -1.5)
    """

    controls: DrawnControls
    log_prior: DrawnValues
    by_experiment: Float[Tensor, "draws experiments"]
    log_proposal: DrawnValues
    nuisances: Float[Tensor, "draws experiments 3"]
    centre: Controls
    spread: ControlMatrix
    first_shape: float
    rounds: int
    behind: float = math.inf
    precisions: Float[Tensor, "draws controls controls"] | None = None
    noise: NoiseSample | None = None

    def __len__(self) -> int:
        return len(self.controls)

    @property
    def log_likelihood(self) -> DrawnValues:
        """``n`` tensor, of all experiments.

        Nuisances are integrated out, and the noise where it is uncertain.
        """
        return (
            self.by_experiment.sum(1) if self.noise is None else self.noise.log_likelihood
        )

    @property
    def log_target(self) -> DrawnValues:
        """``n`` tensor, log of likelihood x prior of each draw, all else integrated out."""
        return self.log_likelihood + self.log_prior

    @property
    def log_weights(self) -> DrawnValues:
        """``n`` tensor before smoothing; their mean estimates the evidence."""
        return self.log_target - self.log_proposal

    @cached_property
    def _smoothed_tail(self) -> tuple[Tensor, float]:
        return smooth_tail(self.log_weights)

    @property
    def failed(self) -> int:
        """Draws whose solve failed: data of probability 0."""
        return int(torch.isinf(self.log_weights).sum())

    @property
    def reliable(self) -> bool:
        """Whether the estimates below are reliable."""
        return are_reliable(self.pareto_k, self.effective_samples, len(self))

    @cached_property
    def surprise(self) -> float:
        """How far the moments are from those that the proposal was made for.

        See :meth:`divergence_from`.
        """
        return self.divergence_from(self.centre, self.spread, self.behind)

    @cached_property
    def as_fitted(self) -> "ImportanceSample":
        """The draws weighted with the noise that the fit was made with."""
        return self if self.noise is None else replace(self, noise=None)

    def correct_gaussian(
        self, mean: Controls, chol: ControlMatrix
    ) -> tuple[Controls, ControlMatrix]:
        """Mean and covariance of the posterior, from those of a Gaussian near it.

        What is added is the difference between two weighings of the same draws, by the posterior
        and by the Gaussian, so most of the chance in them cancels, and all of it where the Gaussian
        is the posterior.

        Args:
            mean: ``d`` tensor.
            chol: Cholesky factor of the covariance; so is the second that is returned.
        """
        whitened = torch.linalg.solve_triangular(
            chol, (self.controls - mean).mT, upper=False
        )
        weights = torch.softmax(-0.5 * whitened.square().sum(0) - self.log_proposal, dim=0)
        centre, covariance = weighted_moments(self.controls, weights)
        before, after = map(torch.linalg.cholesky, (covariance, self.covariance))
        return mean + self.mean - centre, chol @ torch.linalg.solve_triangular(
            before, after, upper=False
        )

    def noise_laws(self, count: int) -> list[Noise] | None:
        """``count`` noise laws of the posterior, of equal weight; None where the noise is known."""
        if self.noise is None:
            return None
        drawn = self.noise.drawn[self.space_draws(count)]
        return [self.noise.nodes.law_at(node) for node in drawn.tolist()]

    def divergence_from(
        self, mean: Controls, chol: ControlMatrix, behind: float = math.inf
    ) -> float:
        """Kullback-Leibler divergence of a Gaussian from that with the moments found, nats, less
        its expectation by chance.

        With ``n`` effective draws that is ``d (d + 3)/(4 n)``: half a chi-square of as many degrees
        of freedom as there are moments, over ``n``; the same again for other moments from draws.

        Args:
            mean: ``d`` tensor.
            chol: Cholesky factor of the covariance.
            behind: effective draws that these two rest on; infinite where on none.
        """
        found, other = (
            MultivariateNormal(at, scale_tril=root, validate_args=False)
            for at, root in (
                (self.mean, torch.linalg.cholesky(self.covariance)),
                (mean, chol),
            )
        )
        size = len(mean)
        chance = 0.25 * size * (size + 3) * (1.0 / self.effective_samples + 1.0 / behind)
        return float(kl_divergence(found, other)) - chance

    @property
    def log_evidence(self) -> float:
        """``log p(y)``, nats."""
        return float(torch.logsumexp(self._smoothed_tail[0], dim=0)) - math.log(len(self))

    @property
    def log_evidence_error(self) -> float:
        """Monte Carlo standard error of ``log_evidence``: by the delta method, larger where the
        draws are not reliable.
        """
        return self._weight_spread if self.reliable else self.doubtful_error

    @property
    def _weight_spread(self) -> float:
        return math.sqrt(len(self)) * float(self.weights.std())

    @property
    def doubtful_error(self) -> float:
        """The same with what the tail of the weights may hide.

        The mean of ``n`` weights whose tail has a shape ``k`` above 1/2 converges as ``n^(k - 1)``
        (Vehtari et al. 2024), mostly from below, and the spread of the weights that were drawn does
        not show it. ``k`` is taken one standard deviation above its estimate, and at most 2, beyond
        which nothing is known.
        """
        count = len(self)
        shape = min(self.pareto_k, 2.0)
        tail = min(0.2 * count, 3.0 * math.sqrt(count))
        shape = min(shape + (1.0 + shape) / math.sqrt(tail), 2.0)
        return math.hypot(
            self._weight_spread, max(count ** (shape - 1.0) - count**-0.5, 0.0)
        )

    @cached_property
    def mean(self) -> Controls:
        """``d`` tensor, posterior mean of ``v``."""
        return self.weights @ self.controls

    @property
    def covariance(self) -> ControlMatrix:
        """``d x d`` tensor, posterior covariance of ``v``."""
        return weighted_moments(self.controls, self.weights)[1]

    @property
    def power_sensitivities(self) -> Float[Tensor, "2 controls"]:
        """Standard deviations by which the mean of each control moves, or half the share by which its
        variance does, per doubling of the power to which the prior, and the likelihood, is raised.

        Power-scaling of Kallioinen, Paananen, Buerkner & Vehtari (Stat. Comput. 34, 2024); the
        derivative of a mean in the power is a covariance with the logarithm.
        """
        scaled = (self.controls - self.mean) / self.covariance.diagonal().sqrt()
        parts = torch.stack((self.log_prior, self.log_likelihood.nan_to_num(neginf=0.0)))
        parts = self.weights * (parts - (parts @ self.weights)[:, None])
        moved = torch.maximum((parts @ scaled).abs(), 0.5 * (parts @ scaled.square()).abs())
        return math.log(2.0) * moved

    def space_draws(self, count: int, start: float = 0.5) -> Int[Tensor, "count"]:
        """Indices of ``count`` draws of equal weight, each within one of its expected number, the
        same whenever asked for (systematic resampling).
        """
        positions = (arange(count) + start) / count
        return torch.searchsorted(self.weights.cumsum(0), positions).clamp_max(
            len(self) - 1
        )

    def resample_draws(self, count: int, source: torch.Generator) -> Int[Tensor, "count"]:
        """The same from a random start and in random order."""
        start = float(rand((), generator=source))
        return self.space_draws(count, start)[torch.randperm(count, generator=source)]
