"""Stress laws of elasticity: each the integral of a strain energy over the gel round the bubble.

With the hoop stretch ``b`` of the material at a distance, ``S = -2 int_1^l (b^-2 + b^-5) dW/dI_1 /
(G/2) db/Ca`` over ``b`` from 1 (far away) to ``l = R/R_inf`` (the wall), and ``I_1 = b^-4 + 2
b^2``.

Sources: Gaudron, Warnez & Johnsen (J. Fluid Mech. 766, 2015) for the neo-Hookean integral; Yang et
al. (Soft Matter 16, 2020) for the quadratic (qKV) law; Fung (Am. J. Physiol. 213, 1967) for the
exponential law, of which qKV is the first order.
"""

from torch import Tensor

from imr_torch.elementary import Scalar, exp, expm1, log, real, where
from imr_torch.material.stress import StressTerm, unit_rule


def neo_hookean(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G: Scalar
) -> tuple[Scalar, ...]:
    """``S = -(5 - 4/l - 1/l^4) / (2 Ca)`` with ``l = R/R_inf`` (Gaudron et al. 2015, eq. 2.22)."""
    inverse = rest_radius / radius
    cubed = inverse * inverse * inverse
    value = -0.5 * G * (5.0 - inverse * (4.0 + cubed))
    slope = -2.0 * G * inverse * (1.0 + cubed)  # dS/d ln l
    return value, slope * velocity / radius, 0.0


def stiffening(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G: Scalar, alpha: Scalar
) -> tuple[Scalar, ...]:
    """The quadratic law of qKV, ``(alpha/Ca)(177/20 + 1/(4 l^8) + 2/(5 l^5) - 3/(2 l^4) + 2/l^2 -
    6/l - 4 l)``.

    Yang et al. (2020), eq. 13; ``alpha`` weighs the square of the first invariant ``I_1 - 3``.
    """
    x = rest_radius / radius
    x2 = x * x
    x3 = x2 * x
    stretch = 4.0 / x
    scale = alpha * G
    value = scale * (8.85 - stretch + x * (x3 * (x * (0.4 + 0.25 * x3) - 1.5) + 2.0 * x - 6.0))
    slope = scale * (-2.0 * x * (x3 * (x + x2 * x2 - 3.0) + 2.0 * x - 3.0) - stretch)  # dS/d ln l
    return value, slope * velocity / radius, 0.0


def _has_no_bound(G: Tensor, alpha: Tensor) -> Tensor:
    """At negative ``alpha`` the stress at collapse pulls inwards as ``l^-8``."""
    return (G > 0.0) & (alpha < 0.0)


def linear_elastic(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G_lin: Scalar
) -> tuple[Scalar, ...]:
    """The small-strain limit, ``S = -(4/3) G (1 - 1/l^3)`` (Estrada et al. 2018, section 2.2)."""
    inverse = rest_radius / radius
    cubed = inverse * inverse * inverse
    return -4.0 / 3.0 * G_lin * (1.0 - cubed), -4.0 * G_lin * cubed * velocity / radius, 0.0


# nodes and weights of Gauss-Legendre in ``u`` of ``1 - (1 - u)^2``: dense at 1, where exponentials
# vary most
_RULE = tuple((1.0 - (1.0 - u) ** 2, 2.0 * w * (1.0 - u)) for u, w in unit_rule(32))
STIFFEST_EXPONENT = 300.0
"""Exponent of the Fung law beyond which no bubble could tell a stiffer gel."""


def _find_invariant(stretch: Scalar) -> Scalar:
    """``I_1 - 3`` at a hoop stretch."""
    square = stretch * stretch
    return 1.0 / (square * square) + 2.0 * square - 3.0


def _find_density(stretch: Scalar, excess: Scalar) -> Scalar:
    """``dS/d ln b`` per modulus at a hoop stretch, of an ``excess`` ``f(I_1 - 3) - 1`` over the
    neo-Hookean modulus.
    """
    inverse = 1.0 / stretch
    square = inverse * inverse
    return -2.0 * (inverse + square * square) * excess


def _second_order_density(stretch: Scalar, alpha: Scalar) -> Scalar:
    scaled = alpha * _find_invariant(stretch)
    return _find_density(stretch, scaled * (1.0 + 0.5 * scaled))


def _exponential_density(stretch: Scalar, alpha: Scalar) -> Scalar:
    exponent = alpha * _find_invariant(stretch)
    return _find_density(
        stretch, expm1(where(real(exponent) > STIFFEST_EXPONENT, STIFFEST_EXPONENT, exponent))
    )


def second_order_fung(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G: Scalar, alpha_fung2: Scalar
) -> tuple[Scalar, ...]:
    """The exponential law to second order, beyond neo-Hookean: ``f = 1 + a x + a^2 x^2/2`` at ``x =
    I_1 - 3``.

    ``2 (b^-2 + b^-5) G (f - 1)`` is integrated over ``ln b`` by quadrature; the error is below
    1e-11 of the integral up to ``a x = 20`` and below 1e-6 up to 100.
    """
    stretch = radius / rest_radius
    span = log(stretch)
    mean = 0.0 * span
    for node, weight in _RULE:
        mean = mean + weight * _second_order_density(exp(node * span), alpha_fung2)
    return G * span * mean, G * _second_order_density(stretch, alpha_fung2) * velocity / radius, 0.0


def exponential_fung(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G: Scalar, alpha_fung: Scalar
) -> tuple[Scalar, ...]:
    """``W = G/(2 a) (exp(a (I_1 - 3)) - 1)`` (Fung 1967), beyond neo-Hookean: ``f = exp(a x)``;
    quadrature as above.
    """
    stretch = radius / rest_radius
    span = log(stretch)
    mean = 0.0 * span
    for node, weight in _RULE:
        mean = mean + weight * _exponential_density(exp(node * span), alpha_fung)
    return G * span * mean, G * _exponential_density(stretch, alpha_fung) * velocity / radius, 0.0


NEO_HOOKEAN = StressTerm(neo_hookean, switch="G", odd=())
STIFFENING = StressTerm(stiffening, switch="alpha", unbounded=_has_no_bound, odd=())
LINEAR_ELASTIC = StressTerm(linear_elastic, switch="G_lin", odd=())
SECOND_ORDER_FUNG = StressTerm(second_order_fung, switch="alpha_fung2", odd=())
EXPONENTIAL_FUNG = StressTerm(exponential_fung, switch="alpha_fung", odd=())
