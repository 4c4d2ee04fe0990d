"""A proposal distribution along a curved ridge of the posterior, where one direction is poorly
determined.

Two parameters that do much the same to R(t) (G and alpha, say) leave a posterior many times as long
as it is wide, and curved over that length. A Gaussian does not follow it, and kernels about draws
of that Gaussian do not reach its ends. So it is followed step by step (continuation by
pseudo-arclength: Keller 1977), the other controls and the nuisances being fitted at each point (a
profile likelihood, as in Raue et al., Bioinformatics 25, 2009), until the profile has fallen far
enough on both sides. Kernels on the points, each along and as wide as the ridge is there, are the
proposal.

It need not be exact, since every draw is weighted. Used for fits whose Gaussian was not confirmed.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from imr_torch.assimilate.fit import ModelFit
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.importance import weighted_moments
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.proposals import Kernels
from imr_torch.float64 import tensor
from imr_torch.types import ControlMatrix, Controls


@dataclass(frozen=True)
class _RidgePoint:
    """A point on a ridge.

    Args:
        point: where.
        cost: of the joint cost's optimum at this place along the ridge, nats.
        promised: nats by which the last step is predicted to lower it, included in ``cost``;
            infinite where a bubble failed.
        hessian: of the cost, nuisances eliminated.
        nuisance_log_det: log determinant of the nuisances' own Hessian.
        response: how the nuisances' optimum moves with the gel.
    """

    point: Point
    cost: float
    promised: float
    hessian: ControlMatrix
    nuisance_log_det: float
    response: Float[Tensor, "experiments nuisances controls"]

    def move_gel(self, step: Controls) -> "_RidgePoint":
        """The same with the gel moved, and the nuisances as they follow it."""
        point = Point(self.point.gel + step, self.point.nuisances + self.response @ step)
        return replace(self, point=point)


def trace_ridge(fit: ModelFit, posterior: Posterior) -> Kernels:
    """Follow the ridge of a fit to both sides.

    Args:
        fit: a fit with its Gaussian approximation; not changed.
        posterior: of its model, with a small bundle of bubbles for each step.

    Returns:
        A proposal.
    """
    values, vectors = torch.linalg.eigh(fit.chol @ fit.chol.mT)
    axis = values[-1].sqrt() * vectors[:, -1]
    optimum = _RidgePoint(
        fit.point,
        fit.cost,
        0.0,
        torch.cholesky_inverse(fit.chol),
        fit.nuisance_log_det,
        fit.nuisance_response,
    )
    below, above = (_follow_side(optimum, way, posterior) for way in (-axis, axis))
    points = [*reversed(below), optimum, *above]
    return (
        _place_kernels(points)
        if len(points) > 2
        else Kernels.about_mean(fit.mean, fit.chol)
    )


def _follow_side(
    optimum: _RidgePoint,
    axis: Controls,
    posterior: Posterior,
    *,
    fall: float = 8.0,
    lost: float = 3.0,
) -> list[_RidgePoint]:
    """The ridge from its optimum to one end.

    Kernels about its points overlap: none lies a nat off the straight line through the two before.
    Where points a sixteenth of the first step apart do, it is given up.

    Args:
        optimum: where it begins.
        axis: direction of the first step, as long as steps may be: a posterior standard deviation.
        posterior: of the model.
        fall: nats by which the profile falls at the end; what lies beyond holds less than a
            thousandth of the probability.
        lost: predicted decrease of a further step, nats, from which a point is no part of the
            ridge.
    """
    points = [optimum]
    along = normalize(axis, dim=0)
    turn = torch.zeros_like(along)
    longest = length = float(axis.norm())
    least = optimum.cost
    for _ in range(24):  # points, at most
        ahead = normalize(along + length * turn, dim=0)
        point = _fit_across(points[-1].move_gel(length * ahead), ahead, posterior)
        step = point.point.gel - points[-1].point.gel
        off = step - along * (along @ step)
        bend = 0.5 * float(off @ point.hessian @ off)
        if point.promised >= lost or bend >= 1.0:
            length *= 0.5
            if length < longest / 16.0:
                break
            continue
        points.append(point)
        least = min(least, point.cost)
        if point.cost > least + fall:
            break
        following = normalize(step, dim=0)
        turn = (following - along) / step.norm()
        along = following
        if bend < 0.1:
            length = min(2.0 * length, longest)
    return points[1:]


def _fit_across(
    guess: _RidgePoint,
    along: Controls,
    posterior: Posterior,
) -> _RidgePoint:
    """A point after Gauss-Newton steps across the ridge, with the cost predicted from its local
    sensitivities: four at most, fewer where the next one is predicted to lower the cost by
    less than .3 nats, which weights repair.
    """
    across = _normal_plane(along)
    for _ in range(4):
        near = posterior.neighbourhood(guess.point)
        if not near.prediction.isfinite().all():
            return replace(guess, promised=math.inf)
        equations = near.equations
        reduced = equations.reduced
        hessian = across.mT @ reduced.hessian @ across
        step = across @ -torch.linalg.solve(hessian, across.mT @ reduced.gradient)
        promised = -0.5 * float(
            reduced.gradient @ step
            + (equations.nuisance_gradient * reduced.nuisance_step).sum()
        )
        fitted = Point(near.point.gel, near.point.nuisances + reduced.nuisance_step)
        guess = _RidgePoint(
            fitted,
            -float(near.log_joint) - promised,
            promised,
            reduced.hessian,
            float(reduced.nuisance_log_det),
            reduced.nuisance_response,
        ).move_gel(step)
        if promised <= 0.3:
            break
    return guess


def _place_kernels(points: list[_RidgePoint], *, overlap: float = 0.7) -> Kernels:
    """A kernel on each point of a ridge, in order, along it as long as ``overlap`` of the distance
    of its neighbours, and a wide one about all with a probability of .1.
    """
    gels = torch.stack([p.point.gel for p in points])
    steps = gels.diff(dim=0)
    ways = normalize(torch.cat((steps[:1], gels[2:] - gels[:-2], steps[-1:])), dim=1)
    lengths = steps.norm(dim=1)
    spacing = 0.5 * torch.cat(
        (2.0 * lengths[:1], lengths[1:] + lengths[:-1], 2.0 * lengths[-1:])
    )
    across = torch.stack([_normal_plane(way) for way in ways])  # J x d x (d - 1)
    hessian = torch.stack([p.hessian for p in points])
    inside = torch.linalg.inv(across.mT @ hessian @ across)
    flat = across @ inside @ across.mT
    line = ways[:, :, None] * ways[:, None, :]
    chols = torch.linalg.cholesky(flat + (overlap * spacing).square()[:, None, None] * line)
    cost = tensor([p.cost + 0.5 * p.nuisance_log_det for p in points])
    weights = torch.softmax(
        0.5 * torch.linalg.slogdet(inside).logabsdet + spacing.log() - cost, dim=0
    )
    mean, along = weighted_moments(gels, weights)
    chol = torch.linalg.cholesky(along + (weights[:, None, None] * flat).sum(0))
    kernels = Kernels(gels, weights, chols, mean, chol, precisions=hessian)
    return kernels.with_wide_kernel(0.1)


def _normal_plane(way: Controls) -> Float[Tensor, "controls across"]:
    """``d x (d - 1)`` orthonormal columns across a unit vector."""
    return torch.linalg.qr(way[:, None], mode="complete").Q[:, 1:]
