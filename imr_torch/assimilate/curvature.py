"""Curvature of the cost that Gauss-Newton leaves out, estimated from how sensitivities change
between points.

The Hessian of the cost has a part that comes from residuals and second derivatives of predictions.
Where a model misses the data by tens of standard deviations it is as large as the part of Gauss and
Newton, and without it a descent converges slowly. The structured secant update of Dennis, Gay &
Welsch (ACM Trans. Math. Softw. 7, 1981, section 3) estimates it from the sensitivities at two
points, which a descent has anyway. The estimate is symmetric and need not be positive: steps that
use it are taken only where they lower the exact cost.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.posterior import Neighbourhood

MOST = 200
"""Joint coordinates up to which curvature is estimated: it is a full matrix, where the normal equations are an arrow."""


def updated(
    curvature: Float[Tensor, "chains coordinates coordinates"],
    before: tuple[Neighbourhood, NormalEquations],
    after: tuple[Neighbourhood, NormalEquations],
) -> Float[Tensor, "chains coordinates coordinates"]:
    """The estimate after a step of each of ``C`` chains; where a step gives none, that before it.

    Args:
        curvature: the estimate before.
        before: the neighbourhoods of the points at which the steps began, and the equations there.
        after: those of the points at which they ended.
    """
    (old, old_equations), (new, new_equations) = before, after
    step = _joined(new.point.gel - old.point.gel, new.point.nuisances - old.point.nuisances)
    rise = _gradient(new_equations) - _gradient(old_equations)
    slope = new.posterior.likelihood_slope(new.centre)[..., None]
    by_gel, by_nuisance = (
        ((now - was).mT @ slope)[..., 0] for was, now in zip(old.slopes, new.slopes, strict=True)
    )
    bend = _joined(
        by_gel.sum(-2), by_nuisance
    )  # of the gradient, what the change of sensitivities makes
    expected = (curvature @ step[..., None])[..., 0]
    size = (_dot(step, bend).abs() / _dot(step, expected).abs().clamp_min(1e-300)).clamp_max(1.0)
    missed = bend - size[:, None] * expected
    along = _dot(step, rise)[:, None, None]
    outer = missed[:, :, None] * rise[:, None, :]
    back = (
        (_dot(missed, step)[:, None, None] / along.square()) * rise[:, :, None] * rise[:, None, :]
    )
    moved = size[:, None, None] * curvature + (outer + outer.mT) / along - back
    usable = (along > 0.0) & torch.isfinite(moved).flatten(1).all(1)[:, None, None]
    return torch.where(usable, moved, curvature)


def damped_step(
    equations: NormalEquations,
    curvature: Float[Tensor, "chains coordinates coordinates"],
    damping: Float[Tensor, "chains"],
) -> tuple[Float[Tensor, "chains controls"], Float[Tensor, "chains experiments nuisances"]]:
    """Levenberg-Marquardt steps of gel and nuisances that know the curvature; without it where they
    would go uphill.

    Args:
        equations: of ``C`` chains.
        curvature: of each; zero where it is not known.
        damping: of each.
    """
    gel, nuisances = equations.step(damping)
    if not bool(curvature.any()):
        return gel, nuisances
    hessian = _hessian(equations)
    size = gel.shape[-1]
    damped = (
        hessian
        + damping[:, None, None] * torch.diag_embed(hessian.diagonal(dim1=-2, dim2=-1))
        + curvature
    )
    chol, info = torch.linalg.cholesky_ex(damped)
    step = -torch.cholesky_solve(_gradient(equations)[..., None], chol)[..., 0]
    downhill = (info == 0) & torch.isfinite(step).all(-1)
    gel = torch.where(downhill[:, None], step[:, :size], gel)
    return gel, torch.where(
        downhill[:, None, None], step[:, size:].reshape(nuisances.shape), nuisances
    )


def _dot(one: Tensor, other: Tensor) -> Tensor:
    return (one * other).sum(-1)


def _joined(gel: Tensor, nuisances: Tensor) -> Tensor:
    """``C x D`` joint coordinates, those of the gel first."""
    return torch.cat((gel, nuisances.flatten(1)), 1)


def _gradient(equations: NormalEquations) -> Tensor:
    return _joined(equations.gel_gradient, equations.nuisance_gradient)


def _hessian(equations: NormalEquations) -> Tensor:
    """``C x D x D``, the arrow as a full matrix."""
    chains, experiments, width, size = equations.cross.shape
    full = torch.zeros(
        chains, size + experiments * width, size + experiments * width, dtype=torch.float64
    )
    cross = equations.cross.reshape(chains, experiments * width, size)
    full[:, :size, :size], full[:, size:, :size], full[:, :size, size:] = (
        equations.gel_hessian,
        cross,
        cross.mT,
    )
    for e in range(experiments):
        own = slice(size + e * width, size + (e + 1) * width)
        full[:, own, own] = equations.nuisance_hessian[:, e]
    return full
