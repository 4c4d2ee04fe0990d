"""Expected information gain of a design: how many nats an experiment is expected to tell about parameters and model.

Nested Monte Carlo with one sample set is bounded by ``log N`` and saturates where experiments are most informative. Here
the inner integrals are done by Gauss-Newton (Laplace) instead: for draws ``v_n`` of the belief with prediction ``f_n`` and
sensitivity ``J_n`` (whitened by noise and prior),

    I(theta; y | model) ~ mean_n 1/2 log det(1 + J_n^T J_n)                      (Long et al., CMAME 259, 2013)
    I(model; y)         ~ mean_n log p(y_n | m_n) - log sum_m p(m) p(y_n | m),

where ``p(y | m)`` is the Gaussian evidence linearised at the draw of ``m`` nearest to its own optimum. Both are exact for
linear-Gaussian models. Several designs at once are stacked, so their gain is the joint one.
"""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.material import Belief, ModelBelief
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance, predict
from imr_torch.random import SeedLike, generator
from imr_torch.simulate import Simulator

_STEP = 0.02  # finite-difference step, in standard deviations of the belief
_ENOUGH = 0.5  # share of draws that must be simulated for an estimate to count


@dataclass(frozen=True)
class Plan:
    """How a planned experiment will be observed.

    Args:
        times: ``n_t`` tensor of dimensionless frame times.
        repeats: curves per design.
        noise: observation noise of one curve.
        nuisance: errors of the measured design and clock, marginalised.
    """

    times: Tensor = field(default_factory=lambda: torch.linspace(0.0, 4.0, 81, dtype=torch.float64))
    repeats: int = 1
    noise: Noise = field(default_factory=Noise)
    nuisance: Nuisance = field(default_factory=Nuisance)

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise InputDataError(f"Plan.repeats is {self.repeats}; at least 1 curve per design is needed.")

    def batch(self, designs: Tensor) -> ExperimentBatch:
        """Experiments at ``q x 2`` designs that have not been shot: their curves are nothing but zeros."""
        radius = torch.zeros(1, len(self.times), dtype=self.times.dtype)
        rows = [Experiment("planned", (d[0], d[1]), self.times, radius, self.nuisance) for d in designs.tolist()]
        return ExperimentBatch(tuple(rows), self.noise)


@dataclass(frozen=True)
class InformationGain:
    """An estimate of the expected information gain, nats.

    Args:
        parameters: gain about the parameters, given the model.
        model: gain about which model it is.
        variance: Monte Carlo variance of the sum of the two.
        counted: draws that could be simulated.
        drawn: draws asked for.
        model_variance: Monte Carlo variance of the gain about the model alone.
    """

    parameters: float
    model: float
    variance: float
    counted: int
    drawn: int
    model_variance: float = 0.0

    @property
    def value(self) -> float:
        """The whole gain; NaN when too few draws could be simulated to stand for the belief."""
        return self.parameters + self.model if self.counted >= _ENOUGH * self.drawn else math.nan


@dataclass(frozen=True)
class _Linearised:
    """Draws of one model.

    Args:
        controls: ``n x d`` tensor.
        prediction: ``n x q x T`` tensor.
        root: ``n x q x T x T`` tensor, inverse Cholesky factors of noise and nuisances together.
        sensitivity: ``n x (q T) x d`` tensor, whitened by ``root``.
    """

    controls: Tensor
    prediction: Tensor
    root: Tensor
    sensitivity: Tensor

    def __len__(self) -> int:
        return len(self.controls)


def expected_information_gain(
    belief: Belief, designs: Tensor, simulator: Simulator, plan: Plan, *, draws: int = 64, seed: SeedLike
) -> InformationGain:
    """Gain of shooting ``q`` designs with one belief.

    Args:
        belief: what is thought of the gel now.
        designs: ``q x 2`` tensor, (We, R_inf*).
        simulator: makes the bubbles.
        plan: how they will be observed.
        draws: draws per model.
        seed: of draws and noise.

    Returns:
        The estimate with its Monte Carlo variance and how many draws counted.
    """
    source = generator(seed)
    parts = [_linearise(part, designs, simulator, plan, draws, source) for part in belief.models]
    weights = belief.log_probabilities.exp()
    gains, spread = [], torch.zeros(2, dtype=torch.float64)
    counted = sum(len(part) for part in parts)
    for i, part in enumerate(parts):
        n = len(part)
        if n < 2:
            gains.append(torch.zeros(2, dtype=torch.float64))
            continue
        eye = torch.eye(part.controls.shape[1], dtype=torch.float64)
        about = 0.5 * torch.linalg.slogdet(eye + part.sensitivity.mT @ part.sensitivity).logabsdet
        which = _about_model(parts, belief.log_probabilities, i, source)
        gains.append(torch.stack((about.mean(), which.mean())))
        spread = spread + weights[i].square() * torch.stack(((about + which).var(), which.var())) / n
    total = (weights[:, None] * torch.stack(gains)).sum(0)
    both, model = spread.tolist()
    return InformationGain(float(total[0]), float(total[1]), both, counted, draws * len(parts), model)


def _linearise(
    part: ModelBelief, designs: Tensor, simulator: Simulator, plan: Plan, draws: int, source: torch.Generator
) -> _Linearised:
    """Predictions and whitened sensitivities of one model's draws, by central differences."""
    d, q = len(part.names), designs.shape[0]
    v = torch.randn(draws, d, generator=source, dtype=torch.float64)
    sds = plan.nuisance.sds()
    uncertain = torch.nonzero(sds > 0.0)[:, 0].tolist()
    gel = torch.zeros(1 + 2 * (d + len(uncertain)), d, dtype=torch.float64)
    shift = torch.zeros(len(gel), 3, dtype=torch.float64)
    for i in range(d):
        gel[1 + 2 * i, i], gel[2 + 2 * i, i] = _STEP, -_STEP
    for i, column in enumerate(uncertain, start=d):
        shift[1 + 2 * i, column], shift[2 + 2 * i, column] = _STEP, -_STEP
    parameters = part.parameters(part.mean + (v[:, None] + gel) @ part.chol.mT)
    radius = predict(simulator, parameters, plan.batch(designs), (shift * sds)[:, None].expand(draws, -1, q, -1))
    good = torch.isfinite(radius).flatten(1).all(1)
    radius = radius[good]
    slopes = ((radius[:, 1::2] - radius[:, 2::2]) / (2.0 * _STEP)).movedim(1, -1)  # n x q x T x (d + uncertain)
    root = _root(radius[:, 0], slopes[..., d:], plan)
    return _Linearised(v[good], radius[:, 0], root, (root @ slopes[..., :d]).flatten(1, 2))


def _root(prediction: Tensor, by_nuisance: Tensor, plan: Plan) -> Tensor:
    """Inverse Cholesky factors of the covariance of the repeats' mean, ``n x q x T x T``."""
    sd = plan.noise.sd(prediction, plan.times)
    eye = torch.eye(len(plan.times), dtype=sd.dtype)
    factor = plan.noise.decorrelation(plan.times[None], torch.ones(1, len(plan.times), dtype=torch.bool))
    correlation = eye if factor is None else torch.linalg.inv(factor[0].mT @ factor[0])
    covariance = sd[..., :, None] * correlation * sd[..., None, :] / plan.repeats + by_nuisance @ by_nuisance.mT
    return torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), eye, upper=False)


def _about_model(parts: list[_Linearised], log_prior: Tensor, own: int, source: torch.Generator) -> Tensor:
    """``log p(y_n|m) - log p(y_n)`` of data drawn from model ``own``: ``n`` tensor."""
    drawn = parts[own]
    if len(parts) == 1:
        return torch.zeros(len(drawn), dtype=torch.float64)
    noise = torch.randn(*drawn.prediction.shape, 1, generator=source, dtype=torch.float64)
    data = drawn.prediction + torch.linalg.solve_triangular(drawn.root, noise, upper=False)[..., 0]
    logs = [_evidence(data, part, itself=i == own) for i, part in enumerate(parts)]
    return logs[own] - torch.logsumexp(torch.stack(logs) + log_prior[:, None], dim=0)


def _evidence(data: Tensor, part: _Linearised, *, itself: bool) -> Tensor:
    """Log evidence of ``data`` (``n x q x T``), linearised at each datum's own draw or at the nearest one; ``n`` tensor."""
    if itself:
        return _linear_gaussian(data[:, None], part, slice(None))[0][:, 0]
    if len(part) == 0:
        return torch.full_like(data[:, 0, 0], -math.inf)
    values, moved = zip(*(_linear_gaussian(data[None], part, slice(k, k + 1)) for k in range(len(part))), strict=True)
    nearest = torch.cat(moved).argmin(0)
    return torch.cat(values).gather(0, nearest[None])[0]


def _linear_gaussian(data: Tensor, part: _Linearised, rows: slice) -> tuple[Tensor, Tensor]:
    """``log N(y; f - J v, C + J J^T)`` at draws ``rows``, and how far the optimum is from the draw.

    ``data`` is ``rows x k x q x T``; both results are ``rows x k``. The constant common to all models is left out.
    """
    sensitivity, controls, root = part.sensitivity[rows], part.controls[rows], part.root[rows]
    difference = data - part.prediction[rows][:, None]
    residual = (root[:, None] @ difference[..., None])[..., 0].flatten(-2)  # rows x k x m, whitened
    residual = residual + (sensitivity @ controls[..., None]).mT
    precision = torch.eye(controls.shape[1], dtype=data.dtype) + sensitivity.mT @ sensitivity
    chol = torch.linalg.cholesky(precision)
    score = residual @ sensitivity
    best = torch.cholesky_solve(score.mT, chol).mT
    square = residual.square().sum(-1) - (score * best).sum(-1)
    log_det = chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    log_det = log_det - root.diagonal(dim1=-2, dim2=-1).log().sum((-2, -1))
    return -0.5 * square - log_det[:, None], (best - controls[:, None]).norm(dim=-1)
