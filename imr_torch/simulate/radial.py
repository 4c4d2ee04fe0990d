"""Radial equations: the acceleration of the bubble wall from the pressures on both sides of it.

All four share one form. With ``s = 1/c``, ``M = s U``, the liquid's enthalpy ``h`` between the wall and afar and its specific
volume ``w = dh/dp``,

``(1 - M) R U' + 3/2 (1 - M/3) U^2 = (1 + M) h + s R f dh/dt``.

Rayleigh-Plesset: ``s = 0``, ``h = p_w - p_far``. Keller-Miksis in pressure (Keller & Miksis, J. Acoust. Soc. Am. 68,
1980): ``h = p_w - p_far``, ``f = 1``. In enthalpy (Prosperetti & Lezzi, J. Fluid Mech. 168, 1986): ``h`` of a Tait
liquid. Gilmore (Caltech report 26-4, 1952): the same with the sound speed at the wall and ``f = 1 - M``. ``dh/dt`` holds
``U'`` through viscous stress; that part is taken to the left. Pressures are over ``p_inf``, velocities over ``U_c``.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from imr_torch.errors import InputDataError


@dataclass(frozen=True)
class WallState:
    """What a radial equation needs to know, each a ``B`` tensor.

    Args:
        radius: ``R``.
        velocity: ``U``.
        pressure: ``p_w``, in the liquid at the wall.
        rate: the part of ``dp_w/dt`` without ``U'``.
        inertia: the factor of ``U'`` in ``dp_w/dt``.
        far: ``p_far``, afar.
        far_rate: its time derivative.
        slowness: ``1/c`` of the undisturbed liquid.
        image: strength ``b`` of a mirror bubble, whose pressure at the wall is ``b d(R^2 U)/dt``; None without one.
    """

    radius: Tensor
    velocity: Tensor
    pressure: Tensor
    rate: Tensor
    inertia: Tensor
    far: Tensor
    far_rate: Tensor
    slowness: Tensor
    image: Tensor | None = None


@dataclass(frozen=True)
class WallSlopes:
    """Partial derivatives of ``U'`` in the entries of :class:`WallState` that change, each a ``B`` tensor."""

    radius: Tensor
    velocity: Tensor
    pressure: Tensor
    rate: Tensor
    inertia: Tensor
    far: Tensor
    far_rate: Tensor


@dataclass(frozen=True)
class Liquid:
    """A liquid at one pressure, each a ``B`` tensor: enthalpy, specific volume ``w = dh/dp``, ``dw/dp``."""

    enthalpy: Tensor
    volume: Tensor
    volume_slope: Tensor


class RadialEquation:
    """One member of the family; subclasses say what the liquid does."""

    key: ClassVar[str]
    local_rate: ClassVar[bool] = False
    """Whether the rate of enthalpy is weighed by ``f = 1 - M``."""

    def liquid(self, pressure: Tensor) -> Liquid:
        """The liquid at a pressure; incompressible in the pressure forms."""
        return Liquid(pressure, torch.ones_like(pressure), torch.zeros_like(pressure))

    def slowness(self, pressure: Tensor, slowness: Tensor) -> tuple[Tensor, Tensor]:
        """``1/c`` at the wall and its derivative in ``p_w``, from ``1/c`` of the undisturbed liquid."""
        return slowness, torch.zeros_like(slowness)

    def acceleration(self, wall: WallState) -> Tensor:
        """``U'``, a ``B`` tensor."""
        force, inertia = self._balance(wall)
        return force / inertia

    def _balance(self, wall: WallState) -> tuple[Tensor, Tensor]:
        """Force and inertia; ``U'`` is their ratio."""
        near, far = self.liquid(wall.pressure), self.liquid(wall.far)
        s, _ = self.slowness(wall.pressure, wall.slowness)
        mach, delay = s * wall.velocity, s * wall.radius
        if self.local_rate:
            delay = delay * (1.0 - mach)
        square = wall.velocity * wall.velocity
        force = (
            (1.0 + mach) * (near.enthalpy - far.enthalpy)
            + delay * (near.volume * wall.rate - far.volume * wall.far_rate)
            - (1.5 - 0.5 * mach) * square
        )
        inertia = (1.0 - mach) * wall.radius - delay * near.volume * wall.inertia
        if wall.image is not None:
            pull = wall.image * wall.radius * (1.0 + mach)
            force, inertia = force - 2.0 * pull * square, inertia + pull * wall.radius
        return force, inertia

    def slopes(self, wall: WallState) -> tuple[Tensor, WallSlopes]:
        """``U'`` and its partial derivatives."""
        force, inertia = self._balance(wall)
        rate = force / inertia
        radius, velocity = wall.radius, wall.velocity
        near, far = self.liquid(wall.pressure), self.liquid(wall.far)
        s, s_p = self.slowness(wall.pressure, wall.slowness)
        mach = s * velocity
        f, f_u, f_p = (1.0 - mach, -s, -s_p * velocity) if self.local_rate else (1.0, 0.0, 0.0)
        enthalpy = near.enthalpy - far.enthalpy
        push = near.volume * wall.rate - far.volume * wall.far_rate
        drag = near.volume * wall.inertia
        delay, delay_p = s * radius * f, radius * (s_p * f + s * f_p)
        square = velocity * velocity
        force_r = s * f * push
        force_u = s * enthalpy + s * radius * f_u * push - (3.0 - 1.5 * mach) * velocity
        force_p = (
            (1.0 + mach) * near.volume
            + s_p * velocity * (enthalpy + 0.5 * square)
            + delay_p * push
            + delay * near.volume_slope * wall.rate
        )
        inertia_r = 1.0 - mach - s * f * drag
        inertia_u = -s * radius * (1.0 + f_u * drag)
        inertia_p = -s_p * velocity * radius - delay_p * drag - delay * near.volume_slope * wall.inertia
        if wall.image is not None:
            pull = wall.image * (1.0 + mach)
            force_r = force_r - 2.0 * pull * square
            force_u = force_u - 2.0 * wall.image * radius * velocity * (2.0 + 3.0 * mach)
            force_p = force_p - 2.0 * wall.image * radius * square * s_p * velocity
            inertia_r = inertia_r + 2.0 * pull * radius
            inertia_u = inertia_u + wall.image * radius * radius * s
            inertia_p = inertia_p + wall.image * radius * radius * s_p * velocity
        return rate, WallSlopes(
            radius=(force_r - rate * inertia_r) / inertia,
            velocity=(force_u - rate * inertia_u) / inertia,
            pressure=(force_p - rate * inertia_p) / inertia,
            rate=delay * near.volume / inertia,
            inertia=rate * delay * near.volume / inertia,
            far=-((1.0 + mach) * far.volume + delay * far.volume_slope * wall.far_rate) / inertia,
            far_rate=-delay * far.volume / inertia,
        )


class RayleighPlesset(RadialEquation):
    """An incompressible liquid: the speed of sound plays no part."""

    key = "rayleigh_plesset"

    def slowness(self, pressure: Tensor, slowness: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`RadialEquation`."""
        zero = torch.zeros_like(slowness)
        return zero, zero


class KellerMiksis(RadialEquation):
    """Compressible to first order in the Mach number, in pressure: the default."""

    key = "keller_miksis"


@dataclass(frozen=True)
class KellerMiksisEnthalpy(RadialEquation):
    """Compressible to first order in the Mach number, in the enthalpy of a Tait liquid.

    Args:
        exponent: ``n`` of ``(p + B)/(p_inf + B) = (rho/rho_inf)^n``.
        stiffness: ``B`` over ``p_inf``.
    """

    exponent: float = 7.15
    stiffness: float = 304.913e6 / 101325.0

    key = "keller_miksis_enthalpy"

    def __post_init__(self) -> None:
        if not (self.exponent > 1.0 and self.stiffness > 0.0):
            raise InputDataError(
                f"{type(self).__name__} has exponent {self.exponent} and stiffness {self.stiffness}; expected exponent > 1 "
                "and stiffness > 0 (B over p_inf)."
            )

    def _compression(self, pressure: Tensor) -> Tensor:
        """``(p + B)/(1 + B)``."""
        return (pressure + self.stiffness) / (1.0 + self.stiffness)

    def liquid(self, pressure: Tensor) -> Liquid:
        """See :class:`RadialEquation`."""
        n, scale = self.exponent, 1.0 + self.stiffness
        q = self._compression(pressure)
        volume = q ** (-1.0 / n)
        # expm1 keeps the difference of two nearly equal enthalpies exact
        enthalpy = scale * n / (n - 1.0) * torch.expm1((1.0 - 1.0 / n) * torch.log(q))
        return Liquid(enthalpy, volume, -volume / (n * scale * q))


@dataclass(frozen=True)
class Gilmore(KellerMiksisEnthalpy):
    """The enthalpy form with the sound speed of the Tait liquid at the wall, scaled to ``c`` of the undisturbed liquid."""

    key = "gilmore"
    local_rate = True

    def slowness(self, pressure: Tensor, slowness: Tensor) -> tuple[Tensor, Tensor]:
        """``1/c = (1/c_0) q^(-(n-1)/(2n))``."""
        power = -0.5 * (1.0 - 1.0 / self.exponent)
        q = self._compression(pressure)
        near = slowness * q**power
        return near, near * power / (q * (1.0 + self.stiffness))


RADIAL_EQUATIONS: dict[str, RadialEquation] = {
    equation.key: equation for equation in (RayleighPlesset(), KellerMiksis(), KellerMiksisEnthalpy(), Gilmore())
}
"""Key -> radial equation, with the Tait constants of water at 1 atm (Fujikawa & Akamatsu, J. Fluid Mech. 97, 1980)."""
