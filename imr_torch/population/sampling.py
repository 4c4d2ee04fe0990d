"""Draws of population, scatter and shots, weighted by the smooth likelihoods of the shots.

The proposal is the closed form of Gaussian shots: a cell of a grid over the scatters by its
probability there, the scatter uniform within it, the population's centre from its Gaussian with
heavier tails, each shot from its own Gaussian given both. A draw's weight has the prior of the
scatter exactly, and for every shot the mean of its likelihood over its Gaussian part. Where the
weights vary much, the Gaussian parts are fitted again to the likelihoods at the draws (as in
expectation propagation: Minka 2001).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import HalfNormal

from imr_torch.assimilate.importance import (
    SmoothedWeights,
    effective_size,
    largest_shape,
    smooth_tail,
    weighted_quantiles,
)
from imr_torch.assimilate.proposals import student_draws, student_log_prob
from imr_torch.float64 import rand, randn, tensor, zeros
from imr_torch.material import LEVELS, ModelBelief
from imr_torch.population.closed_form import GaussianShots, grid_scatters, positive_part
from imr_torch.population.likelihood import ShotLikelihood, quadratic_form, solve_weighted
from imr_torch.types import BatchControls, Controls, DrawnControls, DrawnValues


@dataclass(frozen=True)
class Problem:
    """What is inferred from what.

    Args:
        shots: their likelihoods.
        prior: of the population's centre, in the model's controls.
        scale: scale of the half-normal prior of the scatter of each control; 0 where it does not
            vary.
    """

    shots: tuple[ShotLikelihood, ...]
    prior: ModelBelief
    scale: Controls


@dataclass(frozen=True)
class WeightedPopulation(SmoothedWeights):
    """Draws of a population's posterior.

    Args:
        scatter: of the controls.
        centre: the population's controls.
        shots: ``n x E x d`` tensor, each shot's controls.
        log_weights: from all draws of the shots, and without each group of them; the mean of
            their exponentials estimates the evidence.
    """

    scatter: DrawnControls
    centre: DrawnControls
    shots: BatchControls
    log_weights: Float[Tensor, "draws groups"]

    @cached_property
    def _smoothed_tail(self) -> tuple[Tensor, float]:
        return smooth_tail(self.log_weights[:, 0])

    @property
    def reliable(self) -> bool:
        """Whether estimates from these draws are reliable."""
        return (
            self.pareto_k <= largest_shape(len(self.weights))
            and self.effective_samples >= 100.0
        )

    @property
    def log_evidences(self) -> Float[Tensor, "groups"]:
        """``1 + GROUPS`` tensor, nats: from all draws of the shots, and without each group."""
        return torch.logsumexp(self.log_weights, 0) - math.log(len(self.log_weights))

    @property
    def evidence_error(self) -> float:
        """Standard error of the log evidence by the number of these draws alone (delta method),
        nats.
        """
        weights = torch.softmax(self.log_weights[:, 0], 0)
        return float((len(weights) * weights).std() / math.sqrt(len(weights)))

    def take_quantiles(self, values: DrawnValues) -> Float[Tensor, "3"]:
        """5, 50 and 95 % quantile of ``n`` values."""
        return weighted_quantiles(values, self.weights, tensor(LEVELS))

    def relative_error(self, values: DrawnValues) -> float:
        """Monte Carlo standard error of the mean of ``n`` values, by these draws and by those of the
        shots, in posterior standard deviations; 0 where there is no other value.
        """
        sd = float((self.weights @ (values - self.weights @ values).square()).sqrt())
        weights = torch.softmax(self.log_weights, 0)
        means = weights.mT @ values
        own = float((weights[:, 0].square() @ (values - means[0]).square()).sqrt())
        return math.hypot(own, jackknife_error(means[1:])) / sd if sd > 0.0 else 0.0


def jackknife_error(values: Float[Tensor, "groups"]) -> float:
    """Standard error from estimates that leave out one of as many groups each."""
    return float(((len(values) - 1) * values.var(correction=0)).sqrt())


def sample_population(
    problem: Problem,
    draws: int,
    source: torch.Generator,
    *,
    enough: float = 0.15,
    refits: int = 3,
) -> WeightedPopulation:
    """Weighted draws, with Gaussian parts that are fitted again as long as that helps.

    Args:
        problem: what is inferred from what.
        draws: how many.
        source: of random numbers.
        enough: effective share of the draws below which the Gaussian parts are fitted again.
        refits: how often they are, at most.
    """

    def draw_weighted(gaussian: GaussianShots) -> WeightedPopulation:
        scatter, log_ratio = _draw_scatters(problem, gaussian, draws, source)
        parts = [
            _draw_gels(problem, gaussian, rows, source) for rows in scatter.split(2000)
        ]
        centre, shots, log_weights = (torch.cat(x) for x in zip(*parts, strict=True))
        return WeightedPopulation(scatter, centre, shots, log_weights + log_ratio[:, None])

    quadratics = GaussianShots(
        torch.stack([shot.precision for shot in problem.shots]),
        torch.stack([shot.linear for shot in problem.shots]),
        tensor([shot.constant for shot in problem.shots]),
    )
    best = draw_weighted(quadratics)
    for _ in range(refits):
        if best.effective_samples >= enough * draws and best.pareto_k < largest_shape(
            draws
        ):
            break
        other = draw_weighted(_refit_gaussians(problem, best))
        best = max(best, other, key=lambda found: found.effective_samples)
    return best


def _draw_scatters(
    problem: Problem,
    gaussian: GaussianShots,
    draws: int,
    source: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """``draws x d`` scatters, and the log of their prior over their proposal, of which a tenth is
    the prior.
    """
    scale = problem.scale
    varying = scale.nonzero()[:, 0]
    scatter = zeros(draws, len(scale))
    if not len(varying):
        return scatter, scatter.sum(1)
    grid = grid_scatters(gaussian, problem.prior, scale)
    chance = 0.9 * grid.weights + 0.1 * torch.softmax(grid.log_prior, 0)
    cell = torch.multinomial(chance, draws, replacement=True, generator=source)
    within = rand(draws, len(varying), generator=source)
    values = grid.low[cell] + within * grid.width[cell]
    scatter[:, varying] = values
    log_proposal = chance[cell].log() - grid.width[cell].log().sum(1)
    return scatter, HalfNormal(scale[varying]).log_prob(values).sum(1) - log_proposal


def _draw_gels(
    problem: Problem,
    gaussian: GaussianShots,
    scatter: Tensor,
    source: torch.Generator,
    *,
    freedom: int = 7,
    each: int = 8,
) -> tuple[Tensor, Tensor, Tensor]:
    """Centre, shots and log weights of draws with given scatters, but for the prior and proposal of
    these.

    The centre is proposed with ``freedom`` degrees of freedom; of each shot ``each`` gels are drawn
    in opposite pairs, two where no parameter varies.
    """
    count, size = scatter.shape
    given = gaussian.given(scatter, problem.prior.mean, problem.prior.precision)
    noise = student_draws((count, size), freedom, source)
    away = torch.linalg.solve_triangular(given.chol.mT, noise[..., None], upper=True)[
        ..., 0
    ]
    centre = given.centre + away
    square = noise.square().sum(1)
    # evidence times the Gaussian posterior of the centre, over the proposal of it
    log_normal = -0.5 * (square + size * math.log(2.0 * math.pi))
    log_weights = given.evidence + log_normal - student_log_prob(square, size, freedom)
    means = given.shot_means(centre)
    each = each if problem.scale.any() else 2
    shots = []
    missed = []
    for e, shot in enumerate(problem.shots):
        half = randn(count, each // 2, size, generator=source)
        noise = torch.cat((half, -half), 1)
        gels = means[:, e, None] + noise @ given.factor[:, e].mT
        gaussian_part = quadratic_form(gels, gaussian.precision[e], gaussian.linear[e])
        left = shot.log_probs(gels) - (gaussian.constant[e] + gaussian_part)[..., None]
        chosen = torch.multinomial(torch.softmax(left[..., 0], 1), 1, generator=source)[
            :, 0
        ]
        shots.append(gels[torch.arange(count), chosen])
        missed.append(torch.logsumexp(left, 1) - math.log(each))
    return centre, torch.stack(shots, 1), log_weights[:, None] + torch.stack(missed).sum(0)


def _refit_gaussians(problem: Problem, found: WeightedPopulation) -> GaussianShots:
    """Quadratics fitted to the likelihoods of the shots at the draws of each, with tempered
    weights.
    """
    size = len(problem.scale)
    power = 1.0
    logs = found.log_weights[:, 0]
    while (
        float(effective_size(torch.softmax(power * logs, 0))) < 20.0 * (size + 1) ** 2
        and power > 1e-3
    ):
        power *= 0.7
    root = torch.softmax(power * logs, 0).sqrt()
    rows, columns = torch.triu_indices(size, size)
    parts = []
    for shot, gels in zip(problem.shots, found.shots.unbind(1), strict=True):
        mean = root.square() @ gels
        unit = (root.square() @ (gels - mean).square()).sqrt().clamp_min(1e-9)
        x = (gels - mean) / unit
        basis = torch.cat((torch.ones_like(x[:, :1]), x, x[:, rows] * x[:, columns]), 1)
        solved = solve_weighted(basis, shot.log_prob(gels), root)
        curve = zeros(size, size)
        curve[rows, columns] = -solved[1 + size :]
        A = positive_part(curve + curve.mT) / (unit[:, None] * unit)
        slope = solved[1 : 1 + size] / unit
        parts.append(
            (A, slope + A @ mean, solved[0] - slope @ mean - 0.5 * mean @ A @ mean)
        )
    return GaussianShots(*(torch.stack(x) for x in zip(*parts, strict=True)))
