"""One linearly implicit step of a stiff differential-algebraic system, with a step of each member's
own, and the control of its length by a scaled error estimate.

A Rosenbrock method replaces the Newton iteration of an implicit Runge-Kutta method by linear
systems with one exact Jacobian a step (Hairer & Wanner, Solving Ordinary Differential Equations II,
2nd ed. 1996, sections IV.7 and VI.4; in the form that avoids products with the Jacobian). Rodas4P
is stiffly accurate, of order 4 with an embedded method of order 3, and keeps its order for
parabolic equations with boundary values that change (Steinebach, preprint 1741, TH Darmstadt 1995).

The scaled errors of ``R``, ``U``, ``ln P``, the gel's memory and of the fields (root mean square,
temperatures at a lower weight) must stay below the tolerance; steps then change by ``0.8
err^(-1/4)`` (Hairer & Wanner 1996, section IV.8). In place of the largest of them their 4-norm is
used: as large, within a tenth or two, but smooth, and so are then the steps as functions of the
bubble, which makes derivatives of the discrete solution three times as accurate.
"""

import torch
from torch import Tensor

from imr_torch.simulate.linearise import linearise_equations
from imr_torch.simulate.rhs import HEAD, Equations
from imr_torch.types import BubbleStates, BubbleValues

GAMMA = 0.25
"""Diagonal coefficient of Rodas4P."""
ORDER = 4
"""Of the embedded method plus one; the step controller's exponent is its inverse."""
SAFETY, SHRINK, GROW = (
    0.8,
    0.1,
    3.0,
)  # steps change by SAFETY err^(-1/4), within SHRINK and GROW
HEAT_WEIGHT = 0.3  # of temperatures beside R, U, ln P and vapour
FIRST_STEP = 1e-3  # of every member
UNDERFLOW = 1e-14  # step over time below which a member is given up
REST = 0.3  # keeps a bubble's time scale finite where nothing moves
PATIENCE = 1.1  # a leader goes on beyond its last time, by so much at most, until its followers arrive
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
    time: BubbleValues,
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
    fields = equations.fields(state, time)
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
            offset, coupling = (weights @ increments[:i].flatten(1)).reshape(
                2, *state.shape
            )
            argument = state + offset
            right = equations.rate(equations.fields(argument, time + moved * step))
            right.addcmul_(coupling, inverse_step)
        right[1] += velocity_time * step * TIME_INCREMENTS[i]
        increments[i] = torch.linalg.lu_solve(factors, pivots, right.T[:, :, None])[
            :, :, 0
        ].T
    return argument + increments[-1], increments[-1]


def scaled_error(
    before: BubbleStates,
    after: BubbleStates,
    error: BubbleStates,
    equations: Equations,
    tolerance: float,
) -> BubbleValues:
    """Scaled error of a step, a ``B`` tensor: at most 1 if the step may be accepted, infinite or
    NaN if it failed.

    Args:
        before: the state before the step.
        after: the state after it.
        error: its estimated error.
        equations: the system, which knows the layout of the state.
        tolerance: relative error allowed in a step.
    """
    radius = after[0]
    inner = slice(HEAD, HEAD + equations.n)
    pressure = 1.0 + torch.exp(after[2])
    speed = after[1].abs() + 0.1 * torch.sqrt(pressure)
    sizes = (equations.n, equations.n, equations.m, equations.memory)
    heat, vapour, gel, memory = error[HEAD:].split(sizes)
    hottest = 0.1 + torch.maximum(before[inner].abs().amax(0), after[inner].abs().amax(0))
    warmest = 0.01 + after[3].abs()
    scaled = torch.stack(
        (
            error[0].abs() / radius,
            error[1].abs() / speed,
            error[2].abs(),
            HEAT_WEIGHT * _rms_of(heat) / hottest,
            _rms_of(vapour),
            HEAT_WEIGHT * _rms_of(gel) / warmest,
            *(memory.abs() / (after[len(after) - len(memory) :].abs() + 0.1 * pressure)),
        )
    )
    norm = scaled.square().square().sum(0).sqrt().sqrt()
    return torch.where(radius > 0.0, norm / tolerance, torch.inf)


def step_factor(error: BubbleValues) -> BubbleValues:
    """What to multiply the step by after a scaled error."""
    factor = SAFETY * error ** (-1.0 / ORDER)
    return torch.where(torch.isfinite(error), factor.clamp(SHRINK, GROW), SHRINK)


def _rms_of(values: Tensor) -> Tensor:
    return values.square().mean(0).sqrt()
