"""Stress laws of viscosity without memory: Newtonian, and viscosities that depend on the shear rate.

In spherical motion the velocity is ``u = R^2 U/r^2`` and the shear rate ``2 sqrt(3) R^2 |U|/r^3``.
With ``x = (R/r)^3`` a viscosity that depends on the shear rate gives ``S = -4 (U/R) int_0^1
mu(gamma_wall x) dx``, so ``S`` depends on ``U/R`` alone and ``dS/d(U/R)`` is four times the
viscosity at the wall: nothing but ``S`` itself needs quadrature.

Sources: Estrada et al. (J. Mech. Phys. Solids 112, 2018), eq. 10; Carreau (Trans. Soc. Rheol. 16,
1972); Gaudron, Warnez & Johnsen (J. Fluid Mech. 766, 2015), section 2.3 for the integral; Yasuda,
Armstrong & Cohen (Rheol. Acta 20, 1981); Cross (J. Colloid Sci. 20, 1965); Powell & Eyring (Nature
154, 1944); Ostwald (Kolloid-Z. 36, 1925) and de Waele (J. Oil Colour Chem. Assoc. 6, 1923).
"""

from imr_torch.elementary import (
    Law,
    Scalar,
    Scalars,
    asinh,
    cosh,
    expm1,
    log1p,
    power,
    real,
    sinh,
    sqrt,
    where,
)
from imr_torch.material.stress import SMOOTH, StressTerm, unit_rule


def newtonian(radius: Scalar, velocity: Scalar, rest_radius: Scalar, mu: Scalar) -> Scalars:
    """``S = -4 U / (Re R)`` (Estrada et al. 2018, eq. 10)."""
    factor = -4.0 * mu / radius
    value = factor * velocity
    return value, -value * velocity / radius, factor


_RULE = unit_rule(16, 2)
WALL_SHEAR = 2.0 * 3.0**0.5
"""Shear rate at the wall over ``|U|/R``."""


def _lose_viscosity(
    radius: Scalar,
    velocity: Scalar,
    mu: Scalar,
    time: Scalar,
    lost: Law,
    *parameters: Scalar,
) -> Scalars:
    """What shear takes off the Newtonian law where ``mu(g) = mu (1 - lost(t g, *parameters))``.

    The integral over the gel is taken by quadrature in the root of ``asinh`` of the shear rate: its
    error is below 1e-12 of ``mu`` where ``lost`` is smooth, and below 1e-6 where it grows with a
    power of ``t g`` from 0.3 to 5, up to ``t g = 1e4``.
    """
    factor = 4.0 * mu
    strain = velocity / radius
    reduced = WALL_SHEAR * time * strain
    still = real(reduced) == 0.0
    size = where(still, 1.0, where(real(reduced) < 0.0, -reduced, reduced))
    span = asinh(size)
    mean = 0.0 * span  # over shear rates of sinh(x) with x from 0 to the span
    for node, weight in _RULE:
        shear = node * span
        mean = mean + weight * cosh(shear) * lost(sinh(shear), *parameters)
    mean = where(still, 0.0, span / size * mean)
    at_wall = where(still, 0.0, lost(size, *parameters))
    return (
        factor * strain * mean,
        -factor * at_wall * strain * strain,
        factor * at_wall / radius,
    )


def _carreau_loss(shear: Scalar, thinning: Scalar) -> Scalar:
    return -expm1(-0.5 * thinning * log1p(shear * shear))


def carreau(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    mu: Scalar,
    thinning: Scalar,
    shear_time: Scalar,
) -> Scalars:
    """What shear thinning takes off the Newtonian law: ``mu(g) = mu (1 + (t_s g)^2)^(-s/2)``,
    Carreau (1972).

    ``s = 1 - n`` with the flow index ``n``; ``s = 0`` is Newtonian.
    """
    return _lose_viscosity(radius, velocity, mu, shear_time, _carreau_loss, thinning)


def _yasuda_loss(shear: Scalar, thinning: Scalar, yasuda: Scalar) -> Scalar:
    return -expm1(-thinning / yasuda * log1p(power(shear, yasuda)))


def carreau_yasuda(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    mu: Scalar,
    thinning_yasuda: Scalar,
    yasuda: Scalar,
    shear_time: Scalar,
    plateau: Scalar,
) -> Scalars:
    """``mu(g)/mu = p + (1 - p) (1 + (t_s g)^a)^(-s/a)`` (Yasuda, Armstrong & Cohen 1981); ``a = 2``
    is Carreau's, ``p`` the viscosity at the highest rates over that at rest.
    """
    return _lose_viscosity(
        radius,
        velocity,
        mu * (1.0 - plateau),
        shear_time,
        _yasuda_loss,
        thinning_yasuda,
        yasuda,
    )


def _cross_loss(shear: Scalar, cross_exponent: Scalar) -> Scalar:
    return 1.0 - 1.0 / (1.0 + power(shear, cross_exponent))


def cross(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    mu: Scalar,
    cross_time: Scalar,
    cross_exponent: Scalar,
    plateau: Scalar,
) -> Scalars:
    """``mu(g)/mu = p + (1 - p)/(1 + (t g)^m)`` (Cross 1965)."""
    return _lose_viscosity(
        radius, velocity, mu * (1.0 - plateau), cross_time, _cross_loss, cross_exponent
    )


def _eyring_loss(shear: Scalar) -> Scalar:
    return 1.0 - asinh(shear) / shear


def powell_eyring(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    mu: Scalar,
    eyring_time: Scalar,
    plateau: Scalar,
) -> Scalars:
    """``mu(g)/mu = p + (1 - p) asinh(t g)/(t g)`` (Powell & Eyring 1944)."""
    return _lose_viscosity(
        radius, velocity, mu * (1.0 - plateau), eyring_time, _eyring_loss
    )


def power_law(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    mu: Scalar,
    power_thinning: Scalar,
    reference_rate: Scalar,
) -> Scalars:
    """``mu(g) = mu (g/g_r)^-s`` (Ostwald 1925, de Waele 1923), less the Newtonian law: ``S = -4
    mu(g_w)/(1 - s) U/R``.

    ``s = 1 - n`` with the flow index ``n``; ``mu`` is the viscosity at the rate ``g_r``. ``U`` is
    rounded off in ``mu(g)``, which has no bound at rest.
    """
    factor = 4.0 * mu
    speed = velocity * velocity + SMOOTH * SMOOTH
    wall = WALL_SHEAR * sqrt(speed) / radius / reference_rate
    mean = power(wall, -power_thinning) / (1.0 - power_thinning)
    by_velocity = (
        factor / radius * (1.0 - mean * (1.0 - power_thinning * velocity**2 / speed))
    )
    strain = velocity / radius
    by_radius = -factor / radius * strain * (1.0 - mean * (1.0 - power_thinning))
    return factor * strain * (1.0 - mean), by_radius * velocity, by_velocity


NEWTONIAN = StressTerm(newtonian, switch="mu", odd=("mu",))
SHEAR_DEPENDENT = (
    StressTerm(carreau, switch="thinning", odd=("mu",)),
    StressTerm(carreau_yasuda, switch="thinning_yasuda", beside=("plateau",), odd=("mu",)),
    StressTerm(cross, switch="cross_time", beside=("plateau",), odd=("mu",)),
    StressTerm(powell_eyring, switch="eyring_time", beside=("plateau",), odd=("mu",)),
    StressTerm(power_law, switch="power_thinning", beside=("reference_rate",), odd=("mu",)),
)
"""The terms of the laws whose viscosity depends on the shear rate."""
