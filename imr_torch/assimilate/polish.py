"""Quasi-Newton steps for chains on which Gauss-Newton converges slowly.

Gauss-Newton leaves out the curvature of the cost that comes from residuals. Where a model misses the data they are tens of
standard deviations, every step has to be damped, and a hundred do not converge. BFGS estimates that curvature (Nocedal &
Wright, Numerical Optimization, 2nd ed. 2006, chapter 6). It begins in coordinates in which the Gauss-Newton Hessian is the
identity.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from imr_torch.assimilate.chains import Chains, lowest_cost
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.options import SearchOptions
from imr_torch.assimilate.posterior import Neighbourhood, Posterior

Vector = NDArray[np.float64]

NEAR = 0.01
"""Posterior standard deviations from a minimum from which Gauss-Newton converges by itself."""

_ROUNDS = 3  # each with a new leader: far from it the cost is not smooth
_STEPS = 80
_WALL = 1e10  # cost where a bubble fails: no step ends there


def polish_slow(searches: Sequence[Chains], options: SearchOptions) -> tuple[list[Chains], bool]:
    """Lower the best two chains of each model that have not converged, and say whether there are any.

    Chains more than ``drop_behind`` above the lowest cost of all models are left as they are.
    """
    limit = lowest_cost(searches) + (math.inf if options.drop_behind is None else options.drop_behind)
    result, polished = [], False
    for chains in searches:
        slow = ~chains.finished & ~chains.masking & (chains.gradient > NEAR) & (chains.cost < limit)
        rows = torch.nonzero(slow)[:, 0]
        rows = rows[torch.argsort(chains.cost[rows])][:2]
        if rows.numel():
            ends = [polish(chains.posterior, chains.point[row]) for row in rows.tolist()]
            point = Point(torch.stack([end.gel for end in ends]), torch.stack([end.nuisances for end in ends]))
            chains, polished = chains.restarted(rows, point), True
        result.append(chains)
    return result, polished


def polish(posterior: Posterior, point: Point) -> Point:
    """Where quasi-Newton steps from one point end: near a minimum of the cost, or as low as they came."""
    scale = torch.eye(posterior.size, dtype=torch.float64)
    for _ in range(_ROUNDS):
        whitened = _Whitened(posterior, point, scale)
        if whitened.near:
            break
        scale = whitened.chol
        still = np.zeros(posterior.size + point.nuisances.shape[0] * len(posterior.uncertain))
        found = minimize(whitened, still, jac=True, method="BFGS", options={"gtol": NEAR, "maxiter": _STEPS})
        point = whitened.place(found.x)
    return point


class _Whitened:
    """The cost and its gradient about a point, in coordinates in which the Gauss-Newton Hessian there is the identity.

    Args:
        posterior: whose cost.
        leader: the point; its bubbles lead those of all others.
        scale: ``d x d`` tensor, in whose columns the gel is moved for differences.
    """

    def __init__(self, posterior: Posterior, leader: Point, scale: Tensor) -> None:
        self.posterior, self.leader, self.scale = posterior, leader, scale
        equations = self._at(leader).equations
        reduced = equations.reduced
        self.near = float(equations.whitened_gradient) < NEAR
        self.chol, self.response = equations.posterior_chol, reduced.nuisance_response
        chol = torch.linalg.cholesky(equations.nuisance_hessian)
        eye = torch.eye(chol.shape[-1], dtype=torch.float64).expand_as(chol)
        self.nuisance_scale = torch.linalg.solve_triangular(chol.mT, eye, upper=True)

    def place(self, x: Vector) -> Point:
        """The point at coordinates."""
        own, others = torch.from_numpy(x).split([self.posterior.size, len(x) - self.posterior.size])
        moved, uncertain = self.chol @ own, self.posterior.uncertain
        white = torch.zeros_like(self.leader.nuisances)
        white[:, uncertain] = others.reshape(len(white), len(uncertain))
        nuisances = self.leader.nuisances + self.response @ moved + (self.nuisance_scale @ white[..., None])[..., 0]
        return Point(self.leader.gel + moved, nuisances)

    def __call__(self, x: Vector) -> tuple[float, Vector]:
        """Cost and gradient at coordinates."""
        near = self._at(self.place(x))
        cost = -float(near.log_joint)
        if not np.isfinite(cost):
            return _WALL, np.zeros_like(x)
        by_gel, by_nuisance = near.equations.gel_gradient, near.equations.nuisance_gradient
        own = self.chol.mT @ (by_gel + (self.response.mT @ by_nuisance[..., None])[..., 0].sum(0))
        others = (self.nuisance_scale.mT @ by_nuisance[..., None])[..., 0][:, self.posterior.uncertain]
        return cost, torch.cat((own, others.flatten())).numpy()

    def _at(self, point: Point) -> Neighbourhood:
        return self.posterior.neighbourhood(point, self.scale, leader=self.leader)
