"""Radial equations: the acceleration of the bubble wall from the pressures on both sides of it.

All four share one form. With ``s = 1/c``, ``M = s U``, the liquid's enthalpy ``h`` between the wall and afar and its specific
volume ``w = dh/dp``,

``(1 - M) R U' + 3/2 (1 - M/3) U^2 = (1 + M) h + s R f dh/dt``.

Rayleigh-Plesset: ``s = 0``, ``h = p_w - p_far``. Keller-Miksis in pressure (Keller & Miksis, J. Acoust. Soc. Am. 68,
1980): ``h = p_w - p_far``, ``f = 1``. In enthalpy (Prosperetti & Lezzi, J. Fluid Mech. 168, 1986): ``h`` of a Tait
liquid. Gilmore (Caltech report 26-4, 1952): the same with the sound speed at the wall and ``f = 1 - M``. ``dh/dt`` holds
``U'`` through viscous stress; that part is taken to the left. Pressures are over ``p_inf``, velocities over ``U_c``.
"""

import math
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
class Drive:
    """What pushes the wall: ``h``, the part of ``dh/dt`` without ``U'``, the factor of ``U'`` in it; each a ``B`` tensor."""

    enthalpy: Tensor
    rate: Tensor
    inertia: Tensor


@dataclass(frozen=True)
class DriveSlopes:
    """What a :class:`Drive` changes with: specific volumes ``w = dh/dp`` and ``dw/dp``, at the wall and afar; ``B`` tensors."""

    volume: Tensor
    bend: Tensor
    far_volume: Tensor
    far_bend: Tensor


@dataclass(frozen=True)
class RadialEquation:
    """One member of the family, in pressure; subclasses change what the liquid does."""

    key: ClassVar[str]
    local_rate: ClassVar[bool] = False
    """Whether the rate of enthalpy is weighed by ``f = 1 - M``."""

    def drive(self, wall: WallState) -> Drive:
        """Enthalpy between the wall and afar; a difference of pressures in the pressure forms."""
        return Drive(wall.pressure - wall.far, wall.rate - wall.far_rate, wall.inertia)

    def drive_slopes(self, wall: WallState) -> DriveSlopes:
        """Derivatives of :meth:`drive` in the pressures."""
        one, zero = torch.ones_like(wall.pressure), torch.zeros_like(wall.pressure)
        return DriveSlopes(one, zero, one, zero)

    def slowness(self, pressure: Tensor, slowness: Tensor) -> tuple[Tensor, Tensor]:
        """``1/c`` at the wall and its derivative in ``p_w``, from ``1/c`` of the undisturbed liquid."""
        return slowness, torch.zeros_like(slowness)

    def acceleration(self, wall: WallState) -> Tensor:
        """``U'``, a ``B`` tensor."""
        force, inertia = self._balance(wall, self.drive(wall), self.slowness(wall.pressure, wall.slowness)[0])
        return force / inertia

    def _balance(self, wall: WallState, drive: Drive, s: Tensor) -> tuple[Tensor, Tensor]:
        """Force and inertia; ``U'`` is their ratio."""
        mach, delay = s * wall.velocity, s * wall.radius
        square = wall.velocity * wall.velocity
        if self.local_rate:
            delay = delay * (1.0 - mach)
        force = (1.0 + mach) * drive.enthalpy + delay * drive.rate - (1.5 - 0.5 * mach) * square
        inertia = (1.0 - mach) * wall.radius - delay * drive.inertia
        if wall.image is not None:
            pull = wall.image * wall.radius * (1.0 + mach)
            force, inertia = force - 2.0 * pull * square, inertia + pull * wall.radius
        return force, inertia

    def slopes(self, wall: WallState) -> tuple[Tensor, WallSlopes]:
        """``U'`` and its partial derivatives."""
        drive, liquid = self.drive(wall), self.drive_slopes(wall)
        s, s_p = self.slowness(wall.pressure, wall.slowness)
        force, inertia = self._balance(wall, drive, s)
        rate = force / inertia
        radius, velocity = wall.radius, wall.velocity
        mach, square = s * velocity, velocity * velocity
        f, f_u, f_p = (1.0 - mach, -s, -s_p * velocity) if self.local_rate else (1.0, 0.0, 0.0)
        delay, delay_p = s * radius * f, radius * (s_p * f + s * f_p)
        force_r = s * f * drive.rate
        force_u = s * drive.enthalpy + s * radius * f_u * drive.rate - (3.0 - 1.5 * mach) * velocity
        force_p = (
            (1.0 + mach) * liquid.volume
            + s_p * velocity * (drive.enthalpy + 0.5 * square)
            + delay_p * drive.rate
            + delay * liquid.bend * wall.rate
        )
        inertia_r = 1.0 - mach - s * f * drive.inertia
        inertia_u = -s * radius * (1.0 + f_u * drive.inertia)
        inertia_p = -s_p * velocity * radius - delay_p * drive.inertia - delay * liquid.bend * wall.inertia
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
            rate=delay * liquid.volume / inertia,
            inertia=rate * delay * liquid.volume / inertia,
            far=-((1.0 + mach) * liquid.far_volume + delay * liquid.far_bend * wall.far_rate) / inertia,
            far_rate=-delay * liquid.far_volume / inertia,
        )


@dataclass(frozen=True)
class RayleighPlesset(RadialEquation):
    """An incompressible liquid: the speed of sound plays no part."""

    key = "rayleigh_plesset"

    def slowness(self, pressure: Tensor, slowness: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`RadialEquation`."""
        zero = torch.zeros_like(slowness)
        return zero, zero


@dataclass(frozen=True)
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
        if not (1.0 < self.exponent < math.inf and 0.0 < self.stiffness < math.inf):
            raise InputDataError(
                f"{type(self).__name__} has exponent {self.exponent} and stiffness {self.stiffness}; expected exponent > 1 "
                "and stiffness > 0 (B over p_inf), both finite."
            )

    def _compression(self, pressure: Tensor) -> Tensor:
        """``(p + B)/(1 + B)``."""
        return (pressure + self.stiffness) / (1.0 + self.stiffness)

    def _volume(self, pressure: Tensor) -> Tensor:
        """``w = dh/dp``, 1 at ``p_inf``."""
        return self._compression(pressure) ** (-1.0 / self.exponent)

    def _enthalpy(self, pressure: Tensor) -> Tensor:
        """``h`` above that at ``p_inf``; ``expm1`` and ``log1p`` keep it exact near there and for a stiff liquid."""
        power = 1.0 - 1.0 / self.exponent
        return (1.0 + self.stiffness) / power * torch.expm1(power * torch.log1p((pressure - 1.0) / (1.0 + self.stiffness)))

    def drive(self, wall: WallState) -> Drive:
        """See :class:`RadialEquation`."""
        volume = self._volume(wall.pressure)
        return Drive(
            self._enthalpy(wall.pressure) - self._enthalpy(wall.far),
            volume * wall.rate - self._volume(wall.far) * wall.far_rate,
            volume * wall.inertia,
        )

    def drive_slopes(self, wall: WallState) -> DriveSlopes:
        """See :class:`RadialEquation`."""
        near, far = self._volume(wall.pressure), self._volume(wall.far)
        near_bend, far_bend = (
            -volume / (self.exponent * (pressure + self.stiffness))
            for volume, pressure in ((near, wall.pressure), (far, wall.far))
        )
        return DriveSlopes(near, near_bend, far, far_bend)


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
