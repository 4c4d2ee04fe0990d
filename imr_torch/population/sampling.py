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

from imr_torch.assimilate.importance import effective_size, largest_shape, smooth_tail
from imr_torch.assimilate.proposals import student_draws, student_log_prob
from imr_torch.material import ModelBelief
from imr_torch.population.closed_form import GaussianShots, positive_part
from imr_torch.population.likelihood import ShotLikelihood, quadratic_form
from imr_torch.population.quadrature import cells
from imr_torch.types import ControlMatrix, Controls, DrawnControls, DrawnValues

_DEFENSIVE = 0.1  # share of the proposal that is the prior of the scatters
_FREEDOM = 7  # degrees of freedom of what proposes the centre
_EACH = 8  # gels of each shot for each draw, in opposite pairs
_CHUNK = 2000  # draws at once
_ENOUGH = 0.15  # effective share of the draws below which the Gaussian parts are fitted again
_REFITS = 3


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

    @property
    def varying(self) -> list[int]:
        """Columns of the controls that vary."""
        return torch.nonzero(self.scale)[:, 0].tolist()

    @cached_property
    def precision(self) -> ControlMatrix:
        """``d x d`` tensor, prior precision of the centre."""
        return torch.cholesky_inverse(self.prior.chol)

    @cached_property
    def gaussian(self) -> GaussianShots:
        """The quadratic parts of the likelihoods."""
        return GaussianShots(
            torch.stack([s.precision for s in self.shots]),
            torch.stack([s.linear for s in self.shots]),
            torch.tensor([s.constant for s in self.shots], dtype=torch.float64),
        )


@dataclass(frozen=True)
class WeightedPopulation:
    """Draws of a population's posterior.

    Args:
        scatter: of the controls.
        centre: the population's controls.
        shots: each shot's controls.
        log_weights: from all draws of the shots, and without each group of them; the mean of
            their exponentials estimates the evidence.
        refits: times that the Gaussian parts were fitted again.
    """

    scatter: DrawnControls
    centre: DrawnControls
    shots: Float[Tensor, "draws experiments controls"]
    log_weights: Float[Tensor, "draws groups"]
    refits: int = 0

    @cached_property
    def _smoothed(self) -> tuple[Tensor, float]:
        return smooth_tail(self.log_weights[:, 0])

    @property
    def pareto_k(self) -> float:
        """Shape of the tail of the weights."""
        return self._smoothed[1]

    @cached_property
    def weights(self) -> DrawnValues:
        """``n`` tensor, normalised and smoothed."""
        return torch.softmax(self._smoothed[0], 0)

    @property
    def effective_samples(self) -> float:
        """Kish effective sample size."""
        return float(effective_size(self.weights))

    @property
    def reliable(self) -> bool:
        """Whether estimates from these draws are reliable."""
        return self.pareto_k <= largest_shape(len(self.weights)) and self.effective_samples >= 100.0

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

    def mean_error(self, values: DrawnValues) -> tuple[float, float]:
        """Mean of ``n`` values and its Monte Carlo standard error, by these draws and by those of
        the shots.
        """
        weights = torch.softmax(self.log_weights, 0)
        means = weights.mT @ values
        own = (weights[:, 0].square() @ (values - means[0]).square()).sqrt()
        return float(self.weights @ values), math.hypot(float(own), jackknife_error(means[1:]))


def jackknife_error(values: Float[Tensor, "groups"]) -> float:
    """Standard error from estimates that leave out one of as many groups each."""
    return float(((len(values) - 1) * values.var(correction=0)).sqrt())


def sample_population(problem: Problem, draws: int, source: torch.Generator) -> WeightedPopulation:
    """Weighted draws, with Gaussian parts that are fitted again as long as that helps."""
    gaussian = problem.gaussian
    best = _sample(problem, gaussian, draws, source)
    for number in range(1, _REFITS + 1):
        if best.effective_samples >= _ENOUGH * draws and best.pareto_k < largest_shape(draws):
            break
        gaussian = _fitted_again(problem, best)
        other = _sample(problem, gaussian, draws, source)
        if other.effective_samples > best.effective_samples:
            best = WeightedPopulation(
                other.scatter, other.centre, other.shots, other.log_weights, number
            )
    return best


def _sample(
    problem: Problem, gaussian: GaussianShots, draws: int, source: torch.Generator
) -> WeightedPopulation:
    """Draws from the closed form of Gaussian shots, and their weights."""
    scatter, log_ratio = _scatters(problem, gaussian, draws, source)
    parts = [_given(problem, gaussian, rows, source) for rows in scatter.split(_CHUNK)]
    centre, shots, log_weights = (torch.cat(x) for x in zip(*parts, strict=True))
    return WeightedPopulation(scatter, centre, shots, log_weights + log_ratio[:, None])


def _scatters(
    problem: Problem, gaussian: GaussianShots, draws: int, source: torch.Generator
) -> tuple[Tensor, Tensor]:
    """``draws x d`` scatters, and the log of their prior over their proposal."""
    varying = problem.varying
    size = len(problem.scale)
    scatter = torch.zeros(draws, size, dtype=torch.float64)
    if not varying:
        return scatter, torch.zeros(draws, dtype=torch.float64)
    grid = cells(gaussian, problem.prior, problem.scale)
    chance = (1.0 - _DEFENSIVE) * grid.weights + _DEFENSIVE * torch.softmax(grid.log_prior, 0)
    cell = torch.multinomial(chance, draws, replacement=True, generator=source)
    within = torch.rand(draws, len(varying), generator=source, dtype=torch.float64)
    values = grid.low[cell] + within * grid.width[cell]
    scatter[:, varying] = values
    log_proposal = chance[cell].log() - grid.width[cell].log().sum(1)
    log_prior = HalfNormal(problem.scale[varying]).log_prob(values).sum(1)
    return scatter, log_prior - log_proposal


def _given(
    problem: Problem, gaussian: GaussianShots, scatter: Tensor, source: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Centre, shots and log weights of draws with given scatters, but for the prior and proposal of
    these.
    """
    count, size = scatter.shape
    given = gaussian.given(scatter, problem.prior.mean, problem.precision)
    noise = student_draws((count, size), _FREEDOM, source)
    centre = (
        given.centre
        + torch.linalg.solve_triangular(given.chol.mT, noise[..., None], upper=True)[..., 0]
    )
    square = noise.square().sum(1)
    # evidence times the Gaussian posterior of the centre, over the proposal of it
    log_normal = -0.5 * (square + size * math.log(2.0 * math.pi))
    log_weights = given.evidence + log_normal - student_log_prob(square, size, _FREEDOM)
    means = given.shot_means(centre)
    shots = []
    missed = []
    each = _EACH if problem.varying else 2
    for e, shot in enumerate(problem.shots):
        half = torch.randn(count, each // 2, size, generator=source, dtype=torch.float64)
        noise = torch.cat((half, -half), 1)
        gels = means[:, e, None] + noise @ given.factor[:, e].mT
        base = (
            shot.constant - gaussian.constant[e] + quadratic_form(gels, shot.precision, shot.linear)
        )
        left = (
            shot.correction(gels)
            + (base - quadratic_form(gels, gaussian.precision[e], gaussian.linear[e]))[..., None]
        )
        chosen = torch.multinomial(torch.softmax(left[..., 0], 1), 1, generator=source)[:, 0]
        shots.append(gels[torch.arange(count), chosen])
        missed.append(torch.logsumexp(left, 1) - math.log(each))
    return centre, torch.stack(shots, 1), log_weights[:, None] + torch.stack(missed).sum(0)


def _fitted_again(problem: Problem, found: WeightedPopulation) -> GaussianShots:
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
    for e, shot in enumerate(problem.shots):
        gels = found.shots[:, e]
        mean = root.square() @ gels
        unit = (root.square() @ (gels - mean).square()).sqrt().clamp_min(1e-9)
        x = (gels - mean) / unit
        basis = torch.cat((torch.ones_like(x[:, :1]), x, x[:, rows] * x[:, columns]), 1)
        values = shot.log_prob(gels)
        solved = torch.linalg.lstsq(
            root[:, None] * basis, (root * values)[:, None], driver="gelsd"
        ).solution[:, 0]
        curve = torch.zeros(size, size, dtype=torch.float64)
        curve[rows, columns] = -solved[1 + size :]
        A = positive_part(curve + curve.mT) / (unit[:, None] * unit)
        slope = solved[1 : 1 + size] / unit
        b = slope + A @ mean
        parts.append((A, b, solved[0] - slope @ mean - 0.5 * mean @ A @ mean))
    precision, linear, constant = (torch.stack(x) for x in zip(*parts, strict=True))
    return GaussianShots(precision, linear, constant)
