"""One linearly implicit step of a stiff differential-algebraic system, with a step of each member's
own.

A Rosenbrock method replaces the Newton iteration of an implicit Runge-Kutta method by linear
systems with one exact Jacobian a step (Hairer & Wanner, Solving Ordinary Differential Equations II,
2nd ed. 1996, sections IV.7 and VI.4; in the form that avoids products with the Jacobian). Rodas4P
is stiffly accurate, of order 4 with an embedded method of order 3, and keeps its order for
parabolic equations with boundary values that change (Steinebach, preprint 1741, TH Darmstadt 1995).
"""

import torch

from imr_torch.simulate.linearise import linearise_equations
from imr_torch.simulate.rhs import Equations
from imr_torch.types import BubbleStates, BubbleValues

GAMMA = 0.25
"""Diagonal coefficient of Rodas4P."""
ORDER = 4
"""Of the embedded method plus one; the step controller's exponent is its inverse."""
_LAST = (-7.170454962423024, -4.741636671481785, -16.31002631330971, -1.062004044111401)
STAGES = (
    (3.0,),
    (1.831036793486759, 0.4955183967433795),
    (2.304376582692669, -0.05249275245743001, -1.176798761832782),
    _LAST,
    (*_LAST, 1.0),
)
"""Row ``i`` weighs the earlier increments in the argument of stage ``i + 1``. The last stage is the
error estimate; its argument plus itself is the new state."""
COUPLING = (
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
)
"""Row ``i`` weighs the earlier increments, over the step, on its right-hand side."""


def _follow_time() -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Over the step: the increments of time itself, and the time at which each stage takes the
    right-hand side. Time is a state of rate 1, so they follow from the method's own recursion.
    """
    increments = [GAMMA]
    moments = [0.0]
    for weights, coupling in zip(STAGES, COUPLING, strict=True):
        moments.append(sum(a * u for a, u in zip(weights, increments, strict=True)))
        more = sum(c * u for c, u in zip(coupling, increments, strict=True))
        increments.append(GAMMA * (1.0 + more))
    return tuple(increments), tuple(moments)


TIME_INCREMENTS, MOMENTS = _follow_time()


def rosenbrock_step(
    equations: Equations,
    state: BubbleStates,
    step: BubbleValues,
    time: BubbleValues | None = None,
) -> tuple[BubbleStates, BubbleStates]:
    """Advance every member by its own step of Rodas4P.

    Args:
        equations: the system.
        state: ``nx x B`` tensor.
        step: ``B`` tensor.
        time: of each member before the step; matters where the far field is driven.

    Returns:
        The state after the step, and an estimate of its error.
    """
    moment = torch.zeros_like(step) if time is None else time
    fields = equations.fields(state, moment)
    jacobian, velocity_time = linearise_equations(equations, fields)
    inverse_step = (1.0 / step).repeat(equations.rows, 1)
    inverse_step[3] = 0.0  # tau_w is algebraic
    matrix = jacobian.permute(2, 0, 1).neg()
    matrix.diagonal(dim1=1, dim2=2).add_(inverse_step.T / GAMMA)
    factors, pivots, _ = torch.linalg.lu_factor_ex(matrix)
    increments = state.new_empty(len(STAGES) + 1, *state.shape)
    argument = state
    for i, moved in enumerate(MOMENTS):
        if i == 0:
            right = equations.rate(fields)
        else:
            weights = state.new_tensor((STAGES[i - 1], COUPLING[i - 1]))
            offset, coupling = (weights @ increments[:i].flatten(1)).reshape(2, *state.shape)
            argument = state + offset
            right = equations.rate(equations.fields(argument, moment + moved * step))
            right.addcmul_(coupling, inverse_step)
        right[1] += velocity_time * step * TIME_INCREMENTS[i]
        increments[i] = torch.linalg.lu_solve(factors, pivots, right.T[:, :, None])[:, :, 0].T
    return argument + increments[-1], increments[-1]
