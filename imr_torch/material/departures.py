"""Stress terms beside those of a model: damage of modulus and viscosity, a yield stress, a graded
modulus, a permanent set, and generic laws.

Each of the former is a correction to a model's elastic stress with one parameter, neutral at zero,
so that it can be added to any model and inferred with it. They are simple closures that act where
the effect does, not complete constitutive laws.

The generic laws (:data:`CLOSURE`) are seven functions of the bubble's state, whose linear
combinations approximate any local stress law: ``lambda - 1``, ``(lambda - 1)^2``, ``lambda^-3 - 1``,
``lambda^-6 - 1``, ``U``, ``U|U|`` and ``(U/R)|U/R|`` with the stretch ``lambda = R/R_inf``. They model
no particular material: the gap test detects with them a missing stress law that is in no library.
Coefficients are pressures over ``p_inf``; each does nothing at zero. ``|U|`` is rounded off at small
velocities.
"""

from imr_torch.elementary import Scalar, Scalars, log, sqrt, where
from imr_torch.material.elastic import neo_hookean, stiffening
from imr_torch.material.stress import SMOOTH, StressTerm
from imr_torch.material.viscous import newtonian

SLOWEST_SHEAR = 0.1
"""Dimensionless shear rate below which a yield stress is left out."""


def _elastic_stress(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G: Scalar, alpha: Scalar
) -> tuple[Scalar, Scalar]:
    """Value and rate of the elastic stress of the models that may be damaged or set."""
    value, rate, _ = neo_hookean(radius, velocity, rest_radius, G)
    more, more_rate, _ = stiffening(radius, velocity, rest_radius, G, alpha)
    return value + more, rate + more_rate


def _strain_rate(radius: Scalar, velocity: Scalar) -> Scalar:
    """``|U|/R``, rounded off at small velocities: its time integral is the accumulated strain at
    the wall.
    """
    return (sqrt(velocity * velocity + SMOOTH * SMOOTH) - SMOOTH) / radius


def damaged(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    lost: Scalar,
    G: Scalar,
    alpha: Scalar,
    damage: Scalar,
    healing: Scalar,
) -> Scalars:
    """Softening with accumulated strain: ``S_e (1 - D)``, ``D' = k (1 - D) |U|/R - D/t_h``. The
    state is ``D``.

    Strain breaks a share of the bonds that carry the elastic stress; with healing they form anew at
    the rate ``1/t_h``, as in gels with transient crosslinks (Long, Mayumi, Creton, Narita & Hui,
    Macromolecules 47, 2014). A modulus that falls over the event is reported by Spratt et al. (J.
    Mech. Phys. Solids 152, 2021).
    """
    value, rate = _elastic_stress(radius, velocity, rest_radius, G, alpha)
    growth = damage * (1.0 - lost) * _strain_rate(radius, velocity) - healing * lost
    return -lost * value, -growth * value - lost * rate, 0.0, growth


def _healing_rate(G: Scalar, alpha: Scalar, damage: Scalar, healing: Scalar) -> Scalar:
    return healing


def thinned_by_damage(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    lost: Scalar,
    mu: Scalar,
    tau: Scalar,
    tau_sls: Scalar,
    tau_sns: Scalar,
    tau_ucm: Scalar,
    tau_giesekus: Scalar,
    tau_ptt: Scalar,
    viscous_damage: Scalar,
) -> Scalars:
    """Viscosity that falls with accumulated strain: ``S_v (1 - D)``, ``D' = k (1 - D) |U|/R``. The
    state is ``D``.

    ``S_v`` is the Newtonian stress. An apparent viscosity that falls over the event and levels off
    as the motion fades is reported for polyacrylamide by Chu et al. (arXiv 2606.13584). A viscous
    stress that relaxes is left alone: its law replaces the Newtonian one, of which nothing is left
    to take.
    """
    relaxing = tau + tau_sls + tau_sns + tau_ucm + tau_giesekus + tau_ptt
    instant = where(relaxing > 0.0, 0.0, mu)
    value, rate, acceleration = newtonian(radius, velocity, rest_radius, instant)
    growth = viscous_damage * (1.0 - lost) * _strain_rate(radius, velocity)
    return -lost * value, -growth * value - lost * rate, -lost * acceleration, growth


def yielding(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, yield_stress: Scalar
) -> Scalars:
    """A yield stress: ``S = -2 tau_y sign(U) ln(r_y/R)``, with ``r_y`` where the shear rate falls
    to a slow one.

    The shear rate falls as ``r^-3``, so ``ln(r_y/R)`` is a third of the log of the shear rate at
    the wall over the slow one.
    """
    strain = velocity / radius
    ratio = strain / SLOWEST_SHEAR
    square = 1.0 + ratio * ratio
    steep = SLOWEST_SHEAR / SMOOTH
    rounded = 1.0 + steep * steep * ratio * ratio
    root = sqrt(rounded)
    direction = steep * ratio / root
    extent = log(square) / 6.0
    scale = -2.0 * yield_stress
    by_strain = direction * ratio / (3.0 * square * SLOWEST_SHEAR) + extent / (
        SMOOTH * rounded * root
    )
    return (
        scale * direction * extent,
        -scale * by_strain * strain * strain,
        scale * by_strain / radius,
    )


def graded(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G: Scalar, graded_modulus: Scalar
) -> Scalars:
    """A modulus ``G (1 + g (R_inf/r_0)^3)`` of the gel at rest: harder (or softer) towards the
    bubble.

    With the hoop stretch ``b``, ``(R_inf/r_0)^3 = (b^3 - 1)/(l^3 - 1)``: ``S = -2 G g int (b^2 -
    b^-4)/(l^3 - 1) d ln b`` from 1 to ``l``, which is ``-2 G g (l^3 - 1) q`` with ``q = ((l + 1)/(2
    l^2 (l^2 + l + 1)))^2 (2 l^2 + 1)``.
    """
    stretch = radius / rest_radius
    inverse = rest_radius / radius
    square = stretch * stretch
    cube = stretch * stretch * stretch
    root = (stretch + 1.0) / (2.0 * square * (square + stretch + 1.0))
    q = root * root * (2.0 * square + 1.0)
    # of (l^3 - 1) q in ln l
    slope = inverse * (1.0 + inverse * inverse * inverse) - 3.0 * cube * q
    scale = -2.0 * G * graded_modulus
    return scale * (cube - 1.0) * q, scale * slope * velocity / radius, 0.0


def stretched(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    G: Scalar,
    alpha: Scalar,
    permanent_set: Scalar,
) -> Scalars:
    """A permanent set from the growth of the bubble: its elastic stress is referred to ``R_inf (1 +
    s (1/R_inf - 1))``.

    The gas is not: it still rests at ``R_inf``. The set grows with the stretch ``1/R_inf`` at the
    maximum radius.
    """
    moved = rest_radius + permanent_set * (1.0 - rest_radius)
    value, rate = _elastic_stress(radius, velocity, moved, G, alpha)
    before, before_rate = _elastic_stress(radius, velocity, rest_radius, G, alpha)
    return value - before, rate - before_rate, 0.0


def _signed_square(x: Scalar) -> tuple[Scalar, Scalar]:
    """``x|x|`` and its derivative."""
    size = sqrt(x * x + SMOOTH * SMOOTH)
    return x * size, size + x * x / size


def stretch(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_stretch: Scalar
) -> Scalars:
    """``lambda - 1``."""
    return (
        -law_stretch * (radius / rest_radius - 1.0),
        -law_stretch * velocity / rest_radius,
        0.0,
    )


def squared_stretch(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_stretch_squared: Scalar
) -> Scalars:
    """``(lambda - 1)^2``."""
    strain = radius / rest_radius - 1.0
    return (
        -law_stretch_squared * strain * strain,
        -2.0 * law_stretch_squared * strain * velocity / rest_radius,
        0.0,
    )


def compression(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_compression: Scalar
) -> Scalars:
    """``lambda^-3 - 1``."""
    inverse = rest_radius / radius
    cubed = inverse * inverse * inverse
    return (
        -law_compression * (cubed - 1.0),
        3.0 * law_compression * cubed * velocity / radius,
        0.0,
    )


def steep_compression(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_compression_steep: Scalar
) -> Scalars:
    """``lambda^-6 - 1``."""
    inverse = rest_radius / radius
    cubed = inverse * inverse * inverse
    sixth = cubed * cubed
    return (
        -law_compression_steep * (sixth - 1.0),
        6.0 * law_compression_steep * sixth * velocity / radius,
        0.0,
    )


def speed(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_velocity: Scalar
) -> Scalars:
    """``U``."""
    return -law_velocity * velocity, 0.0, -law_velocity


def squared_speed(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_velocity_squared: Scalar
) -> Scalars:
    """``U|U|``."""
    value, slope = _signed_square(velocity)
    return -law_velocity_squared * value, 0.0, -law_velocity_squared * slope


def squared_rate(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_rate_squared: Scalar
) -> Scalars:
    """``(U/R)|U/R|``."""
    rate = velocity / radius
    value, slope = _signed_square(rate)
    return (
        -law_rate_squared * value,
        law_rate_squared * slope * rate * rate,
        -law_rate_squared * slope / radius,
    )


DEPARTURES = (
    StressTerm(damaged, switch="damage", states=1, fastest=_healing_rate),
    StressTerm(thinned_by_damage, switch="viscous_damage", states=1),
    StressTerm(yielding, switch="yield_stress"),
    StressTerm(graded, switch="graded_modulus"),
    StressTerm(stretched, switch="permanent_set"),
)
"""The terms of damage, yield stress, graded modulus and permanent set."""

CLOSURE = (
    StressTerm(stretch, switch="law_stretch"),
    StressTerm(squared_stretch, switch="law_stretch_squared"),
    StressTerm(compression, switch="law_compression"),
    StressTerm(steep_compression, switch="law_compression_steep"),
    StressTerm(speed, switch="law_velocity"),
    StressTerm(squared_speed, switch="law_velocity_squared"),
    StressTerm(squared_rate, switch="law_rate_squared"),
)
"""The generic laws, in the order above."""
