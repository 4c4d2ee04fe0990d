"""Liquids: specific enthalpy, specific volume and sound speed as functions of the pressure.

Each is one law of scalars (:mod:`imr_torch.elementary`) with the arguments ``pressure`` (over
``p_inf``), ``slowness`` (``1/c`` of the undisturbed liquid, in ``1/U_c``) and its constants. It
returns ``h`` up to a constant, ``w = dh/dp`` (1 at ``p_inf``), and the slowness over that at
``p_inf``; NaN where the liquid does not exist.
"""

from dataclasses import astuple, dataclass, fields
from math import inf
from typing import ClassVar

from imr_torch.elementary import Law, Scalar, expm1, log1p, power, sqrt
from imr_torch.errors import InputDataError

ATMOSPHERE = 101325.0
"""Pa; what the constants of water here are over."""


def constant_density(pressure: Scalar, slowness: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """The equations in pressure."""
    one = 1.0 + 0.0 * pressure
    return pressure, one, one


def noble_abel(
    pressure: Scalar,
    slowness: Scalar,
    exponent: Scalar,
    stiffness: Scalar,
    covolume: Scalar,
) -> tuple[Scalar, Scalar, Scalar]:
    """``(p + B) (w - b)^n`` is constant; ``b = 0`` is Tait's law.

    ``expm1`` and ``log1p`` keep ``h`` exact near ``p_inf`` and for a stiff liquid.
    """
    free = 1.0 - covolume
    compression = (pressure + stiffness) / (1.0 + stiffness)
    volume = covolume + free * power(compression, -1.0 / exponent)
    share = 1.0 - 1.0 / exponent
    above = pressure - 1.0
    swelling = expm1(share * log1p(above / (1.0 + stiffness)))
    enthalpy = covolume * above + free * (1.0 + stiffness) / share * swelling
    return enthalpy, volume, power(compression, -0.5 - 0.5 / exponent) / volume


def mie_gruneisen(
    pressure: Scalar, slowness: Scalar, slope: Scalar, bend: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """``p - 1 = c^2 m (1 + g m)/(1 - a m)^2`` with ``m = 1/w - 1`` and ``a = slope - 1``; ``h`` is the
    integral of ``w`` by partial fractions.
    """
    a = slope - 1.0
    load = (pressure - 1.0) * slowness * slowness
    packing = 2.0 * load / (1.0 + 2.0 * load * a + sqrt(1.0 + 4.0 * load * (a + bend)))
    left = 1.0 - a * packing
    double = 2.0 * (a + bend) / slope
    outer = (1.0 - a - 2.0 * bend) / (slope * slope * slope)
    single = 1.0 - outer * slope - double
    logarithm = log1p(packing) - log1p(-a * packing)
    rational = packing * (single + double * (1.0 + left) / (2.0 * left)) / left
    enthalpy = (outer * logarithm + rational) / (slowness * slowness)
    stiffer = (1.0 + (a + 2.0 * bend) * packing) / (left * left * left)
    return enthalpy, 1.0 / (1.0 + packing), 1.0 / sqrt(stiffer)


@dataclass(frozen=True)
class Liquid:
    """A liquid; a subclass names its law and has its constants as fields, in the law's order.

    >>> from imr_torch.simulate import LIQUIDS
    >>> list(LIQUIDS)
    ['constant_density', 'tait', 'noble_abel', 'mie_gruneisen']
    """

    key: ClassVar[str]
    law: ClassVar[Law]
    bounds: ClassVar[tuple[tuple[float, float], ...]] = ()
    """Between which each constant must be."""

    @property
    def constants(self) -> tuple[float, ...]:
        """What the law takes after ``slowness``."""
        return astuple(self)

    def at(self, pressure: Scalar, slowness: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        """Enthalpy, specific volume, and slowness over that at ``p_inf``."""
        return type(self).law(pressure, slowness, *self.constants)

    def __post_init__(self) -> None:
        for entry, (low, high) in zip(fields(self), self.bounds, strict=True):
            if not low < getattr(self, entry.name) < high:
                raise InputDataError(
                    f"{self} cannot be: expected {entry.name} above {low:g} and below {high:g}."
                )


@dataclass(frozen=True)
class ConstantDensity(Liquid):
    """``h = p``: what equations in pressure assume.

    >>> from imr_torch.simulate import ConstantDensity
    >>> ConstantDensity().at(3.0, 0.007)
    (3.0, 1.0, 1.0)
    """

    key = "constant_density"
    law = staticmethod(constant_density)


@dataclass(frozen=True)
class Tait(Liquid):
    """``(p + B)/(p_inf + B) = (rho/rho_inf)^n``; the constants of water at 1 atm of Fujikawa &
    Akamatsu (J. Fluid Mech. 97, 1980).

    Args:
        exponent: ``n``.
        stiffness: ``B`` over ``p_inf``.

    >>> from imr_torch.simulate import Tait
    >>> Tait(exponent=7.0).exponent
    7.0
    """

    exponent: float = 7.15
    stiffness: float = 304.913e6 / ATMOSPHERE

    key = "tait"
    bounds = ((1.0, inf), (0.0, inf))
    law = staticmethod(noble_abel)

    @property
    def constants(self) -> tuple[float, ...]:
        """Those of a Noble-Abel liquid without covolume."""
        return self.exponent, self.stiffness, 0.0


@dataclass(frozen=True)
class NobleAbel(Liquid):
    """A Noble-Abel stiffened gas, whose molecules take a part of the volume; the constants of water
    of Le Metayer & Saurel (Phys. Fluids 28, 2016). With Gilmore's equation: Denner (Ultrason.
    Sonochem. 70, 2021).

    Args:
        exponent: ratio of specific heats.
        stiffness: ``B`` over ``p_inf``.
        covolume: ``b`` times the density at ``p_inf``.

    >>> from imr_torch.simulate import NobleAbel
    >>> 0.0 < NobleAbel().covolume < 1.0
    True
    """

    exponent: float = 1.19
    stiffness: float = 702.8e6 / ATMOSPHERE
    covolume: float = 6.61e-4 * 997.0

    key = "noble_abel"
    bounds = ((1.0, inf), (0.0, inf), (0.0, 1.0))
    law = staticmethod(noble_abel)


@dataclass(frozen=True)
class MieGruneisen(Liquid):
    """A liquid by the velocity of its shocks, ``c + slope u`` behind which it moves at ``u``.

    Its isentrope is taken as its Hugoniot, which it is to second order in the compression. Slope of
    water: Marsh, LASL Shock Hugoniot Data, 1980. IMRv2 has slope 2.65 and bend 3.075, with which the
    sound speed rises twice as fast with compression.

    Args:
        slope: of the velocity of shocks.
        bend: ``g``; 1 is the Hugoniot.

    >>> from imr_torch.simulate import MieGruneisen
    >>> MieGruneisen().slope
    1.921
    """

    slope: float = 1.921
    bend: float = 1.0

    key = "mie_gruneisen"
    bounds = ((1.0, inf), (0.0, inf))
    law = staticmethod(mie_gruneisen)


LIQUIDS: dict[str, Liquid] = {
    liquid.key: liquid
    for liquid in (ConstantDensity(), Tait(), NobleAbel(), MieGruneisen())
}
"""Key -> liquid, with the constants of water at 1 atm."""
