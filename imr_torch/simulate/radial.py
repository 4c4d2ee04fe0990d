"""Radial equations: the acceleration of the bubble wall from the pressures on both sides of it.

All four share one form. With ``s = 1/c``, ``M = s U``, the liquid's enthalpy ``h`` between the wall
and the far field, and its specific volume ``w = dh/dp``,

``(1 - M) R U' + 3/2 (1 - M/3) U^2 = (1 + M) h + s R f dh/dt``.

Rayleigh-Plesset: ``s = 0``, ``h = p_w - p_far``. Keller-Miksis in pressure (Keller & Miksis, J.
Acoust. Soc. Am. 68, 1980): ``h = p_w - p_far``, ``f = 1``. In enthalpy (Prosperetti & Lezzi, J.
Fluid Mech. 168, 1986): ``h`` of a Tait liquid. Gilmore (Caltech report 26-4, 1952): the same with
the sound speed at the wall and ``f = 1 - M``. ``dh/dt`` holds ``U'`` through viscous stress; that
part is taken to the left. Pressures are over ``p_inf``, velocities over ``U_c``. A mirror bubble of
strength ``b`` adds its pressure ``b d(R^2 U)/dt`` at the wall.

Each equation is one law of scalars (:mod:`imr_torch.elementary`) with the arguments ``radius`` R,
``velocity`` U, ``pressure`` p_w in the liquid at the wall, ``rate`` (the part of dp_w/dt without
U'), ``inertia`` (the factor of U' in it), ``far`` p_far and ``far_rate`` (its time derivative),
``slowness`` 1/c of the undisturbed liquid, ``image`` b, and the constants of the liquid.
"""

import math
from dataclasses import astuple, dataclass
from typing import ClassVar

from imr_torch.elementary import Law, Scalar, expm1, log1p, power
from imr_torch.errors import InputDataError


def _wall_acceleration(
    radius: Scalar,
    velocity: Scalar,
    enthalpy: Scalar,
    rate: Scalar,
    inertia: Scalar,
    slowness: Scalar,
    weight: Scalar,
    image: Scalar,
) -> Scalar:
    """``U'`` from ``h``, the part of ``dh/dt`` without ``U'``, the factor of ``U'`` in it, and
    ``f`` (``weight``).
    """
    mach = slowness * velocity
    delay = slowness * radius * weight
    square = velocity * velocity
    pull = image * radius * (1.0 + mach)
    force = (
        (1.0 + mach) * enthalpy + delay * rate - (1.5 - 0.5 * mach) * square - 2.0 * pull * square
    )
    return force / ((1.0 - mach) * radius - delay * inertia + pull * radius)


def rayleigh_plesset(
    radius: Scalar,
    velocity: Scalar,
    pressure: Scalar,
    rate: Scalar,
    inertia: Scalar,
    far: Scalar,
    far_rate: Scalar,
    slowness: Scalar,
    image: Scalar,
) -> Scalar:
    """An incompressible liquid: the speed of sound plays no part."""
    return _wall_acceleration(
        radius, velocity, pressure - far, rate - far_rate, inertia, 0.0 * slowness, 1.0, image
    )


def keller_miksis(
    radius: Scalar,
    velocity: Scalar,
    pressure: Scalar,
    rate: Scalar,
    inertia: Scalar,
    far: Scalar,
    far_rate: Scalar,
    slowness: Scalar,
    image: Scalar,
) -> Scalar:
    """Compressible to first order in the Mach number, in pressure."""
    return _wall_acceleration(
        radius, velocity, pressure - far, rate - far_rate, inertia, slowness, 1.0, image
    )


def _compression_of(pressure: Scalar, stiffness: Scalar) -> Scalar:
    """``(p + B)/(1 + B)``."""
    return (pressure + stiffness) / (1.0 + stiffness)


def _specific_volume(pressure: Scalar, exponent: Scalar, stiffness: Scalar) -> Scalar:
    """``w = dh/dp`` of a Tait liquid, 1 at ``p_inf``."""
    return power(_compression_of(pressure, stiffness), -1.0 / exponent)


def _enthalpy_at(pressure: Scalar, exponent: Scalar, stiffness: Scalar) -> Scalar:
    """``h`` above that at ``p_inf``.

    ``expm1`` and ``log1p`` keep it exact near there and for a stiff liquid.
    """
    share = 1.0 - 1.0 / exponent
    return (1.0 + stiffness) / share * expm1(share * log1p((pressure - 1.0) / (1.0 + stiffness)))


def _tait_liquid(
    pressure: Scalar,
    rate: Scalar,
    far: Scalar,
    far_rate: Scalar,
    exponent: Scalar,
    stiffness: Scalar,
) -> tuple[Scalar, Scalar, Scalar]:
    """``h`` between the wall and the far field, the part of its rate without ``U'``, and ``w`` at
    the wall.
    """
    near = _specific_volume(pressure, exponent, stiffness)
    beyond = _specific_volume(far, exponent, stiffness)
    enthalpy = _enthalpy_at(pressure, exponent, stiffness) - _enthalpy_at(far, exponent, stiffness)
    return enthalpy, near * rate - beyond * far_rate, near


def keller_miksis_enthalpy(
    radius: Scalar,
    velocity: Scalar,
    pressure: Scalar,
    rate: Scalar,
    inertia: Scalar,
    far: Scalar,
    far_rate: Scalar,
    slowness: Scalar,
    image: Scalar,
    exponent: Scalar,
    stiffness: Scalar,
) -> Scalar:
    """Compressible to first order in the Mach number, in the enthalpy of a Tait liquid."""
    enthalpy, change, near = _tait_liquid(pressure, rate, far, far_rate, exponent, stiffness)
    return _wall_acceleration(
        radius, velocity, enthalpy, change, near * inertia, slowness, 1.0, image
    )


def gilmore(
    radius: Scalar,
    velocity: Scalar,
    pressure: Scalar,
    rate: Scalar,
    inertia: Scalar,
    far: Scalar,
    far_rate: Scalar,
    slowness: Scalar,
    image: Scalar,
    exponent: Scalar,
    stiffness: Scalar,
) -> Scalar:
    """The enthalpy form with the sound speed of the Tait liquid at the wall, ``1/c = (1/c_0)
    q^(-(n-1)/(2n))``.
    """
    enthalpy, change, near = _tait_liquid(pressure, rate, far, far_rate, exponent, stiffness)
    slower = slowness * power(_compression_of(pressure, stiffness), -0.5 * (1.0 - 1.0 / exponent))
    return _wall_acceleration(
        radius, velocity, enthalpy, change, near * inertia, slower, 1.0 - slower * velocity, image
    )


@dataclass(frozen=True)
class RadialEquation:
    """One member of the family; a subclass names its law and has the liquid's constants as fields,
    in the law's order.

    >>> from imr_torch.simulate import RADIAL_EQUATIONS
    >>> list(RADIAL_EQUATIONS)
    ['rayleigh_plesset', 'keller_miksis', 'keller_miksis_enthalpy', 'gilmore']
    """

    key: ClassVar[str]
    law: ClassVar[Law]

    @property
    def constants(self) -> tuple[float, ...]:
        """What the law takes after ``image``."""
        return astuple(self)

    def acceleration(self, *state: Scalar) -> Scalar:
        """``U'``; the arguments are those of the law up to ``image``."""
        return type(self).law(*state, *self.constants)


@dataclass(frozen=True)
class RayleighPlesset(RadialEquation):
    """An incompressible liquid: the speed of sound plays no part.

    >>> from imr_torch.simulate import Conditions, PolytropicSimulator, RayleighPlesset
    >>> PolytropicSimulator(Conditions(motion=RayleighPlesset())).conditions.motion.key
    'rayleigh_plesset'
    """

    key = "rayleigh_plesset"
    law = staticmethod(rayleigh_plesset)


@dataclass(frozen=True)
class KellerMiksis(RadialEquation):
    """Compressible to first order in the Mach number, in pressure: the default.

    >>> from imr_torch.simulate import Conditions, KellerMiksis
    >>> Conditions().motion == KellerMiksis()
    True
    """

    key = "keller_miksis"
    law = staticmethod(keller_miksis)


@dataclass(frozen=True)
class KellerMiksisEnthalpy(RadialEquation):
    """Compressible to first order in the Mach number, in the enthalpy of a Tait liquid.

    Args:
        exponent: ``n`` of ``(p + B)/(p_inf + B) = (rho/rho_inf)^n``.
        stiffness: ``B`` over ``p_inf``.

    >>> from imr_torch.simulate import KellerMiksisEnthalpy
    >>> KellerMiksisEnthalpy(exponent=7.0).exponent
    7.0
    """

    exponent: float = 7.15
    stiffness: float = 304.913e6 / 101325.0

    key = "keller_miksis_enthalpy"
    law = staticmethod(keller_miksis_enthalpy)

    def __post_init__(self) -> None:
        if not (1.0 < self.exponent < math.inf and 0.0 < self.stiffness < math.inf):
            raise InputDataError(
                f"{type(self).__name__} has exponent {self.exponent} and stiffness "
                f"{self.stiffness}; expected exponent > 1 "
                "and stiffness > 0 (B over p_inf), both finite."
            )


@dataclass(frozen=True)
class Gilmore(KellerMiksisEnthalpy):
    """The enthalpy form with the sound speed of the Tait liquid at the wall, scaled to ``c`` of the
    undisturbed liquid.

    >>> from imr_torch.simulate import Conditions, Gilmore, PolytropicSimulator
    >>> PolytropicSimulator(Conditions(motion=Gilmore())).conditions.motion.key
    'gilmore'
    """

    key = "gilmore"
    law = staticmethod(gilmore)


RADIAL_EQUATIONS: dict[str, RadialEquation] = {
    equation.key: equation
    for equation in (RayleighPlesset(), KellerMiksis(), KellerMiksisEnthalpy(), Gilmore())
}
"""Key -> radial equation, with the Tait constants of water at 1 atm (Fujikawa & Akamatsu, J. Fluid Mech. 97, 1980)."""
