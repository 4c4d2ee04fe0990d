"""The right-hand side of a conducting, evaporating bubble; its derivative is in :mod:`imr_torch.simulate.linearise`.

State of a member, in this order: ``R``, ``U``, ``ln P`` (pressure of the contents; its logarithm is what changes
evenly), ``tau_w``, ``tau`` at ``n`` nodes inside, ``C`` at the same, ``theta = T_m - 1`` at ``m`` nodes outside, and the
``K`` memory states of the gel.
``tau`` is the Kirchhoff temperature, ``d tau = K*(T) dT``; ``C`` the mass fraction of vapour. ``tau_w`` at the wall
is algebraic: its row of the right-hand side is the wall's balance of heat, which must vanish. Equations: Estrada et
al. (J. Mech. Phys. Solids 112, 2018), eqs. 4-18 and appendix A.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.grids import Grid
from imr_torch.simulate.wall import Head, acceleration, gel_memory_rate, leak

HEAD = 4
"""Rows of the state before the fields: R, U, ln P, tau_w."""


@dataclass(frozen=True)
class Wall:
    """What holds at the wall, each a ``B`` tensor.

    Args:
        temperature: ``T``.
        conductivity: ``K*(T)``.
        vapour: ``C`` in equilibrium.
        vapour_heat: ``dC/d tau_w``.
        vapour_pressure: ``dC/dP``.
        mixture: ``R_mix``.
        flux_factor: ``Fo_m P/(R_mix (1 - C))``: the flux of vapour is this times ``dC/dy``.
        capacity: what divides ``Fo_h`` and ``Br``: 1, or the gas's heat capacity (preset ``authors_code``).
    """

    temperature: Tensor
    conductivity: Tensor
    vapour: Tensor
    vapour_heat: Tensor
    vapour_pressure: Tensor
    mixture: Tensor
    flux_factor: Tensor
    capacity: Tensor


@dataclass(frozen=True)
class Fields:
    """Everything that right-hand side and Jacobian share at one state.

    Args:
        head: time, radius, velocity, pressure of all contents and its rate, memory.
        radius: ``B`` tensor; ``velocity``, ``pressure`` (of the mixture) and ``rate`` (``q = dP/dt``) likewise.
        temperature: ``n x B`` tensor, ``T`` at the inner nodes; ``conductivity`` likewise.
        mixture: ``n x B`` tensor, ``R_mix``.
        slopes: ``(n+1) x 2 x B`` tensor, ``d/dy`` of ``tau`` and ``C``, the wall first.
        laplacians: ``n x 2 x B`` tensor.
        outer_slope: ``(m+1) x B`` tensor, ``d theta/dy``, the wall first.
        outer_laplacian: ``m x B`` tensor.
    """

    head: Head
    radius: Tensor
    velocity: Tensor
    pressure: Tensor
    rate: Tensor
    temperature: Tensor
    conductivity: Tensor
    mixture: Tensor
    slopes: Tensor
    laplacians: Tensor
    outer_slope: Tensor
    outer_laplacian: Tensor
    wall: Wall


class Equations:
    """The differential-algebraic system ``M x' = f(x)`` of a batch; ``M`` is 1 but for the row of ``tau_w``.

    Args:
        bubbles: the batch.
        inside: grid in the bubble.
        outside: grid in the gel.
    """

    def __init__(self, bubbles: Bubbles, inside: Grid, outside: Grid) -> None:
        self.bubbles, self.inside, self.outside = bubbles, inside, outside
        self.n, self.m, self.memory = len(inside), len(outside), bubbles.states
        self.rows = HEAD + 2 * self.n + self.m + self.memory
        self._parts = (HEAD - 1, 1 + self.n, self.n, self.m, self.memory)  # tau with tau_w before it
        self._inside_operator = torch.cat((inside.first, inside.laplacian))
        self._outside_operator = torch.cat((outside.first, outside.laplacian))
        self.y = inside.nodes[:, None]
        y = outside.nodes[:, None]
        self.stretching, self.shear = y**-2 - y, y**-6

    def take(self, members: Tensor) -> "Equations":
        """The equations of the members with these indices."""
        return Equations(self.bubbles.take(members), self.inside, self.outside)

    def start(self) -> Tensor:
        """The state at time zero: at the far temperature, vapour in equilibrium; ``(4+2n+m+K) x B``."""
        pressure = self.bubbles["start"]
        state = pressure.new_zeros(self.rows, len(self.bubbles))
        state[0], state[1], state[2] = 1.0, self.bubbles["velocity"], pressure.log()
        state[HEAD + self.n : HEAD + 2 * self.n] = self._wall(
            pressure, torch.ones_like(pressure), torch.ones_like(pressure)
        ).vapour
        state[HEAD + 2 * self.n + self.m :] = self.bubbles.memory_start()
        return state

    def _wall(self, pressure: Tensor, temperature: Tensor, conductivity: Tensor) -> Wall:
        """Vapour at the wall in equilibrium with water (Estrada et al. 2018, eqs. 17-18)."""
        c = self.bubbles.constants
        ratio = c.vapour_constant / c.air_constant
        saturation = self.bubbles["saturation"] * torch.exp(-c.evaporation / temperature)
        following = torch.ones_like(pressure)  # 1 - d ln p_sat/d ln P
        if self.bubbles.trapping:  # vapour that cannot condense in time is compressed with the rest
            trapped = self.bubbles.theta["condensation"]
            saturation, following = saturation * (pressure / self.bubbles["start"]) ** trapped, 1.0 - trapped
        scale = (ratio * pressure + (1.0 - ratio) * saturation).reciprocal()
        vapour = saturation * scale
        slope = ratio * vapour * scale
        mixture = c.air_constant + (c.vapour_constant - c.air_constant) * vapour
        ones = torch.ones_like(pressure)
        return Wall(
            temperature=temperature,
            conductivity=conductivity,
            vapour=vapour,
            vapour_heat=slope * pressure * c.evaporation / (temperature**2 * conductivity),
            vapour_pressure=-slope * following,
            mixture=mixture,
            flux_factor=self.bubbles["fom"] * pressure / (mixture * (1.0 - vapour)),
            capacity=mixture * (c.heat_ratio / (c.heat_ratio - 1.0)) if c.gas_capacity else ones,
        )

    def fields(self, state: Tensor, time: Tensor | None = None) -> Fields:
        """Temperatures, slopes and the pressure's rate at a state; ``time`` (``B``) matters where the far field is driven."""
        c, n, m = self.bubbles.constants, self.n, self.m
        motion, tau, vapour, theta, memory = state.split_with_sizes(self._parts)
        radius, velocity, log_pressure = motion.unbind()
        pressure = torch.exp(log_pressure)
        conductivity = torch.sqrt(1.0 + 2.0 * c.slope * tau)  # K = A T + B as a function of tau
        temperature = (conductivity + (c.slope - 1.0)) / c.slope
        wall = self._wall(pressure, temperature[0], conductivity[0])
        profiles = torch.stack((tau, torch.cat((wall.vapour[None], vapour))), 1)
        inner = (self._inside_operator @ profiles.flatten(1)).reshape(2 * n + 1, 2, -1)
        outer = self._outside_operator @ torch.cat((temperature[:1] - 1.0, theta))
        slopes, laplacians = inner.split_with_sizes((n + 1, n))
        outer_slope, outer_laplacian = outer.split_with_sizes((m + 1, m))
        k, chi = c.heat_ratio, self.bubbles["chi_gas"]
        source = (k - 1.0) * chi * slopes[0, 0] + k * c.vapour_constant * wall.flux_factor * slopes[0, 1]
        rate = 3.0 / radius * (source / radius - k * pressure * velocity)
        if self.bubbles.leaking:
            rate = rate - pressure * leak(self.bubbles, radius, velocity)
        contents = pressure + self.bubbles["constant_vapour"]
        head = Head(radius if time is None else time, radius, velocity, contents, rate, memory)
        return Fields(
            head=head,
            radius=radius,
            velocity=velocity,
            pressure=pressure,
            rate=rate,
            temperature=temperature[1:],
            conductivity=conductivity[1:],
            mixture=c.air_constant + (c.vapour_constant - c.air_constant) * vapour,
            slopes=slopes,
            laplacians=laplacians,
            outer_slope=outer_slope,
            outer_laplacian=outer_laplacian,
            wall=wall,
        )

    def drift(self, f: Fields) -> tuple[Tensor, Tensor]:
        """``(v - y U)/R`` at the inner nodes, ``n x B``, and the factor of ``d tau/dy`` in it, ``B``."""
        k = self.bubbles.constants.heat_ratio
        factor = self.bubbles["chi_gas"] * (1.0 - 1.0 / k) / (f.pressure * f.radius**2)
        return factor * f.slopes[1:, 0] - self.y * (f.rate / (3.0 * k * f.pressure) + f.velocity / f.radius), factor

    def diffusion(self, f: Fields) -> tuple[Tensor, Tensor, Tensor]:
        """``K T (k-1)/(k P)``, ``dR C'/R_mix`` and ``tau'/(K T)`` at the inner nodes, each ``n x B``."""
        c = self.bubbles.constants
        product = f.conductivity * f.temperature
        capacity = product * ((1.0 - 1.0 / c.heat_ratio) / f.pressure)
        mixing = f.slopes[1:, 1] * (c.vapour_constant - c.air_constant) / f.mixture
        return capacity, mixing, f.slopes[1:, 0] / product

    def _wall_balance(self, f: Fields) -> Tensor:
        """Heat into the wall less heat into the gel; must vanish (Estrada et al. 2018, eq. 16)."""
        c, wall = self.bubbles.constants, f.wall
        if not c.warm:
            return -(wall.temperature - 1.0)
        evaporation = c.latent_heat * wall.flux_factor * f.slopes[0, 1] / wall.temperature
        b = self.bubbles
        return b["chi_gas"] * f.slopes[0, 0] - b["chi"] * c.conductivity * f.outer_slope[0] + evaporation

    def rate(self, f: Fields, wall_acceleration: Tensor | None = None) -> Tensor:
        """``f(x)`` at a state, ``(4+2n+m+K) x B``; ``wall_acceleration`` is ``U'`` where it is known already."""
        b = self.bubbles
        if wall_acceleration is None:
            wall_acceleration = acceleration(b, f.head)
        head = torch.stack((f.velocity, wall_acceleration, f.rate / f.pressure, self._wall_balance(f)))
        drift, _ = self.drift(f)
        capacity, mixing, warming = self.diffusion(f)
        heat, vapour = f.slopes[1:].unbind(1)
        heat_bend, vapour_bend = f.laplacians.unbind(1)
        square = f.radius**-2
        warmer = (b["chi_gas"] * square * heat_bend + f.rate) * capacity - drift * heat
        wetter = b["fom"] * square * (vapour_bend - vapour * (2.0 * mixing + warming)) - drift * vapour
        parts = (head, warmer, wetter, self._gel_rate(f))
        return torch.cat((*parts, gel_memory_rate(b, f.head)) if self.memory else parts)

    def _gel_rate(self, f: Fields) -> Tensor:
        """Conduction, advection and viscous heating in the gel, ``m x B``."""
        strain = f.velocity / f.radius
        slow = self.bubbles["foh"] / (f.wall.capacity * f.radius**2)
        warm = self.bubbles["heating"] / f.wall.capacity * strain**2
        return slow * f.outer_laplacian - strain * self.stretching * f.outer_slope[1:] + warm * self.shear
