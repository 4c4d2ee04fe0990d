"""The exact derivative of the right-hand side, in the structured form that the implicit step solves.

Derived by hand from :mod:`imr_torch.simulate.rhs` and tested against automatic differentiation. The rate of pressure
``q`` is kept as an unknown of its own: without it the fields would be coupled densely through it. Derivatives are
first taken in ``P`` and ``q``, and turned to ``ln P`` and ``d ln P/dt`` at the end.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.simulate.bordered import Jacobian
from imr_torch.simulate.rhs import Equations, Fields
from imr_torch.simulate.wall import acceleration_slopes, leak_slopes


@dataclass(frozen=True)
class _Inside:
    """Quantities at the inner nodes that several derivatives share, each ``n x B`` unless said otherwise."""

    drift: Tensor  # (v - y U)/R
    heat_drift: Tensor  # its factor of d tau/dy, B
    capacity: Tensor  # K T (k-1)/(k P)
    mixing: Tensor  # dR C'/R_mix
    warming: Tensor  # tau'/(K T)
    product_slope: Tensor  # d ln(K T)/d tau
    diffusivity: Tensor  # Fo_m/R^2, B
    heating: Tensor  # chi Lap tau/R^2 + q


def linearise(equations: Equations, f: Fields) -> tuple[Tensor, Jacobian]:
    """``U'`` and the Jacobian of a batch at a state."""
    b, c = equations.bubbles, equations.bubbles.constants
    drift, heat_drift = equations.drift(f)
    capacity, mixing, warming = equations.diffusion(f)
    s = _Inside(
        drift,
        heat_drift,
        capacity,
        mixing,
        warming,
        (c.slope / f.conductivity + 1.0 / f.temperature) / f.conductivity,
        b["fom"] / f.radius**2,
        b["chi_gas"] / f.radius**2 * f.laplacians[:, 0] + f.rate,
    )
    rate, slope = acceleration_slopes(b, f.head)
    inside, inside_border, coupling_slope = _inside(equations, f, s)
    outside, outside_border = _outside(equations, f)
    pressure_row, wall_row, pressure_slopes, wall_slopes = _wall_rows(equations, f)
    p, g = f.pressure, f.rate / f.pressure
    for border in (inside_border, outside_border):
        _to_logarithm(border, p, g)
    _to_logarithm(wall_row[None], p, g)
    velocity_row = torch.stack((slope.radius, slope.velocity, slope.pressure, slope.pressure_rate))
    _to_logarithm(velocity_row[None], p, g)
    _to_logarithm(pressure_row[None], p, g)
    pressure_row /= p
    pressure_row[2] -= g
    return rate, Jacobian(
        inside=inside,
        outside=outside,
        inside_border=inside_border,
        outside_border=outside_border,
        coupling_slope=coupling_slope,
        coupling=s.diffusivity * f.slopes[1:, 1] * s.warming * s.product_slope,
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
    """Turn derivatives in ``P`` and ``dP/dt``, columns 2 and 3, into those in ``ln P`` and its rate, in place."""
    border[:, 2] = pressure * (border[:, 2] + log_rate * border[:, 3])
    border[:, 3] *= pressure


def _inside(equations: Equations, f: Fields, s: _Inside) -> tuple[Tensor, Tensor, Tensor]:
    """Blocks of ``tau`` and ``C``, their border, and how ``C_t`` hangs on the slope of ``tau``."""
    chi, grid = equations.bubbles["chi_gas"], equations.inside
    second = torch.empty_like(f.laplacians)
    second[:, 0], second[:, 1] = chi / f.radius**2 * s.capacity, s.diffusivity
    first = torch.empty_like(second)
    first[:, 0] = -s.drift - s.heat_drift * f.slopes[1:, 0]
    first[:, 1] = -s.drift - s.diffusivity * (4.0 * s.mixing + s.warming)
    blocks = second[:, None] * grid.laplacian[:, 1:, None, None]
    blocks.addcmul_(first[:, None], grid.first[1:, 1:, None, None])
    diagonal = torch.stack((s.heating * s.capacity * s.product_slope, 2.0 * s.diffusivity * s.mixing**2), 1)
    blocks.diagonal(dim1=0, dim2=1).add_(diagonal.permute(1, 2, 0))
    wall = second * grid.laplacian[:, :1, None] + first * grid.first[1:, :1, None]
    coupling_slope = -f.slopes[1:, 1] * (s.diffusivity / (f.conductivity * f.temperature) + s.heat_drift)
    border = f.slopes.new_empty(len(grid), 5, 2, f.radius.shape[0])
    _inside_scalars(equations, f, s, border)
    border[:, 2, 1] += wall[:, 1] * f.wall.vapour_pressure
    border[:, 4, 0] = wall[:, 0]
    border[:, 4, 1] = wall[:, 1] * f.wall.vapour_heat + coupling_slope * grid.first[1:, :1]
    return blocks, border, coupling_slope


def _inside_scalars(equations: Equations, f: Fields, s: _Inside, border: Tensor) -> None:
    """Derivatives of ``tau_t`` and ``C_t`` in R, U, P and q at fixed fields, written into ``border[:, :4]``."""
    k, y = equations.bubbles.constants.heat_ratio, equations.y
    heat, slopes = f.slopes[1:, 0], f.slopes[1:]
    inverse = 1.0 / f.radius
    conduction = s.heat_drift * heat
    compression = y * (1.0 / (3.0 * k * f.pressure))
    border[:, 0] = (2.0 * inverse * conduction - (f.velocity * inverse**2) * y)[:, None] * slopes
    border[:, 1] = (inverse * y)[:, None] * slopes
    border[:, 2] = ((conduction - f.rate * compression) / f.pressure)[:, None] * slopes
    border[:, 3] = compression[:, None] * slopes
    diffusion = f.laplacians[:, 1] - slopes[:, 1] * (2.0 * s.mixing + s.warming)
    border[:, 0, 0] -= 2.0 * inverse * (s.heating - f.rate) * s.capacity
    border[:, 0, 1] -= 2.0 * inverse * s.diffusivity * diffusion
    border[:, 2, 0] -= s.heating * s.capacity / f.pressure
    border[:, 3, 0] += s.capacity


def _outside(equations: Equations, f: Fields) -> tuple[Tensor, Tensor]:
    """Block of ``theta`` and its border."""
    b, grid, wall = equations.bubbles, equations.outside, f.wall
    inverse = 1.0 / f.radius
    strain = f.velocity * inverse
    second = b["foh"] / wall.capacity * inverse**2
    first = -strain * equations.stretching
    block = second * grid.laplacian[:, 1:, None]
    block.addcmul_(first[:, None], grid.first[1:, 1:, None])
    heat = b["heating"] / wall.capacity * strain * inverse * equations.shear  # viscous heating over U
    conduction, advection = second * f.outer_laplacian, equations.stretching * f.outer_slope[1:] * inverse
    border = heat.new_zeros(len(grid), 5, heat.shape[1])
    border[:, 0] = inverse * (f.velocity * advection - 2.0 * (conduction + f.velocity * heat))
    border[:, 1] = 2.0 * heat - advection
    border[:, 4] = (second * grid.laplacian[:, :1] + first * grid.first[1:, :1]) / wall.conductivity
    if equations.bubbles.constants.gas_capacity:
        relative = (b.constants.vapour_constant - b.constants.air_constant) / wall.mixture
        thinned = relative * (conduction + f.velocity * heat)
        border[:, 2] -= thinned * wall.vapour_pressure
        border[:, 4] -= thinned * wall.vapour_heat
    return block, border


def _wall_rows(equations: Equations, f: Fields) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows of ``q`` and of the wall's balance: in the border, and in the slopes at the wall."""
    b, c, wall = equations.bubbles, equations.bubbles.constants, f.wall
    k, chi, corner = c.heat_ratio, b["chi_gas"], equations.inside.first[0, 0]
    flux = wall.flux_factor * f.slopes[0, 1]
    by_vapour = flux * (1.0 / (1.0 - wall.vapour) - (c.vapour_constant - c.air_constant) / wall.mixture)
    by_vapour = by_vapour + wall.flux_factor * corner
    by_pressure = flux / f.pressure + by_vapour * wall.vapour_pressure
    by_heat = by_vapour * wall.vapour_heat
    inverse = 1.0 / f.radius
    scale = 3.0 * inverse**2
    gain = k * c.vapour_constant
    zero = torch.zeros_like(flux)
    compression = 3.0 * k * inverse
    source = (k - 1.0) * chi * f.slopes[0, 0] + gain * flux
    pressure_row = (
        compression * inverse * f.pressure * f.velocity - 2.0 * scale * inverse * source,
        -compression * f.pressure,
        -compression * f.velocity + scale * gain * by_pressure,
        zero,
        scale * ((k - 1.0) * chi * corner + gain * by_heat),
    )
    if b.leaking:
        lost, by_radius, by_velocity = leak_slopes(b, f.radius, f.velocity)
        losses = (f.pressure * by_radius, f.pressure * by_velocity, lost)
        pressure_row = (*(row - loss for row, loss in zip(pressure_row, losses, strict=False)), *pressure_row[3:])
    pressure_slopes = torch.stack((scale * (k - 1.0) * chi, scale * gain * wall.flux_factor))
    if not c.warm:
        cold = torch.stack((zero, zero, zero, zero, -1.0 / wall.conductivity))
        return torch.stack(pressure_row), cold, pressure_slopes, torch.stack((zero, zero, zero))
    latent = c.latent_heat / wall.temperature
    outer = b["chi"] * c.conductivity
    by_wall = (
        chi * corner
        + latent * (by_heat - flux / (wall.temperature * wall.conductivity))
        - outer * equations.outside.first[0, 0] / wall.conductivity
    )
    wall_row = torch.stack((zero, zero, latent * by_pressure, zero, by_wall))
    wall_slopes = torch.stack((chi, latent * wall.flux_factor, -outer))
    return torch.stack(pressure_row), wall_row, pressure_slopes, wall_slopes
