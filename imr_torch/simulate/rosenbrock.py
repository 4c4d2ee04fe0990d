"""One linearly implicit step of a stiff differential-algebraic system, for a batch in which every member has its own step.

A Rosenbrock method replaces the Newton iteration of an implicit Runge-Kutta method by linear systems with one exact
Jacobian a step. Rodas4 is stiffly accurate, of order 4 with an embedded method of order 3 (Hairer & Wanner, Solving
Ordinary Differential Equations II, 2nd ed. 1996, sections IV.7 and VI.4), in the form that avoids products with the
Jacobian.
"""

from dataclasses import dataclass

import torch
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


_LAST = (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950)

RODAS4 = Tableau(
    gamma=0.25,
    stages=(
        (1.544,),
        (0.9466785280815826, 0.2557011698983284),
        (3.314825187068521, 2.896124015972201, 0.9986419139977817),
        _LAST,
        (*_LAST, 1.0),
    ),
    coupling=(
        (-5.6688,),
        (-2.430093356833875, -0.2063599157091915),
        (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
        (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
        (8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054),
    ),
    order=4,
)
"""The last stage is the error estimate; its argument plus itself is the new state."""


@dataclass(frozen=True)
class Step:
    """What one step gave.

    Args:
        state: ``nx x B`` tensor, the state after the step.
        error: ``nx x B`` tensor, estimate of its error.
        acceleration: ``B`` tensor, ``U'`` before the step.
        pressure_rate: ``B`` tensor, ``dP/dt`` before the step.
    """

    state: Tensor
    error: Tensor
    acceleration: Tensor
    pressure_rate: Tensor


def rosenbrock_step(equations: Equations, state: Tensor, step: Tensor, tableau: Tableau = RODAS4) -> Step:
    """Advance every member by its own step.

    Args:
        equations: the system.
        state: ``nx x B`` tensor.
        step: ``B`` tensor.
        tableau: the method.
    """
    fields = equations.fields(state)
    acceleration, jacobian = linearise(equations, fields)
    inside, outside = equations.inside.first, equations.outside.first
    shift = 1.0 / (tableau.gamma * step)
    factors = Factors(jacobian, shift, inside[1:, 1:], inside[0, 1:], outside[0, 1:])
    inverse_step = (1.0 / step).repeat(4, 1)
    inverse_step[3] = 0.0  # tau_w is algebraic
    increments = state.new_empty(len(tableau.stages) + 1, *state.shape)
    increments[0] = factors.solve(equations.rate(fields, acceleration))
    argument = state
    for i, (weights, coupling) in enumerate(zip(tableau.stages, tableau.coupling, strict=True), start=1):
        argument = state + _combine(weights, increments)
        right = _combine(coupling, increments)
        right[:4] *= inverse_step
        right[4:] *= inverse_step[0]
        right += equations.rate(equations.fields(argument))
        increments[i] = factors.solve(right)
    return Step(argument + increments[-1], increments[-1], acceleration, fields.rate)


def _combine(weights: tuple[float, ...], increments: Tensor) -> Tensor:
    used = increments[: len(weights)]
    return torch.tensordot(used.new_tensor(weights), used, dims=1)
