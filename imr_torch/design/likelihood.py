"""Planned data of gels drawn from a belief, and their likelihood: repeats, heteroscedastic and
correlated noise, windows, nuisances as Gaussian directions.

Data are the mean curves of all repeats, within each datum's own window. Nuisances are marginalised
in their linear approximation: ``y = f(v) + B w + e`` with ``w`` standard normal, by the normal
equations that fits use. What is left out is the scatter of the repeats about their mean, which
tells of the gel through the noise law alone (``2 slope^2`` of the information, .1 %).

Constants common to all gels and models are left out of log densities.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from imr_torch.assimilate.gauss_newton import (
    NormalEquations,
    half_log_det,
    normal_equations,
)
from imr_torch.design.response import Plan, Response, Rows, Shot, simulate_response
from imr_torch.float64 import eye, randn
from imr_torch.observe.noise import previous
from imr_torch.types import BatchControlMatrix, BroadcastValues, DrawnControls, DrawnValues


@dataclass(frozen=True)
class Data(Rows):
    """Mean curves of planned experiments.

    Args:
        radius: R/Rmax.
        window: frames that will be assimilated.
    """

    radius: Float[Tensor, "*draws designs frames"]
    window: Bool[Tensor, "*draws designs frames"]


def observe_gels(seen: Response, plan: Plan, source: torch.Generator) -> Data:
    """One datum of each gel, with nuisances and noise drawn."""
    times = plan.times.expand(seen.radius.shape[1:])
    noise = randn(seen.radius.shape, generator=source)
    noise = plan.noise.correlated(noise, times, times.isfinite())
    nuisance = randn(
        *seen.by_nuisance.shape[:2], seen.by_nuisance.shape[-1], 1, generator=source
    )
    noise = noise * plan.noise.sd(seen.radius, plan.times) / plan.repeats**0.5
    return Data(
        seen.radius + (seen.by_nuisance @ nuisance)[..., 0] + noise,
        plan.frames_in_window(seen.radius),
    )


@dataclass(frozen=True)
class Gels:
    """Gels of all models, drawn and simulated.

    Args:
        parts: gels of each model that could be simulated.
        orders: ``draws`` tensor per model: the numbers of all draws, those that could be simulated
            first.
    """

    parts: tuple[Response, ...]
    orders: tuple[Int[Tensor, "_"], ...]

    @property
    def rows(self) -> list[slice]:
        """Which of all gels, model after model, are of each model."""
        ends = accumulate(map(len, self.parts), initial=0)
        return [slice(first, end) for first, end in pairwise(ends)]

    def at_designs(self, place: Int[Tensor, "shots"]) -> "Gels":
        """The same gels at designs of some places, as in a sequence of shots."""
        return Gels(tuple(part.at_designs(place) for part in self.parts), self.orders)

    def observe(self, shot: Shot, source: torch.Generator) -> Data:
        """A datum of each gel, model after model."""
        data = [observe_gels(part, shot.plan, source) for part in self.parts]
        return Data(
            torch.cat([d.radius for d in data]), torch.cat([d.window for d in data])
        )


def draw_cloud_controls(
    shot: Shot, draws: int, source: torch.Generator
) -> list[Float[Tensor, "draws _"]]:
    """Draws of each model, ``draws x d``: from its stored posterior draws (``cloud``), or its
    Gaussian if it has none.
    """
    models = shot.belief.models
    drawn = [randn(draws, len(part.names), generator=source) for part in models]
    for i, part in enumerate(models):
        if part.cloud is not None:
            rows = torch.randperm(len(part.cloud.controls), generator=source)
            rows = rows.repeat(-(-draws // len(rows)))[:draws]
            drawn[i] = part.whitened(part.cloud.controls[rows])
    return drawn


def simulate_gels(
    shot: Shot, controls: Sequence[Float[Tensor, "_ _"]], *, gel: bool = True
) -> Gels:
    """Simulate the gels of each model at controls.

    Args:
        shot: designs and how they are observed.
        controls: ``draws x d`` tensor per model.
        gel: whether sensitivities to the gel are needed.
    """
    seen = [
        simulate_response(shot, part, v, gel=gel)
        for part, v in zip(shot.belief.models, controls, strict=True)
    ]
    orders = tuple(torch.argsort(~every.good, stable=True) for every in seen)
    return Gels(tuple(every[every.good] for every in seen), orders)


def linearise_data(
    data: Data,
    radius: Float[Tensor, "*#batch designs frames"],
    by_gel: Float[Tensor, "*#batch designs frames slopes"],
    by_nuisance: Float[Tensor, "*#batch designs frames nuisances"],
    plan: Plan,
) -> tuple[BroadcastValues, NormalEquations]:
    """Log density of data given gels that show ``radius`` with the nuisances at their means, and
    normal equations of that likelihood.

    >>> from imr_torch.design import Plan
    >>> from imr_torch.design.likelihood import Data, linearise_data
    >>> plan = Plan(times=torch.tensor([0.0, 1.0], dtype=torch.float64))
    >>> radius = torch.ones(5, 1, 2, dtype=torch.float64)  # 5 draws of one design with two frames
    >>> data = Data(radius, plan.frames_in_window(radius))
    >>> log, _ = linearise_data(data, radius, radius[..., None], radius[..., None], plan)
    >>> log.shape
    torch.Size([5])
    """
    sd = plan.noise.sd(radius, plan.times)
    times = plan.times[None]
    own, before = plan.noise.innovations(times, times.isfinite())

    def whiten_columns(columns: Tensor) -> Tensor:
        """In units of independent noise of the mean curve, 0 outside the window."""
        scaled = columns.mT / sd[..., None, :] * plan.repeats**0.5
        scaled = own * scaled - before * previous(scaled)
        return torch.where(data.window[..., None, :], scaled, 0.0).mT

    residual = whiten_columns((data.radius - radius)[..., None])
    slopes = whiten_columns(by_gel), whiten_columns(by_nuisance)
    of_gel, of_nuisances = (-(slope.mT @ residual)[..., 0] for slope in slopes)
    log_det = torch.where(data.window, sd.log(), 0.0).sum((-2, -1))
    log = -0.5 * residual.square().sum((-3, -2, -1)) - log_det
    return log, normal_equations((of_gel.sum(-2), of_nuisances), slopes)


@dataclass(frozen=True)
class Linear:
    """Linear-Gaussian inference from each datum about a gel of its own.

    Args:
        log_likelihood: of the datum given the gel itself.
        log_evidence: of the datum under the linearised model.
        mean: posterior mean.
        chol: ``n x d x d`` tensor, Cholesky factor of the posterior precision.
    """

    log_likelihood: DrawnValues
    log_evidence: DrawnValues
    mean: DrawnControls
    chol: BatchControlMatrix

    @property
    def information(self) -> DrawnValues:
        """``n`` tensor: ``1/2 log det(1 + J^T C^-1 J)``."""
        return half_log_det(self.chol)

    @property
    def fisher(self) -> BatchControlMatrix:
        """``n x d x d`` tensor ``J^T C^-1 J``, what the data add to the precision."""
        return self.chol @ self.chol.mT - eye(self.chol.shape[-1])


def infer_linear(data: Data, at: Response, plan: Plan) -> Linear:
    """Bayesian inference with the model linearised at a gel: ``f(v) = f + J (v - v_at)``, ``v``
    standard normal.

    Args:
        data: ``n`` data.
        at: ``n`` gels, or one for all data.
        plan: how they are observed.
    """
    log, likelihood = linearise_data(data, at.radius, at.by_gel, at.by_nuisance, plan)
    _, q, _, k = at.by_nuisance.shape
    still = at.by_nuisance.new_zeros(q, k)
    posterior = likelihood.with_prior(at.controls, still)
    return Linear(
        log + posterior.log_nuisance_integral,
        log - 0.5 * at.controls.square().sum(-1) + posterior.log_integral,
        at.controls + posterior.step[0],
        posterior.gel_chol,
    )
