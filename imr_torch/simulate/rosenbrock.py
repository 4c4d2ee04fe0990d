"""One linearly implicit step of a stiff differential-algebraic system, with a step of each member's
own.

A Rosenbrock method replaces the Newton iteration of an implicit Runge-Kutta method by linear
systems with one exact Jacobian a step (Hairer & Wanner, Solving Ordinary Differential Equations II,
2nd ed. 1996, sections IV.7 and VI.4; in the form that avoids products with the Jacobian). Rodas4P
is stiffly accurate, of order 4 with an embedded method of order 3, and keeps its order for
parabolic equations with boundary values that change (Steinebach, preprint 1741, TH Darmstadt 1995).
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.simulate.bordered import Factors
from imr_torch.simulate.linearise import linearise
from imr_torch.simulate.rhs import Equations


@dataclass(frozen=True)
class Tableau:
    """Coefficients of a stiffly accurate Rosenbrock method.

    Args:
        gamma: diagonal coefficient.
        stages: row ``i`` weighs the earlier increments in the argument of stage ``i + 1``.
        coupling: row ``i`` weighs the earlier increments, over the step, on its right-hand side.
        order: of the embedded method plus one; the step controller's exponent is its inverse.
    """

    gamma: float
    stages: tuple[tuple[float, ...], ...]
    coupling: tuple[tuple[float, ...], ...]
    order: int

    @cached_property
    def ticks(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Over the step: the increments of time itself, and the time at which each stage takes the
        right-hand side.

        Time is a state of rate 1, so its increments follow from the method's own recursion.
        """
        increments = [self.gamma]
        moments = [0.0]
        for weights, coupling in zip(self.stages, self.coupling, strict=True):
            moments.append(sum(a * u for a, u in zip(weights, increments, strict=True)))
            increments.append(
                self.gamma * (1.0 + sum(c * u for c, u in zip(coupling, increments, strict=True)))
            )
        return tuple(increments), tuple(moments)


_LAST = (-7.170454962423024, -4.741636671481785, -16.31002631330971, -1.062004044111401)

RODAS4P = Tableau(
    gamma=0.25,
    stages=(
        (3.0,),
        (1.831036793486759, 0.4955183967433795),
        (2.304376582692669, -0.05249275245743001, -1.176798761832782),
        _LAST,
        (*_LAST, 1.0),
    ),
    coupling=(
        (-12.0,),
        (-8.791795173947035, -2.207865586973518),
        (10.81793056857153, 6.780270611428266, 19.53485944642410),
        (34.19095006749676, 15.49671153725963, 54.74760875964130, 14.16005392148534),
        (
            34.62605830930532,
            15.30084976114473,
            56.99955578662667,
            18.40807009793095,
            -5.714285714285717,
        ),
    ),
    order=4,
)
"""The last stage is the error estimate; its argument plus itself is the new state."""


@dataclass(frozen=True)
class Step:
    """What one step gave.

    Args:
        state: the state after the step.
        error: estimate of its error.
        acceleration: ``U'`` before the step.
        pressure_rate: ``dP/dt`` before the step.
    """

    state: Float[Tensor, "state members"]
    error: Float[Tensor, "state members"]
    acceleration: Float[Tensor, "members"]
    pressure_rate: Float[Tensor, "members"]


def rosenbrock_step(
    equations: Equations,
    state: Float[Tensor, "state members"],
    step: Float[Tensor, "members"],
    time: Float[Tensor, "members"] | None = None,
    tableau: Tableau = RODAS4P,
) -> Step:
    """Advance every member by its own step.

    Args:
        equations: the system.
        state: ``nx x B`` tensor.
        step: ``B`` tensor.
        time: of each member before the step; matters where the far field is driven.
        tableau: the method.
    """
    driven = equations.bubbles.driven
    moment = torch.zeros_like(step) if time is None else time
    increments_of_time, moments = tableau.ticks
    fields = equations.fields(state, moment)
    known, jacobian = linearise(equations, fields)
    inside = equations.inside.first
    outside = equations.outside.first
    shift = 1.0 / (tableau.gamma * step)
    factors = Factors(jacobian, shift, inside[1:, 1:], inside[0, 1:], outside[0, 1:])
    inverse_step = (1.0 / step).repeat(equations.rows, 1)
    inverse_step[3] = 0.0  # tau_w is algebraic
    increments = state.new_empty(len(tableau.stages) + 1, *state.shape)
    right = equations.rate(fields, known)
    if driven:
        right[1] += jacobian.velocity_time * step * increments_of_time[0]
    increments[0] = factors.solve(right)
    argument = state
    for i, weights in enumerate(zip(tableau.stages, tableau.coupling, strict=True), start=1):
        rows = torch.tensor(weights, dtype=state.dtype, device=state.device)
        offset, coupling = (rows @ increments[:i].flatten(1)).reshape(2, *state.shape)
        argument = state + offset
        right = equations.rate(
            equations.fields(argument, moment + moments[i] * step if driven else None)
        )
        right.addcmul_(coupling, inverse_step)
        if driven:
            right[1] += jacobian.velocity_time * step * increments_of_time[i]
        increments[i] = factors.solve(right)
    return Step(argument + increments[-1], increments[-1], known[0], fields.rate)
