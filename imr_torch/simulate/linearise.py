"""The exact derivative of the right-hand side on tensors, in the structured form that the implicit
step solves.

Put together from the derivatives of the laws (:mod:`~imr_torch.simulate.contents`,
:mod:`~imr_torch.simulate.wall`) and tested against automatic differentiation. The rate of pressure
``q`` is kept as an unknown of its own: without it the fields would be coupled densely through it.
Derivatives are first taken in ``P`` and ``q``, and turned to ``ln P`` and ``d ln P/dt`` at the end.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.simulate.bordered import Jacobian
from imr_torch.simulate.contents import (
    gel_slopes,
    node_slopes,
    pressure_rate_slopes,
    wall_balance_slopes,
)
from imr_torch.simulate.rhs import Equations, Fields
from imr_torch.simulate.wall import gas_loss_slopes, motion_slopes


def linearise(
    equations: Equations, f: Fields
) -> tuple[tuple[Float[Tensor, "members"], Float[Tensor, "states members"]], Jacobian]:
    """``U'`` and the rates of memory, and the Jacobian of a batch at a state."""
    acceleration, memory_rate, slope = motion_slopes(equations.bubbles, f.head)
    inside, inside_border, coupling, coupling_slope = _inside(equations, f)
    outside, outside_border = _outside(equations, f)
    pressure_row, wall_row, pressure_slopes, wall_slopes = _wall_rows(equations, f)
    p = f.pressure
    g = f.rate / f.pressure
    velocity_row = torch.stack((slope.radius, slope.velocity, slope.pressure, slope.pressure_rate))
    for border in (
        inside_border,
        outside_border,
        wall_row[None],
        velocity_row[None],
        pressure_row[None],
    ):
        _to_logarithm(border, p, g)
    pressure_row /= p
    pressure_row[2] -= g
    return (acceleration, memory_rate), Jacobian(
        inside=inside,
        outside=outside,
        inside_border=inside_border,
        outside_border=outside_border,
        coupling_slope=coupling_slope,
        coupling=coupling,
        velocity_row=velocity_row,
        pressure_row=pressure_row,
        wall_row=wall_row,
        pressure_slopes=pressure_slopes / p,
        wall_slopes=wall_slopes,
        velocity_time=slope.time,
        velocity_memory=slope.memory,
        memory_rows=torch.stack((slope.memory_radius, slope.memory_velocity), 1),
        memory_memory=slope.memory_memory,
    )


def _to_logarithm(border: Tensor, pressure: Tensor, log_rate: Tensor) -> None:
    """Turn derivatives in ``P`` and ``dP/dt``, columns 2 and 3, into those in ``ln P`` and its
    rate, in place.
    """
    border[:, 2] = pressure * (border[:, 2] + log_rate * border[:, 3])
    border[:, 3] *= pressure


def _inside(equations: Equations, f: Fields) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Blocks of ``tau`` and ``C``, their border, and how ``C_t`` depends on the value and slope of
    ``tau``.
    """
    grid = equations.inside
    wall = f.wall
    b = equations.bubbles.numbers
    c = equations.bubbles.constants
    s = node_slopes(f.node, f.radius, f.velocity, f.pressure, f.rate, b, c)
    second = torch.stack(torch.broadcast_tensors(s.heat_second, s.vapour_second), 1)
    first = torch.stack((s.heat_first, s.vapour_first), 1)
    blocks = second[:, None] * grid.laplacian[:, 1:, None, None]
    blocks.addcmul_(first[:, None], grid.first[1:, 1:, None, None])
    diagonal = torch.stack((s.heat_self, s.vapour_self), 1)
    blocks.diagonal(dim1=0, dim2=1).add_(diagonal.permute(1, 2, 0))
    by_wall = second * grid.laplacian[:, :1, None] + first * grid.first[1:, :1, None]
    border = torch.stack(
        (
            torch.stack((s.heat_radius, s.vapour_radius), 1),
            torch.stack((s.heat_velocity, s.vapour_velocity), 1),
            torch.stack(
                (s.heat_pressure, s.vapour_pressure + by_wall[:, 1] * wall.vapour_pressure), 1
            ),
            torch.stack((s.heat_rate, s.vapour_rate), 1),
            torch.stack(
                (
                    by_wall[:, 0],
                    by_wall[:, 1] * wall.vapour_heat + s.coupling_slope * grid.first[1:, :1],
                ),
                1,
            ),
        ),
        1,
    )
    return blocks, border, s.coupling, s.coupling_slope


def _outside(equations: Equations, f: Fields) -> tuple[Tensor, Tensor]:
    """Block of ``theta`` and its border."""
    grid = equations.outside
    b = equations.bubbles.numbers
    c = equations.bubbles.constants
    slope = f.outer_slope[1:]
    bend = f.outer_laplacian
    s = gel_slopes(
        equations.stretching, equations.shear, slope, bend, f.radius, f.velocity, f.wall, b, c
    )
    block = s.second * grid.laplacian[:, 1:, None]
    block.addcmul_(s.first[:, None], grid.first[1:, 1:, None])
    through = (
        s.second * grid.laplacian[:, :1] + s.first * grid.first[1:, :1]
    ) / f.wall.conductivity
    parts = (s.radius, s.velocity, s.pressure, torch.zeros_like(s.radius), s.wall + through)
    return block, torch.stack(torch.broadcast_tensors(*parts), 1)


def _wall_rows(equations: Equations, f: Fields) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows of ``q`` and of the wall's balance: in the border, and in the slopes at the wall."""
    b = equations.bubbles.numbers
    c = equations.bubbles.constants
    corner = float(equations.inside.first[0, 0])
    outer_corner = float(equations.outside.first[0, 0])
    loss = gas_loss_slopes(equations.bubbles, f.radius, f.velocity)
    q = pressure_rate_slopes(
        f.radius, f.velocity, f.pressure, f.wall, f.heat, f.vapour, corner, loss, b, c
    )
    w = wall_balance_slopes(f.pressure, f.wall, f.vapour, corner, outer_corner, b, c)
    return torch.stack(q[:5]), torch.stack(w[:5]), torch.stack(q[5:7]), torch.stack(w[5:])
