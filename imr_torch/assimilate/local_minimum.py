"""Local minima of the cost: a trust region of SciPy on a smooth function.

Solves that each choose their own steps differ by some 1e-4 in R*, which makes the cost rough. So
the bubbles of a descent take the solver steps of one point, its *leader* (Bock, in: Modelling of
Chemical Reaction Systems, Springer 1981, freezes the steps of an integrator likewise): the cost is
then smooth, with exact gradients, and starts that share a leader can be compared. A descent that
ends far from its leader is continued with the point where it ended as the next one.

The Hessian is that of Gauss and Newton, with the curvature from residuals and second derivatives of
predictions estimated from the sensitivities along the way (a secant update of the part that
Gauss-Newton leaves out, as in Dennis, Gay & Welsch, ACM Trans. Math. Softw. 7, 1981, section 3, by
the symmetric rank-one formula). Where a model misses the data by tens of standard deviations that
part is as large as the other.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, minimize

from imr_torch.assimilate.fit import PROMISED
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.posterior import Neighbourhood, Posterior

Vector = NDArray[np.float64]
Report = Callable[["Descent"], None]


@dataclass(frozen=True)
class Descent:
    """Where a descent ended.

    Args:
        near: the point and those beside it.
        leader: whose solver steps the bubbles took; None where each took its own.
        iterations: of the trust region, earlier descents of the same start included.
    """

    near: Neighbourhood
    leader: Point | None
    iterations: int = 0

    @property
    def equations(self) -> NormalEquations:
        """Gauss-Newton equations there."""
        return self.near.equations

    @property
    def failed_share(self) -> float:
        """Share of the bubbles at the end and beside it that failed."""
        return float((~self.near.prediction.isfinite()).any(-1).double().mean())

    @property
    def point(self) -> Point:
        """The point."""
        return self.near.point

    @cached_property
    def cost(self) -> float:
        """Nats; infinite where no bubble could be simulated."""
        return -float(self.near.log_joint)

    @cached_property
    def gradient(self) -> float:
        """Length of the gradient in posterior standard deviations."""
        return (
            float(self.equations.whitened_gradient)
            if math.isfinite(self.cost)
            else math.inf
        )

    def distance_to(self, point: Point) -> float:
        """Distance of another point's gel, posterior standard deviations."""
        gap = (point.gel - self.point.gel)[:, None]
        chol = self.equations.posterior_chol
        return float(torch.linalg.solve_triangular(chol, gap, upper=False).norm())


def descend_from(
    posterior: Posterior,
    point: Point,
    leader: Point | None,
    *,
    gradient: float,
    iterations: int,
    reach: float = math.inf,
    limit: float = math.inf,
    failures: int = 3,
    report: Report | None = None,
) -> Descent:
    """Lower the cost from one point until its gradient is small.

    Args:
        posterior: of one model.
        point: where it begins; one point.
        leader: whose solver steps all bubbles take; None for steps of their own.
        gradient: length of the gradient at which it ends, posterior standard deviations.
        iterations: most iterations.
        reach: distance from the start at which it ends, posterior standard deviations.
        limit: cost above which it ends, nats, after the decrease that the gradient allows.
        failures: steps in succession that may fail to lower the cost.
        report: called after each iteration with the lowest point.
    """
    cost = _FrozenCost(posterior, point, leader)
    first = cost.lowest
    number = 0
    if report:
        report(first)

    def stop_when_done(intermediate_result: OptimizeResult) -> None:
        nonlocal number
        number += 1
        now = cost.lowest
        slope = now.gradient
        if report:
            report(now)
        if (
            slope < gradient
            or cost.failures >= failures
            or now.cost - PROMISED * slope**2 > limit
            or (reach < math.inf and now.distance_to(point) > reach)
        ):
            raise StopIteration

    if math.isfinite(first.cost) and first.gradient >= gradient and iterations > 0:
        minimize(
            cost,
            cost.x,
            jac=cost.gradient_at,
            hess=cost.hessian_at,
            method="trust-exact",
            callback=stop_when_done,
            options={
                "gtol": 0.0,
                "maxiter": iterations,
                "initial_trust_radius": 1.0,
                "max_trust_radius": 4.0,
            },
        )
    return replace(cost.lowest, iterations=number)


class _FrozenCost:
    """The cost, its gradient and its Hessian over all coordinates of gel and uncertain nuisances.

    Args:
        posterior: whose cost.
        point: where it is asked for first.
        leader: whose solver steps the bubbles take.
    """

    def __init__(self, posterior: Posterior, point: Point, leader: Point | None) -> None:
        self.posterior = posterior
        self.leader = leader
        self.failures = 0
        self.x = posterior.coordinates_of(point).numpy()
        self.last = self.lowest = self._simulate_at(self.x)
        self.bend = np.zeros((len(self.x), len(self.x)))

    def _simulate_at(self, x: Vector) -> Descent:
        near = self.posterior.neighbourhood(
            self.posterior.point_at(torch.tensor(x)), leader=self.leader
        )
        return Descent(near, self.leader)

    def _recall_at(self, x: Vector) -> Descent:
        """What is at coordinates; of those where no bubble can be simulated, what was lowest."""
        if not np.array_equal(x, self.x):
            self.x = x.copy()
            self.last = self._simulate_at(x)
            self.failures += 1
            if self.last.cost < self.lowest.cost:
                self.failures = 0
                before, self.lowest = self.lowest, self.last
                if self.leader is not None:
                    self._update_curvature(before.near, self.last.near)
        return self.last if math.isfinite(self.last.cost) else self.lowest

    def __call__(self, x: Vector) -> float:
        """The cost; where a bubble fails so large that no step ends there."""
        self._recall_at(x)
        return min(self.last.cost, 1e10)

    def gradient_at(self, x: Vector) -> Vector:
        """The gradient."""
        return self._recall_at(x).equations.joint_gradient(self.posterior.uncertain).numpy()

    def hessian_at(self, x: Vector) -> Vector:
        """The Hessian."""
        return (
            self._recall_at(x).equations.joint_hessian(self.posterior.uncertain).numpy()
            + self.bend
        )

    def _update_curvature(self, old: Neighbourhood, new: Neighbourhood) -> None:
        """Update the curvature that Gauss-Newton leaves out by a step (symmetric rank one)."""
        slope = self.posterior.likelihood_slope(new.centre)
        change = ((new.jacobian - old.jacobian) * slope).sum((1, 2)).numpy()
        step = (new.coordinates - old.coordinates).numpy()
        missed = change - self.bend @ step
        along = missed @ step
        if abs(along) > 1e-8 * np.linalg.norm(missed) * np.linalg.norm(step):
            self.bend = self.bend + np.outer(missed, missed) / along
