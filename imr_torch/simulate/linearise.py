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
from imr_torch.simulate.rhs import HEAD, WALL, Equations, Fields
from imr_torch.simulate.wall import gas_loss_slopes, motion_slopes
from imr_torch.types import BubbleValues


def linearise_equations(
    equations: Equations, f: Fields
) -> tuple[Float[Tensor, "state state members"], BubbleValues]:
    """The Jacobian at a state (rates by rows), and the derivative of ``U'`` in time."""
    jacobian = f.point.radius.new_zeros(equations.rows, equations.rows, len(f.point.radius))
    by_rate = torch.zeros_like(jacobian[0])
    rate_row = torch.zeros_like(jacobian[0])
    memory = slice(equations.gel.stop, equations.rows)
    moving = [1, *range(memory.start, memory.stop)]
    slopes = motion_slopes(equations.bubbles, f.head)
    jacobian[0, 1] = 1.0
    jacobian[moving, :3] = slopes[:3].transpose(0, 1)
    jacobian[moving, memory] = slopes[5:].transpose(0, 1)
    by_rate[moving] = slopes[3]
    by_rate[2] = 1.0 / f.point.pressure
    _fill_balances(equations, f, rate_row, jacobian[WALL])
    _fill_inside(equations, f, jacobian, by_rate)
    _fill_gel(equations, f, jacobian)
    jacobian.addcmul_(by_rate[:, None], rate_row[None])
    jacobian[:, 2] *= f.point.pressure
    jacobian[2, 2] -= f.point.rate / f.point.pressure
    return jacobian, slopes[4, 0]


def _fill_balances(
    equations: Equations, f: Fields, rate_row: Tensor, wall_row: Tensor
) -> None:
    """Derivatives of ``q`` and of the wall's balance of heat in the state."""
    b = equations.bubbles.numbers
    c = equations.bubbles.constants
    by_inner = equations.inside.first[0, :, None]
    by_outer = equations.outside.first[0, :, None]
    corner = float(by_inner[0])
    loss = gas_loss_slopes(equations.bubbles, f.point.radius, f.point.velocity)
    q = pressure_rate_slopes(f.point, corner, loss, b, c)
    w = wall_balance_slopes(f.point, corner, float(by_outer[0]), b, c)
    for row, s in ((rate_row, q), (wall_row, w)):
        row[:HEAD] = torch.stack((s.radius, s.velocity, s.pressure, s.wall))
        row[equations.heat] = s.heat * by_inner[1:]
        row[equations.vapour] = s.vapour * by_inner[1:]
        row[equations.gel] = s.outer * by_outer[1:]


def _fill_inside(
    equations: Equations, f: Fields, jacobian: Tensor, by_rate: Tensor
) -> None:
    """Derivatives of the rates of ``tau`` and ``C`` in the state, and in ``q``."""
    b = equations.bubbles.numbers
    c = equations.bubbles.constants
    grid = equations.inside
    heat = equations.heat
    vapour = equations.vapour
    with_wall = slice(WALL, heat.stop)
    s = node_slopes(f.node, f.point, b, c)
    jacobian[heat, with_wall] = _apply_operators(grid, s.heat_first, s.heat_second)
    jacobian[heat, heat].diagonal().add_(s.heat_self.T)
    jacobian[heat, 0] = s.heat_radius
    jacobian[heat, 1] = s.heat_velocity
    jacobian[heat, 2] = s.heat_pressure
    by_rate[heat] = s.heat_rate
    by_field = _apply_operators(grid, s.vapour_first, s.vapour_second)
    jacobian[vapour, vapour] = by_field[:, 1:]
    jacobian[vapour, vapour].diagonal().add_(s.vapour_self.T)
    jacobian[vapour, with_wall] = s.coupling_slope[:, None] * grid.first[1:, :, None]
    jacobian[vapour, heat].diagonal().add_(s.coupling.T)
    jacobian[vapour, WALL] += by_field[:, 0] * f.point.wall.vapour_heat
    jacobian[vapour, 0] = s.vapour_radius
    jacobian[vapour, 1] = s.vapour_velocity
    jacobian[vapour, 2] = s.vapour_pressure + by_field[:, 0] * f.point.wall.vapour_pressure
    by_rate[vapour] = s.vapour_rate


def _fill_gel(equations: Equations, f: Fields, jacobian: Tensor) -> None:
    """Derivatives of the rates of ``theta`` in the state."""
    b = equations.bubbles.numbers
    c = equations.bubbles.constants
    gel = equations.gel
    s = gel_slopes(f.gel, f.point, b, c)
    by_field = _apply_operators(equations.outside, s.first, s.second)
    jacobian[gel, gel] = by_field[:, 1:]
    jacobian[gel, WALL] = s.wall + by_field[:, 0] / f.point.wall.conductivity
    jacobian[gel, 0] = s.radius
    jacobian[gel, 1] = s.velocity
    jacobian[gel, 2] = s.pressure


def _apply_operators(grid: Grid, first: Tensor, second: Tensor) -> Tensor:
    """Derivatives of ``first f' + second lap f`` at the nodes in ``f``, the wall first: ``n x (n+1) x
    B``.
    """
    return (
        first[:, None] * grid.first[1:, :, None]
        + second.expand_as(first)[:, None] * grid.laplacian[:, :, None]
    )
