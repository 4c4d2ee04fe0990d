"""Stress laws of viscosity without memory: Newtonian, and thinning with the shear rate.

In spherical motion the velocity is ``u = R^2 U/r^2`` and the shear rate ``2 sqrt(3) R^2 |U|/r^3``.
With ``x = (R/r)^3`` a viscosity that depends on the shear rate gives ``S = -4 (U/R) int_0^1
mu(gamma_wall x) dx``, so ``S`` depends on ``U/R`` alone and ``dS/d(U/R)`` is four times the
viscosity at the wall: nothing but ``S`` itself needs quadrature.

Sources: Estrada et al. (J. Mech. Phys. Solids 112, 2018), eq. 10; Carreau (Trans. Soc. Rheol. 16,
1972); Gaudron, Warnez & Johnsen (J. Fluid Mech. 766, 2015), section 2.3 for the integral.
"""

from imr_torch.elementary import Scalar, asinh, cosh, expm1, log, real, where
from imr_torch.material.stress import StressTerm, unit_rule


def newtonian(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, mu: Scalar
) -> tuple[Scalar, ...]:
    """``S = -4 U / (Re R)`` (Estrada et al. 2018, eq. 10)."""
    factor = -4.0 * mu / radius
    value = factor * velocity
    return value, -value * velocity / radius, factor


_RULE = unit_rule(16)
WALL_SHEAR = 2.0 * 3.0**0.5
"""Shear rate at the wall over ``|U|/R``."""


def carreau(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    mu: Scalar,
    thinning: Scalar,
    shear_time: Scalar,
) -> tuple[Scalar, ...]:
    """What shear thinning takes off the Newtonian law: ``mu(g) = mu (1 + (t_s g)^2)^(-s/2)``,
    Carreau (1972).

    ``s = 1 - n`` with the flow index ``n``; ``s = 0`` is Newtonian. The integral over the gel is
    taken by Gauss-Legendre quadrature in ``asinh`` of the shear rate, where the integrand is
    smooth: 16 nodes leave less than 1e-12 of ``mu`` up to ``t_s g = 1e4``.
    """
    factor = 4.0 * mu
    strain = velocity / radius
    reduced = WALL_SHEAR * shear_time * strain
    span = asinh(reduced)
    still = real(reduced) == 0.0
    stretch = where(still, 1.0, span / where(still, 1.0, reduced))
    mean = 0.0 * span  # over shear rates of sinh(x) with x from 0 to the span
    for node, weight in _RULE:
        rate = cosh(node * span)
        mean = mean - weight * rate * expm1(-thinning * log(rate))
    lost = stretch * mean  # of the mean viscosity over mu
    lost_at_wall = -expm1(-0.5 * thinning * log(1.0 + reduced * reduced))
    return (
        factor * strain * lost,
        -factor * lost_at_wall * strain * strain,
        factor * lost_at_wall / radius,
    )


NEWTONIAN = StressTerm(newtonian, switch="mu", odd=("mu",))
CARREAU = StressTerm(carreau, switch="thinning", odd=("mu",))
