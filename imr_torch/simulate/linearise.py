"""The exact derivative of the right-hand side on tensors: the Jacobian of every member, for the
implicit step.

Put together from the derivatives of the laws (:mod:`~imr_torch.simulate.contents`,
:mod:`~imr_torch.simulate.wall`) and tested against automatic differentiation. Derivatives are taken
in ``P`` and at a fixed ``q = dP/dt``; then what follows through ``q`` is added, and ``P`` turned to
``ln P``.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.simulate.contents import (
    gel_slopes,
    node_slopes,
    pressure_rate_slopes,
    wall_balance_slopes,
)
from imr_torch.simulate.grids import Grid
from imr_torch.simulate.rhs import HEAD, Equations, Fields
from imr_torch.simulate.wall import gas_loss_slopes, motion_slopes

_WALL = HEAD - 1


def linearise(
    equations: Equations, f: Fields
) -> tuple[Float[Tensor, "state state members"], Float[Tensor, "members"]]:
    """The Jacobian at a state (rates by rows), and the derivative of ``U'`` in time."""
    b = equations.bubbles.numbers
    c = equations.bubbles.constants
    inside = equations.inside
    outside = equations.outside
    wall = f.wall
    heat = slice(HEAD, HEAD + equations.n)
    vapour = slice(heat.stop, heat.stop + equations.n)
    gel = slice(vapour.stop, vapour.stop + equations.m)
    memory = slice(gel.stop, equations.rows)
    jacobian = f.radius.new_zeros(equations.rows, equations.rows, len(f.radius))
    by_rate = torch.zeros_like(jacobian[0])
    rate_row = torch.zeros_like(jacobian[0])

    jacobian[0, 1] = 1.0
    by_rate[2] = 1.0 / f.pressure
    moving = [1, *range(memory.start, memory.stop)]
    slopes = motion_slopes(equations.bubbles, f.head)
    jacobian[moving, :3] = slopes[:3].transpose(0, 1)
    by_rate[moving] = slopes[3]
    jacobian[moving, memory] = slopes[5:].transpose(0, 1)

    loss = gas_loss_slopes(equations.bubbles, f.radius, f.velocity)
    corner = float(inside.first[0, 0])
    outer_corner = float(outside.first[0, 0])
    at_wall = (f.pressure, wall, f.vapour, corner)
    balances = (
        (
            rate_row,
            pressure_rate_slopes(
                f.radius, f.velocity, *at_wall[:2], f.heat, *at_wall[2:], loss, b, c
            ),
        ),
        (jacobian[_WALL], wall_balance_slopes(*at_wall, outer_corner, b, c)),
    )
    for row, s in balances:
        row[0], row[1], row[2], row[_WALL] = s.radius, s.velocity, s.pressure, s.wall
        row[heat] = s.heat * inside.first[0, 1:, None]
        row[vapour] = s.vapour * inside.first[0, 1:, None]
        row[gel] = s.outer * outside.first[0, 1:, None]

    s = node_slopes(f.node, f.radius, f.velocity, f.pressure, f.rate, b, c)
    by_field = _apply_operators(inside, s.heat_first, s.heat_second)
    jacobian[heat, _WALL : heat.stop] = by_field
    jacobian[heat, heat].diagonal().add_(s.heat_self.T)
    jacobian[heat, 0], jacobian[heat, 1], jacobian[heat, 2] = (
        s.heat_radius,
        s.heat_velocity,
        s.heat_pressure,
    )
    by_rate[heat] = s.heat_rate

    by_field = _apply_operators(inside, s.vapour_first, s.vapour_second)
    jacobian[vapour, vapour] = by_field[:, 1:]
    jacobian[vapour, vapour].diagonal().add_(s.vapour_self.T)
    jacobian[vapour, _WALL : heat.stop] = s.coupling_slope[:, None] * inside.first[1:, :, None]
    jacobian[vapour, heat].diagonal().add_(s.coupling.T)
    jacobian[vapour, _WALL] += by_field[:, 0] * wall.vapour_heat
    jacobian[vapour, 0], jacobian[vapour, 1] = s.vapour_radius, s.vapour_velocity
    jacobian[vapour, 2] = s.vapour_pressure + by_field[:, 0] * wall.vapour_pressure
    by_rate[vapour] = s.vapour_rate

    outer = (f.outer_slope[1:], f.outer_laplacian, f.radius, f.velocity, wall, b, c)
    g = gel_slopes(equations.stretching, equations.shear, *outer)
    by_field = _apply_operators(outside, g.first, g.second)
    jacobian[gel, gel] = by_field[:, 1:]
    jacobian[gel, _WALL] = g.wall + by_field[:, 0] / wall.conductivity
    jacobian[gel, 0], jacobian[gel, 1], jacobian[gel, 2] = g.radius, g.velocity, g.pressure

    jacobian.addcmul_(by_rate[:, None], rate_row[None])
    jacobian[:, 2] *= f.pressure
    jacobian[2, 2] -= f.rate / f.pressure
    return jacobian, slopes[4, 0]


def _apply_operators(grid: Grid, first: Tensor, second: Tensor) -> Tensor:
    """Derivatives of ``first f' + second lap f`` at the nodes in ``f``, the wall first: ``n x (n+1) x
    B``.
    """
    return (
        first[:, None] * grid.first[1:, :, None]
        + second.expand_as(first)[:, None] * grid.laplacian[:, :, None]
    )
