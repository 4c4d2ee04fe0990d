"""Stress laws of elasticity: each the integral of a strain energy over the gel round the bubble.

With the hoop stretch ``b`` of the material at a distance, ``S = -2 int_1^l (b^-2 + b^-5) dW/dI_1 /
(G/2) db/Ca`` over ``b`` from 1 (far away) to ``l = R/R_inf`` (the wall), and ``I_1 = b^-4 + 2
b^2``.

Sources: Gaudron, Warnez & Johnsen (J. Fluid Mech. 766, 2015) for the neo-Hookean integral; Yang et
al. (Soft Matter 16, 2020) for the quadratic (qKV) law; Fung (Am. J. Physiol. 213, 1967) for the
exponential law, of which qKV is the first order; Mooney (J. Appl. Phys. 11, 1940), Rivlin (Phil.
Trans. R. Soc. A 241, 1948), Yeoh (Rubber Chem. Technol. 66, 1993), Gent (Rubber Chem. Technol. 69,
1996), Arruda & Boyce (J. Mech. Phys. Solids 41, 1993) with the inverse Langevin function of Kroeger
(J. Non-Newtonian Fluid Mech. 223, 2015), Ogden (Proc. R. Soc. A 326, 1972).
"""

from math import inf

from torch import Tensor

from imr_torch.elementary import Law, Scalar, Scalars, exp, expm1, log, real, where
from imr_torch.material.stress import StressTerm, unit_rule


def neo_hookean(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G: Scalar
) -> Scalars:
    """``S = -(5 - 4/l - 1/l^4) / (2 Ca)`` with ``l = R/R_inf`` (Gaudron et al. 2015, eq. 2.22)."""
    inverse = rest_radius / radius
    cubed = inverse * inverse * inverse
    value = -0.5 * G * (5.0 - inverse * (4.0 + cubed))
    slope = -2.0 * G * inverse * (1.0 + cubed)  # dS/d ln l
    return value, slope * velocity / radius, 0.0


def stiffening(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G: Scalar, alpha: Scalar
) -> Scalars:
    """The quadratic law of qKV, ``(alpha/Ca)(177/20 + 1/(4 l^8) + 2/(5 l^5) - 3/(2 l^4) + 2/l^2 -
    6/l - 4 l)``.

    Yang et al. (2020), eq. 13; ``alpha`` weighs the square of the first invariant ``I_1 - 3``.
    """
    x = rest_radius / radius
    x2 = x * x
    x3 = x2 * x
    stretch = 4.0 / x
    scale = alpha * G
    value = scale * (
        8.85 - stretch + x * (x3 * (x * (0.4 + 0.25 * x3) - 1.5) + 2.0 * x - 6.0)
    )
    # dS/d ln l
    slope = scale * (-2.0 * x * (x3 * (x + x2 * x2 - 3.0) + 2.0 * x - 3.0) - stretch)
    return value, slope * velocity / radius, 0.0


def _has_no_bound(G: Tensor, alpha: Tensor) -> Tensor:
    """At negative ``alpha`` the stress at collapse pulls inwards as ``l^-8``."""
    return (G > 0.0) & (alpha < 0.0)


def linear_elastic(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, G_lin: Scalar
) -> Scalars:
    """The small-strain limit, ``S = -(4/3) G (1 - 1/l^3)`` (Estrada et al. 2018, section 2.2)."""
    inverse = rest_radius / radius
    cubed = inverse * inverse * inverse
    return -4.0 / 3.0 * G_lin * (1.0 - cubed), -4.0 * G_lin * cubed * velocity / radius, 0.0


# dense at the wall, where stiffening laws vary most
_RULE = tuple((1.0 - u, w) for u, w in unit_rule(32, 3))
STIFFEST_EXPONENT = 300.0
"""Exponent of the Fung law beyond which no bubble could tell a stiffer gel."""


def _find_invariant(stretch: Scalar) -> Scalar:
    """``I_1 - 3`` at a hoop stretch."""
    square = stretch * stretch
    return 1.0 / (square * square) + 2.0 * square - 3.0


def _find_density(excess: Law, stretch: Scalar, *parameters: Scalar) -> Scalar:
    """``dS/d ln b`` per modulus at a hoop stretch, of an ``excess`` over the neo-Hookean modulus."""
    inverse = 1.0 / stretch
    square = inverse * inverse
    return -2.0 * (inverse + square * square) * excess(stretch, *parameters)


def integrate_over_gel(
    radius: Scalar,
    velocity: Scalar,
    rest_radius: Scalar,
    excess: Law,
    G: Scalar,
    *parameters: Scalar,
) -> Scalars:
    """What a strain energy adds to the neo-Hookean stress: ``-2 G int (b^-2 + b^-5) excess(b) db``.

    ``excess(stretch, *parameters)`` is ``f - 1``: for an energy of the first invariant ``f = 2
    W'(I_1)/G``, for any other ``f = dW/db / (2 G (b - b^-5))``. The quadrature's error is below
    1e-11 of the integral for exponentials up to ``e^20`` and for poles that the wall is within 1 % of.
    """
    stretch = radius / rest_radius
    span = log(stretch)
    mean = 0.0 * span
    for node, weight in _RULE:
        mean = mean + weight * _find_density(excess, exp(node * span), *parameters)
    slope = _find_density(excess, stretch, *parameters)
    return G * span * mean, G * slope * velocity / radius, 0.0


def second_order_fung(stretch: Scalar, alpha_fung2: Scalar) -> Scalar:
    """The exponential law to second order: ``f = 1 + a x + a^2 x^2/2`` at ``x = I_1 - 3``."""
    scaled = alpha_fung2 * _find_invariant(stretch)
    return scaled * (1.0 + 0.5 * scaled)


def exponential_fung(stretch: Scalar, alpha_fung: Scalar) -> Scalar:
    """``W = G/(2 a) (exp(a (I_1 - 3)) - 1)`` (Fung 1967): ``f = exp(a x)``."""
    exponent = alpha_fung * _find_invariant(stretch)
    return expm1(where(real(exponent) > STIFFEST_EXPONENT, STIFFEST_EXPONENT, exponent))


def mooney_rivlin(stretch: Scalar, mooney: Scalar) -> Scalar:
    """``W = G/2 ((1 - m) (I_1 - 3) + m (I_2 - 3))`` (Mooney 1940, Rivlin 1948): ``f = 1 + m (b^2 -
    1)``.
    """
    return mooney * (stretch * stretch - 1.0)


def cubic_stiffening(stretch: Scalar, cubic: Scalar) -> Scalar:
    """The cubic term of Yeoh (1993), ``G c/6 (I_1 - 3)^3``: ``f = 1 + c x^2``."""
    excess = _find_invariant(stretch)
    return cubic * excess * excess


def gent_elastic(stretch: Scalar, gent: Scalar) -> Scalar:
    """``W = -G J/2 ln(1 - (I_1 - 3)/J)`` (Gent 1996): ``f = 1/(1 - x/J)``.

    The parameter is ``1/J``. Where the chains lock, in tension or compression, the stress is
    infinite: a bubble that gets there fails with a status.
    """
    used = gent * _find_invariant(stretch)
    locked = real(used) >= 1.0
    return where(locked, inf, used / where(locked, 1.0, 1.0 - used))


def _langevin_modulus(used: Scalar) -> Scalar:
    """``L^-1(y)/(3 y)`` at ``used = y^2``, within 0.2 % (Kroeger 2015)."""
    return (1.0 - used * (6.0 + used * (1.0 - 2.0 * used)) / 15.0) / (1.0 - used)


def arruda_boyce(stretch: Scalar, chain: Scalar) -> Scalar:
    """Eight chains of ``N`` segments (Arruda & Boyce 1993): ``f`` is ``L^-1(y)/(3 y)`` at ``y^2 =
    I_1/(3 N)`` over its value at rest, so that ``G`` is the modulus at small strain.

    The parameter is ``1/N``; where the chains lock, as of :func:`gent_elastic`.
    """
    used = chain * (1.0 + _find_invariant(stretch) / 3.0)
    locked = real(used) >= 1.0
    stiffness = _langevin_modulus(where(locked, 0.0, used)) / _langevin_modulus(chain)
    return where(locked, inf, stiffness - 1.0)


def ogden_elastic(stretch: Scalar, ogden: Scalar) -> Scalar:
    """One term of Ogden (1972), ``W = 2 G/a^2 (l_1^a + l_2^a + l_3^a - 3)``; the parameter is ``a -
    2``.
    """
    exponent = 2.0 + ogden
    strain = log(stretch)
    still = real(strain) == 0.0
    spread = expm1(3.0 * where(still, 1.0, strain))
    # (b^a - b^-2a)/(a (b^3 - 1)), to first order of ln b where it is 0/0
    force = (
        exp(-2.0 * exponent * strain) * expm1(3.0 * exponent * strain) / (exponent * spread)
    )
    force = where(still, 1.0 - 0.5 * (exponent + 3.0) * strain, force)
    inverse = 1.0 / stretch
    return where(ogden == 0.0, 0.0, 2.0 * force / (inverse + inverse**4) - 1.0)


EXCESSES = {
    "alpha_fung2": second_order_fung,
    "alpha_fung": exponential_fung,
    "mooney": mooney_rivlin,
    "cubic": cubic_stiffening,
    "gent": gent_elastic,
    "chain": arruda_boyce,
    "ogden": ogden_elastic,
}
"""Parameter -> the modulus that its law has over the neo-Hookean one, as a function of the hoop stretch."""
NEO_HOOKEAN = StressTerm(neo_hookean, switch="G", odd=())
ELASTIC = (
    NEO_HOOKEAN,
    StressTerm(stiffening, switch="alpha", unbounded=_has_no_bound, odd=()),
    StressTerm(linear_elastic, switch="G_lin", odd=()),
    *(
        StressTerm(integrate_over_gel, switch, excess=excess, odd=())
        for switch, excess in EXCESSES.items()
    ),
)
"""The terms of these laws."""
