"""A proposal distribution along a curved ridge of the posterior, where one direction is poorly
determined.

Two parameters that do much the same to R(t) (G and alpha, say) leave a posterior many times as long
as it is wide, and curved over that length. A Gaussian does not follow it, and kernels about draws
of that Gaussian do not reach its ends. So it is followed step by step (continuation by
pseudo-arclength: Keller 1977), the other controls and the nuisances being fitted at each point (a
profile likelihood, as in Raue et al., Bioinformatics 25, 2009), until the profile has fallen by
``_DEEP`` on both sides. Kernels on the points, each along and as wide as the ridge is there, are
the proposal.

It need not be exact, since every draw is weighted. Used for fits whose Gaussian was not confirmed.
"""

import math
from dataclasses import dataclass, replace

import torch
from scipy.interpolate import krogh_interpolate
from torch import Tensor

from imr_torch.assimilate.fit import ModelFit
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.posterior import Neighbourhood, Posterior
from imr_torch.assimilate.proposals import Kernels

_DEEP = 8.0  # nats by which the profile falls at the ends
_ATTEMPTS = 24  # most points that are tried on either side of the optimum
_SHORTEST = 1.0 / 16.0  # posterior standard deviations between points; the most is one
_BENT = 1.0  # nats by which a point may lie off the straight line through the two before
_PASSES = 4  # most Gauss-Newton steps at one point
_NEAR = 0.3  # predicted decrease of the next step, nats, below which a point is taken as fitted
_LOST = 3.0  # nats of that from which a point is no part of the ridge
_OVERLAP = 0.7  # scale of a kernel along the ridge over the distance of its neighbours
_WIDE_SHARE = 0.1  # of a wide kernel about all


@dataclass(frozen=True)
class _Fitted:
    """A point on a ridge.

    Args:
        point: where.
        cost: of the joint cost's optimum at this place along the ridge, nats.
        promised: nats by which the last step is predicted to lower it, included in ``cost``;
            infinite where a bubble failed.
        hessian: ``d x d`` tensor, of the cost, nuisances eliminated.
        nuisance_log_det: log determinant of the nuisances' own Hessian.
    """

    point: Point
    cost: float
    promised: float
    hessian: Tensor
    nuisance_log_det: float


class _Side:
    """One side of a ridge as far as it was followed, from the optimum outwards.

    Args:
        fit: whose ridge it is.
        direction: ``d`` tensor, in which the first step is taken; its length is the longest step.
    """

    def __init__(self, fit: ModelFit, direction: Tensor) -> None:
        self.fit = fit
        self._longest = float(direction.norm())
        self._first = direction / self._longest
        self._length = self._longest
        hessian = torch.cholesky_inverse(fit.chol)
        self.points = [_Fitted(fit.point, fit.cost, 0.0, hessian, fit.nuisance_log_det)]
        self._attempts = 0
        self.ended = False

    def ahead(self) -> tuple[_Fitted, Tensor]:
        """Where the next point is expected, and the unit vector along the ridge there (``d``)."""
        last = self.points[-1]
        if len(self.points) == 1:
            step = self._length * self._first
            guess = Point(
                last.point.gel + step, last.point.nuisances + self.fit.nuisance_response @ step
            )
            return replace(last, point=guess), self._first
        near = [p.point for p in self.points[-3:]]
        gels = torch.stack([p.gel for p in near])
        nuisances = torch.stack([p.nuisances for p in near])
        places = torch.cat((gels.new_zeros(1), gels.diff(dim=0).norm(dim=1).cumsum(0)))
        there = float(places[-1]) + self._length
        guess = Point(
            *(
                torch.as_tensor(krogh_interpolate(places.numpy(), values.numpy(), there))
                for values in (gels, nuisances)
            )
        )
        return replace(last, point=guess), torch.nn.functional.normalize(
            guess.gel - last.point.gel, dim=0
        )

    def add(self, point: _Fitted, least: float) -> None:
        """Take a fitted point for the next one, or try again nearer.

        ``least`` is the lowest cost on the whole ridge.
        """
        self._attempts += 1
        bent = self._bend(point)
        if point.promised < _LOST and bent < _BENT:
            self.points.append(point)
            self._length = (
                min(2.0 * self._length, self._longest) if bent < 0.1 * _BENT else self._length
            )
            self.ended = point.cost > least + _DEEP or self._attempts >= _ATTEMPTS
        else:
            self._length *= 0.5
            self.ended = self._length < _SHORTEST * self._longest or self._attempts >= _ATTEMPTS

    def _bend(self, point: _Fitted) -> float:
        """How far off the straight line on a point lies, nats."""
        last = self.points[-1].point.gel
        step = point.point.gel - self.points[-1].point.gel
        before = self._first
        if len(self.points) > 1:
            before = torch.nn.functional.normalize(last - self.points[-2].point.gel, dim=0)
        off = step - before * (before @ step)
        return 0.5 * float(off @ point.hessian @ off)


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
    below = _Side(fit, -axis)
    above = _Side(fit, axis)
    while fronts := [side for side in (below, above) if not side.ended]:
        for side in fronts:
            point = _fitted(posterior, *side.ahead())
            side.add(point, min(p.cost for p in (*below.points, *above.points)))
    return _kernels([*reversed(below.points), *above.points[1:]], fit)


def _fitted(posterior: Posterior, point: _Fitted, along: Tensor) -> _Fitted:
    """A point fitted across the ridge, as far as a few steps go."""
    for _ in range(_PASSES):
        point = _stepped(point, along, posterior.neighbourhood(point.point))
        if not _NEAR < point.promised < math.inf:
            break
    return point


def _kernels(points: list[_Fitted], fit: ModelFit) -> Kernels:
    """A kernel on each point of a ridge, in order."""
    if len(points) < 3:
        return Kernels.about(fit.mean, fit.chol)
    gels = torch.stack([p.point.gel for p in points])
    steps = gels.diff(dim=0)
    ways = torch.nn.functional.normalize(
        torch.cat((steps[:1], gels[2:] - gels[:-2], steps[-1:])), dim=1
    )
    lengths = steps.norm(dim=1)
    spacing = 0.5 * torch.cat((2.0 * lengths[:1], lengths[1:] + lengths[:-1], 2.0 * lengths[-1:]))
    across = torch.stack([_across(way) for way in ways])  # J x d x (d - 1)
    hessian = torch.stack([p.hessian for p in points])
    inside = torch.linalg.inv(across.mT @ hessian @ across)
    flat = across @ inside @ across.mT
    line = ways[:, :, None] * ways[:, None, :]
    chols = torch.linalg.cholesky(flat + (_OVERLAP * spacing).square()[:, None, None] * line)
    cost = torch.tensor([p.cost + 0.5 * p.nuisance_log_det for p in points], dtype=torch.float64)
    weights = torch.softmax(
        0.5 * torch.linalg.slogdet(inside).logabsdet + spacing.log() - cost, dim=0
    )
    mean = weights @ gels
    covariance = (weights[:, None] * (gels - mean)).mT @ (gels - mean) + (
        weights[:, None, None] * flat
    ).sum(0)
    return Kernels(
        gels, weights, chols, mean, torch.linalg.cholesky(covariance), hessian
    ).with_wide_kernel(_WIDE_SHARE)


def _across(way: Tensor) -> Tensor:
    """``d x (d - 1)`` orthonormal columns across a unit vector."""
    return torch.linalg.qr(way[:, None], mode="complete").Q[:, 1:]


def _stepped(fitted: _Fitted, along: Tensor, near: Neighbourhood) -> _Fitted:
    """A point after a Gauss-Newton step across the ridge, with the cost predicted from its local
    sensitivities.
    """
    if not bool(torch.isfinite(near.prediction).all()):
        return replace(fitted, promised=math.inf)
    equations = near.equations
    across = _across(along)
    reduced = equations.reduced
    gradient = across.mT @ reduced.gradient
    hessian = across.mT @ reduced.hessian @ across
    step = across @ -torch.linalg.solve(hessian, gradient)
    promised = -0.5 * float(reduced.gradient @ step) - 0.5 * float(
        (equations.nuisance_gradient * reduced.nuisance_step).sum()
    )
    nuisances = near.point.nuisances + reduced.nuisance_step + reduced.nuisance_response @ step
    return _Fitted(
        point=Point(near.point.gel + step, nuisances),
        cost=-float(near.log_joint) - promised,
        promised=promised,
        hessian=reduced.hessian,
        nuisance_log_det=float(reduced.nuisance_log_det),
    )
