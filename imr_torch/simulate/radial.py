"""Radial equations: the acceleration of the bubble wall from the pressures on both sides of it.

With ``s = 1/c``, ``M = s U`` and the liquid's enthalpy ``h`` between the wall and the far field
(:mod:`imr_torch.simulate.liquids`), all share one form,

``(1 - (1 + l) M + b M^2) R U' + 3/2 (1 - (1/3 + l) M + 23/30 b M^2) U^2
= (1 + (1 - l) M + 6/5 b M^2) h + s R f dh/dt - k b s^2 h^2``.

Rayleigh-Plesset: ``s = 0``. First order in M, ``b = 0`` and ``f = 1`` (Prosperetti & Lezzi, J. Fluid
Mech. 168, 1986): ``l = 0`` is Keller-Miksis (J. Acoust. Soc. Am. 68, 1980), in pressure or in
enthalpy; ``l = 1`` is Herring's (OSRD report 236, 1941; Trilling, J. Appl. Phys. 23, 1952). Gilmore
(Caltech report 26-4, 1952): ``l = 0``, ``s`` that of the liquid at the wall and ``f = 1 - M``.

Second order (Lezzi & Prosperetti, J. Fluid Mech. 185, 1987, find a family of equations that agree to
that order): ``b = 1``, ``l = 0``, ``f = 1 - M``, ``k = 1``, the member that is Keller-Miksis at first
order and has no derivative beyond U'. It follows from the inner potential ``-q/r + q'/c + (-q'' r/2 +
q q'/r^2 - q^3/(10 r^5) - A/r)/c^2``, ``q = R^2 U``, with ``A`` from the velocity of the wall, and is to
this order Tomita & Shima's (Bull. JSME 20, 1977). In pressure ``k = 3/2``, since ``h = p - s^2
p^2/2``. Any other ``b`` lies between Keller-Miksis and that.

``dh/dt`` holds ``U'`` through viscous stress; that part is taken to the left. Pressures are over
``p_inf``, velocities over ``U_c``. A mirror bubble of strength ``image`` adds its pressure ``image
d(R^2 U)/dt`` at the wall.

It is one law of scalars (:mod:`imr_torch.elementary`) with the arguments ``radius`` R,
``velocity`` U, ``enthalpy`` h, ``rate`` (the part of dh/dt without U'), ``inertia`` (the factor of U'
in it), ``slowness`` 1/c of the undisturbed liquid, ``local`` 1/c at the wall, ``image``, ``beyond`` b,
and the numbers of its :class:`Form`.
"""

from dataclasses import dataclass, field, fields
from math import inf, nan
from typing import ClassVar, NamedTuple

from imr_torch.elementary import Law, Scalar, real, where
from imr_torch.simulate.liquids import LIQUIDS, Liquid

SINGULAR = 1e-3
"""Share of the inertia of an incompressible liquid below which an equation is singular."""
NEARLY_SONIC = 0.9
"""Share of that Mach number from which on a bubble that fails is said to have failed there."""


class Form(NamedTuple):
    """What makes one equation of the common form.

    Args:
        speed: 1, or 0 where the speed of sound plays no part.
        at_wall: 1 where it is that at the wall, and ``f = 1 - M``.
        lag: ``l``.
        whole: ``b``.
        blend: factor on a bubble's own share of second order, which is added to ``b``.
        quadratic: ``k``.
    """

    speed: float = 1.0
    at_wall: float = 0.0
    lag: float = 0.0
    whole: float = 0.0
    blend: float = 0.0
    quadratic: float = 1.0


def accelerate_wall(
    radius: Scalar,
    velocity: Scalar,
    enthalpy: Scalar,
    rate: Scalar,
    inertia: Scalar,
    slowness: Scalar,
    local: Scalar,
    image: Scalar,
    beyond: Scalar,
    speed: Scalar,
    at_wall: Scalar,
    lag: Scalar,
    whole: Scalar,
    blend: Scalar,
    quadratic: Scalar,
) -> Scalar:
    """``U'``; NaN where the factor of ``U'`` vanishes."""
    slower = speed * (slowness + at_wall * (local - slowness))
    mach = slower * velocity
    order = whole + blend * beyond
    second = order * mach * mach
    share = 1.0 + (1.0 - lag) * mach
    delay = slower * radius * (1.0 - (at_wall + order) * mach)
    square = velocity * velocity
    pull = image * radius * share
    excess = slower * enthalpy
    force = (
        (share + 1.2 * second) * enthalpy
        + delay * rate
        - (1.5 - (0.5 + 1.5 * lag) * mach + 1.15 * second) * square
        - quadratic * order * excess * excess
        - 2.0 * pull * square
    )
    mass = (1.0 - (1.0 + lag) * mach + second) * radius - delay * inertia + pull * radius
    return where(real(mass) > SINGULAR * real(radius), force / mass, nan)


def drive_wall(
    state: tuple[Scalar, ...],
    near: tuple[Scalar, Scalar, Scalar],
    away: tuple[Scalar, Scalar, Scalar],
) -> tuple[Scalar, ...]:
    """The arguments of a law up to ``beyond`` from pressures.

    Args:
        state: radius, velocity, pressure in the liquid at the wall, the part of its rate without
            ``U'``, the factor of ``U'`` in it, far-field pressure and its rate, slowness, image,
            beyond.
        near: the liquid at the pressure at the wall.
        away: the liquid at the far-field pressure.
    """
    radius, velocity, _, rate, inertia, _, far_rate, slowness, image, beyond = state
    change = near[1] * rate - away[1] * far_rate
    inertia = near[1] * inertia
    local = slowness * near[2]
    enthalpy = near[0] - away[0]
    return radius, velocity, enthalpy, change, inertia, slowness, local, image, beyond


@dataclass(frozen=True)
class RadialEquation:
    """One member of the family; a subclass says its form, or has a law of its own with the same
    arguments, and may have constants as further fields, which the law takes last.

    Args:
        liquid: gives the enthalpy, see :data:`~imr_torch.simulate.LIQUIDS`; equations in pressure take
            none.

    >>> from imr_torch.simulate import RADIAL_EQUATIONS
    >>> list(RADIAL_EQUATIONS)[:4]
    ['rayleigh_plesset', 'keller_miksis', 'keller_miksis_enthalpy', 'herring']
    """

    key: ClassVar[str]
    law: ClassVar[Law] = staticmethod(accelerate_wall)
    form: ClassVar[Form] = Form()
    sonic: ClassVar[float] = inf
    """Mach number of the wall at which it is singular."""

    liquid: Liquid = field(default=LIQUIDS["constant_density"], init=False, repr=False)

    @property
    def constants(self) -> tuple[float, ...]:
        """What the law takes after the form."""
        return tuple(getattr(self, x.name) for x in fields(self) if x.name != "liquid")

    def acceleration(self, *state: Scalar) -> Scalar:
        """``U'``; ``state`` is that of :func:`drive_wall`."""
        near = self.liquid.at(state[2], state[7])
        away = self.liquid.at(state[5], state[7])
        return type(self).law(*drive_wall(state, near, away), *self.form, *self.constants)


@dataclass(frozen=True)
class RayleighPlesset(RadialEquation):
    """An incompressible liquid: the speed of sound plays no part.

    >>> from imr_torch.simulate import Conditions, PolytropicSimulator, RayleighPlesset
    >>> PolytropicSimulator(Conditions(motion=RayleighPlesset())).conditions.motion.key
    'rayleigh_plesset'
    """

    key = "rayleigh_plesset"
    form = Form(speed=0.0)


@dataclass(frozen=True)
class KellerMiksis(RadialEquation):
    """Compressible to first order in the Mach number, in pressure: the default.

    >>> from imr_torch.simulate import Conditions, KellerMiksis
    >>> Conditions().motion == KellerMiksis()
    True
    """

    key = "keller_miksis"
    form = Form(blend=1.0, quadratic=1.5)
    sonic = 1.0


@dataclass(frozen=True)
class KellerMiksisEnthalpy(RadialEquation):
    """Compressible to first order in the Mach number, in the enthalpy of a liquid.

    >>> from imr_torch.simulate import KellerMiksisEnthalpy, Tait
    >>> KellerMiksisEnthalpy(Tait(exponent=7.0)).liquid.exponent
    7.0
    """

    liquid: Liquid = LIQUIDS["tait"]

    key = "keller_miksis_enthalpy"
    form = Form(blend=1.0)
    sonic = 1.0


@dataclass(frozen=True)
class Herring(RadialEquation):
    """Compressible to first order in the Mach number, as Herring and Trilling have it.

    >>> from imr_torch.simulate import Herring
    >>> Herring().sonic
    0.5
    """

    liquid: Liquid = LIQUIDS["constant_density"]

    key = "herring"
    form = Form(lag=1.0)
    sonic = 0.5


@dataclass(frozen=True)
class Gilmore(RadialEquation):
    """The enthalpy form with the sound speed of the liquid at the wall, scaled to ``c`` of the
    undisturbed liquid.

    >>> from imr_torch.simulate import Conditions, Gilmore, NobleAbel, PolytropicSimulator
    >>> PolytropicSimulator(Conditions(motion=Gilmore(NobleAbel()))).conditions.motion.liquid.key
    'noble_abel'
    """

    liquid: Liquid = LIQUIDS["tait"]

    key = "gilmore"
    form = Form(at_wall=1.0)
    sonic = 1.0


@dataclass(frozen=True)
class SecondOrder(RadialEquation):
    """Compressible to second order in the Mach number, in the enthalpy of a liquid.

    >>> from imr_torch.simulate import SecondOrder
    >>> SecondOrder().liquid.key
    'tait'
    """

    liquid: Liquid = LIQUIDS["tait"]

    key = "second_order"
    form = Form(whole=1.0)


RADIAL_EQUATIONS: dict[str, RadialEquation] = {
    equation.key: equation
    for equation in (
        RayleighPlesset(),
        KellerMiksis(),
        KellerMiksisEnthalpy(),
        Herring(),
        Gilmore(),
        SecondOrder(),
    )
}
"""Key -> radial equation, each with its usual liquid."""
