"""The way down for a point at which Gauss-Newton crawls: quasi-Newton steps on the exact gradient.

Gauss-Newton does not know how residuals bend the cost. Where a model is plainly wrong they are tens of standard deviations,
every step has to be damped, and a hundred of them end nowhere. BFGS learns that curvature on its way (Nocedal & Wright,
Numerical Optimization, 2nd ed. 2006, chapter 6). It begins in coordinates in which the Gauss-Newton Hessian is the identity.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from imr_torch.assimilate.cost import equations_at, joint_cost, sides, uncertain
from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.problem import Problem

Vector = NDArray[np.float64]

NEAR = 0.01
"""Posterior standard deviations from a minimum at which Gauss-Newton arrives by itself."""

_ROUNDS = 3  # each behind a leader of its own: far from it the cost is rough
_STEPS = 80
_WALL = 1e10  # cost where a bubble fails: no step ends there


def polish(problem: Problem, model: Tensor, gel: Tensor, nuisances: Tensor, spread: float) -> tuple[Tensor, Tensor]:
    """Lower the joint cost of some points, one after the other.

    Args:
        problem: what is lowered.
        model: ``C`` tensor, the model of each point.
        gel: ``C x size`` tensor, controls.
        nuisances: ``C x E x 3`` tensor.
        spread: step of the differences over the gel, posterior standard deviations.

    Returns:
        Gels and nuisances where the points ended, near a minimum or as low as they came.
    """
    rows = [_lower(problem, *point, spread) for point in zip(model, gel, nuisances, strict=True)]
    gels, shifts = zip(*rows, strict=True)
    return torch.stack(gels), torch.stack(shifts)


def _lower(problem: Problem, model: Tensor, gel: Tensor, nuisances: Tensor, spread: float) -> tuple[Tensor, Tensor]:
    """Where the steps from one point end."""
    scale = torch.eye(problem.size, dtype=torch.float64) * spread
    for _ in range(_ROUNDS):
        whitened = _Whitened(problem, model, gel, nuisances, scale)
        if whitened.near:
            break
        scale = spread * whitened.chol
        still = np.zeros(problem.size + nuisances.shape[0] * len(whitened.columns))
        found = minimize(whitened, still, jac=True, method="BFGS", options={"gtol": NEAR, "maxiter": _STEPS})
        gel, nuisances = whitened.place(found.x)
    return gel, nuisances


class _Whitened:
    """The joint cost and its gradient about a point, in coordinates that are whitened there.

    Args:
        problem: what is lowered.
        model: of the point.
        gel: ``size`` tensor, the point's controls; its bubbles lead those of all others.
        nuisances: ``E x 3`` tensor.
        anomalies: ``size x size`` tensor, whose columns move the gel for differences.
    """

    def __init__(self, problem: Problem, model: Tensor, gel: Tensor, nuisances: Tensor, anomalies: Tensor) -> None:
        self.problem, self.model, self.gel, self.nuisances = problem, model, gel, nuisances
        self.columns, self.sides = uncertain(problem.batch), sides(problem.batch)
        self.anomalies = anomalies.mT
        equations = self._equations(gel, nuisances)[1]
        reduced = equations.reduced
        self.near = float(equations.whitened_gradient) < NEAR
        self.chol = equations.posterior_chol[0]
        self.response = reduced.nuisance_response[0]
        chol = torch.linalg.cholesky(equations.nuisance_hessian[0])
        eye = torch.eye(chol.shape[-1], dtype=torch.float64).expand_as(chol)
        self.nuisance_scale = torch.linalg.solve_triangular(chol.mT, eye, upper=True)

    def place(self, x: Vector) -> tuple[Tensor, Tensor]:
        """Gel and nuisances at coordinates."""
        own, others = torch.from_numpy(x).split([len(self.gel), len(x) - len(self.gel)])
        moved = self.chol @ own
        white = torch.zeros_like(self.nuisances)
        white[:, self.columns] = others.reshape(len(white), len(self.columns))
        return self.gel + moved, self.nuisances + self.response @ moved + (self.nuisance_scale @ white[..., None])[..., 0]

    def __call__(self, x: Vector) -> tuple[float, Vector]:
        """Cost and gradient at coordinates."""
        cost, equations = self._equations(*self.place(x))
        if not np.isfinite(cost):
            return _WALL, np.zeros_like(x)
        by_gel, by_nuisance = equations.gel_gradient[0], equations.nuisance_gradient[0]
        own = self.chol.mT @ (by_gel + (self.response.mT @ by_nuisance[..., None])[..., 0].sum(0))
        others = (self.nuisance_scale.mT @ by_nuisance[..., None])[..., 0][:, self.columns]
        return cost, torch.cat((own, others.flatten())).numpy()

    def _equations(self, gel: Tensor, nuisances: Tensor) -> tuple[float, NormalEquations]:
        """Cost and normal equations at a point, behind the leader."""
        count, size = len(self.sides), len(self.anomalies)
        gels = torch.cat((self.gel[None], gel[None], gel + self.anomalies, gel.expand(count, -1)))
        shifts = torch.cat((self.nuisances[None], nuisances[None], nuisances.expand(size, -1, -1), nuisances + self.sides))
        made = self.problem.predict(self.model[None], gels[None], shifts[None], bundled=True)[:, 1:]
        cost = joint_cost(self.problem.batch, gel[None], nuisances[None], made[:, 0])
        return float(cost), equations_at(self.problem.batch, gel[None], nuisances[None], self.anomalies[None], made)
