"""Damped, then quasi-Newton steps for chains on which Gauss-Newton converges slowly.

Gauss-Newton leaves out the curvature of the cost that comes from residuals. Where a model misses
the data they are tens of standard deviations, every step has to be damped, and a hundred do not
converge. BFGS estimates that curvature (Nocedal & Wright, Numerical Optimization, 2nd ed. 2006,
chapter 6). It begins in coordinates in which the Gauss-Newton Hessian is the identity, with the
solver steps of a leader for all bubbles, so that the cost is smooth (Bock, in: Modelling of
Chemical Reaction Systems, Springer 1981, freezes the steps of an integrator likewise). Far from the
leader these steps are too coarse and the cost has ripples, so that a point that moves away becomes
the next leader. A few damped Gauss-Newton steps, each with a leader of its own, come first: where
the way is long ten of them gain what a hundred points of BFGS do. The steps of another leader move
the minimum, by some hundredths of a posterior standard deviation and by a whole one where residuals
are tens of
them: a chain that ends close to its leader keeps it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, minimize
from torch import Tensor

from imr_torch.assimilate.chains import Chains, lowest_cost
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.options import SearchOptions
from imr_torch.assimilate.posterior import Neighbourhood, Posterior

Vector = NDArray[np.float64]

_ROUNDS = 8  # each with a new leader
_CLOSE = 0.1  # posterior standard deviations from a leader within which it is kept
_FAR, _FARTHER = (
    1.5,
    2.0,
)  # the same beyond which the first round ends, and the factor from round to round
_FINER = 0.25  # part of the tolerance of the gradient that these steps leave
_STEPS = 40  # in a round
_POINTS = 160  # in all rounds and before them, each with the points beside it for differences
_LAST = 6  # steps by the gradient alone
_DAMPING, _HARDER, _EASIER, _STUCK = 1e-2, 4.0, 3.0, 1e4  # of Levenberg-Marquardt steps
_DESCENT = 20  # of these at most; where the residuals bend the cost most, they crawl
_GAIN, _SMALL = 0.5, 2  # nats; they end once so many in succession gain less
_NOT_ARRIVED = 2  # iterations after a chain that did not arrive
_WALL = 1e10  # cost where a bubble fails: no step ends there


def polish_slow(
    searches: Sequence[Chains], options: SearchOptions
) -> tuple[list[Chains], SearchOptions | None]:
    """Lower the best two chains, of those that began, of each model that has not converged; also
    how to iterate them further.

    That is to convergence where a chain arrived at a minimum, else until its gradient is known;
    None where no chain was slow. Chains more than ``drop_behind`` above the lowest cost of all
    models are left as they are, and the second where the first did not arrive at a minimum: the two
    could not agree.
    """
    limit = lowest_cost(searches) + (
        math.inf if options.drop_behind is None else options.drop_behind
    )
    result = []
    ends = list[Polished]()
    for chains in searches:
        begun = ~chains.masking & chains.gradient.isfinite() & (chains.cost < limit)
        slow = begun & (chains.gradient > options.gradient) & (not _converged(chains, options))
        rows = torch.nonzero(slow)[:, 0]
        rows = rows[torch.argsort(chains.cost[rows])][:2]
        if rows.numel():
            own = [polish(chains.posterior, chains.point[int(rows[0])], options.gradient)]
            if len(rows) > 1 and own[0].arrived:
                own.append(polish(chains.posterior, chains.point[int(rows[1])], options.gradient))
            rows = rows[: len(own)]
            chains = chains.restarted(rows, _stacked([end.point for end in own]))
            leader = _stacked([end.leader for end in own])
            scale = torch.stack([end.scale for end in own])
            chains = chains.put(rows, leading=True, leader=leader, scale=scale)
            ends += own
        result.append(chains)
    if not ends:
        return result, None
    return result, options if any(end.arrived for end in ends) else replace(
        options, iterations=_NOT_ARRIVED
    )


def _converged(chains: Chains, options: SearchOptions) -> bool:
    """Whether two starts agree and one of them is at a minimum."""
    agreeing = chains.cost <= chains.lowest + options.agreement
    return int(agreeing.sum()) > 1 and bool((chains.gradient[agreeing] < options.gradient).any())


def _stacked(points: Sequence[Point]) -> Point:
    return Point(
        torch.stack([point.gel for point in points]),
        torch.stack([point.nuisances for point in points]),
    )


@dataclass(frozen=True)
class Polished:
    """Where quasi-Newton steps ended.

    Args:
        point: near a minimum of the cost, or as low as they came.
        leader: whose solver steps the bubbles take; the point itself where that was too far away.
        scale: ``d x d`` tensor, Cholesky factor of the gel's covariance there.
        arrived: whether it is near its leader.
    """

    point: Point
    leader: Point
    scale: Tensor
    arrived: bool


def polish(posterior: Posterior, point: Point, gradient: float) -> Polished:
    """Quasi-Newton steps from one point.

    Args:
        posterior: whose cost is lowered.
        point: where they begin.
        gradient: what is left is a fraction of this, posterior standard deviations.
    """
    point, scale, points = _descended(posterior, point, _POINTS)
    for number in range(_ROUNDS):
        whitened = _Whitened(posterior, point, scale, points)
        leader = point
        scale = whitened.chol
        try:
            end = _lowered(whitened, _FINER * gradient, _FAR * _FARTHER**number)
        except _NoneLeft:
            point = whitened.place(whitened.lowest[1])
            break
        point = whitened.place(end)
        points = whitened.left
        if np.linalg.norm(end) < _CLOSE:
            return Polished(point, leader, scale, arrived=True)
    return Polished(point, point, scale, arrived=False)


def _descended(posterior: Posterior, point: Point, points: int) -> tuple[Point, Tensor, int]:
    """Levenberg-Marquardt steps until they gain little; also the gel's scale there, and the points
    that are left.

    Every point leads its own bubbles and those of the steps tried from it: far from a minimum,
        costs behind one leader are
    those of its solver steps rather than of the model.
    """
    scale = torch.eye(posterior.size, dtype=torch.float64)
    damping = _DAMPING
    small = 0
    before = point
    for _ in range(min(_DESCENT, points)):
        near = posterior.neighbourhood(point, scale, leader=point)
        points = points - 1
        if not bool(torch.isfinite(near.log_joint)):  # its bubbles fail by steps of their own
            return before, scale, points
        scale = near.equations.posterior_chol
        tried, gain, damping = _stepped(near, damping)
        if gain <= 0.0:
            break
        before = point
        point = tried
        damping = damping / _EASIER
        small = small + 1 if gain < _GAIN else 0
        if small == _SMALL:
            break
    return point, scale, points


def _stepped(near: Neighbourhood, damping: float) -> tuple[Point, float, float]:
    """A step damped until it lowers the cost, what it gains, nats, and its damping.

    None that gains where none does.
    """
    point = near.point
    equations = near.equations
    while damping < _STUCK:
        gel, nuisances = equations.step(torch.tensor(damping, dtype=torch.float64))
        tried = Point(point.gel + gel, point.nuisances + nuisances)
        both = _stacked([point, tried])
        gain = float(
            near.posterior.log_joint(both, near.posterior.predict(both, bundled=True))[1]
            - near.log_joint
        )
        if gain > 0.0:
            return tried, gain, damping
        damping = max(damping, _DAMPING) * _HARDER
    return point, 0.0, damping


def _lowered(whitened: "_Whitened", tolerance: float, far: float) -> Vector:
    """BFGS from the leader until far from it.

    The last steps go by the gradient alone, where rounding hides a lower cost.
    """

    def stop(intermediate_result: OptimizeResult) -> None:
        if np.linalg.norm(intermediate_result.x) > far:
            raise StopIteration

    begin = np.zeros(whitened.size)
    options = {"gtol": tolerance, "maxiter": _STEPS}
    found = minimize(whitened, begin, jac=True, method="BFGS", callback=stop, options=options)
    end = found.x
    slope = found.jac
    for _ in range(_LAST):
        if np.abs(slope).max() < tolerance or np.linalg.norm(end) > far:
            break
        tried = end - found.hess_inv @ slope
        other = whitened(tried)[1]
        if not 0.0 < np.linalg.norm(other) < np.linalg.norm(slope):
            break
        end = tried
        slope = other
    return end


class _NoneLeft(Exception):
    """All points that were allowed have been simulated."""


class _Whitened:
    """The cost and its gradient about a point, in coordinates in which the Gauss-Newton Hessian
    there is the identity.

    Args:
        posterior: whose cost.
        leader: the point; its bubbles lead those of all others.
        scale: ``d x d`` tensor, in whose columns the gel is moved for differences.
        left: points that may be simulated.
    """

    def __init__(self, posterior: Posterior, leader: Point, scale: Tensor, left: int) -> None:
        self.posterior = posterior
        self.leader = leader
        self.scale = scale
        self.left = left
        self.size = posterior.size + leader.nuisances.shape[0] * len(posterior.uncertain)
        self.lowest = (math.inf, np.zeros(self.size))
        equations = self._at(leader).equations
        reduced = equations.reduced
        self.chol = equations.posterior_chol
        self.response = reduced.nuisance_response
        chol = torch.linalg.cholesky(equations.nuisance_hessian)
        eye = torch.eye(chol.shape[-1], dtype=torch.float64).expand_as(chol)
        self.nuisance_scale = torch.linalg.solve_triangular(chol.mT, eye, upper=True)

    def place(self, x: Vector) -> Point:
        """The point at coordinates."""
        own, others = torch.from_numpy(x).split(
            [self.posterior.size, self.size - self.posterior.size]
        )
        moved = self.chol @ own
        uncertain = self.posterior.uncertain
        white = torch.zeros_like(self.leader.nuisances)
        white[:, uncertain] = others.reshape(len(white), len(uncertain))
        nuisances = (
            self.leader.nuisances
            + self.response @ moved
            + (self.nuisance_scale @ white[..., None])[..., 0]
        )
        return Point(self.leader.gel + moved, nuisances)

    def __call__(self, x: Vector) -> tuple[float, Vector]:
        """Cost and gradient at coordinates."""
        if self.left <= 0:
            raise _NoneLeft
        self.left -= 1
        near = self._at(self.place(x))
        cost = -float(near.log_joint)
        if not np.isfinite(cost):
            return _WALL, np.zeros_like(x)
        if cost < self.lowest[0]:
            self.lowest = cost, x.copy()
        by_gel = near.equations.gel_gradient
        by_nuisance = near.equations.nuisance_gradient
        own = self.chol.mT @ (by_gel + (self.response.mT @ by_nuisance[..., None])[..., 0].sum(0))
        others = (self.nuisance_scale.mT @ by_nuisance[..., None])[..., 0][
            :, self.posterior.uncertain
        ]
        return cost, torch.cat((own, others.flatten())).numpy()

    def _at(self, point: Point) -> Neighbourhood:
        return self.posterior.neighbourhood(point, self.scale, leader=self.leader)
