"""Stress integrals without memory against quadrature of what they stand for.

A spherical bubble in an incompressible medium carries the point at ``r0`` to ``r`` with ``r^3 - R^3
= r0^3 - R_inf^3``, so the hoop stretch is ``l = r/r0`` and ``I_1 = 2 l^2 + l^-4``. A strain energy
``W(I_1)`` gives ``tau_rr - tau_tt = 2 W' (l^-4 - l^2)``; a viscosity ``mu`` adds ``-6 mu R^2
U/r^3`` at the shear rate ``2 sqrt(3) R^2 |U|/r^3``.
"""

import math
from collections.abc import Callable

import pytest
from scipy.integrate import quad

from imr_torch.material import MATERIALS, material
from tests.material.gels import REST, STATES, evaluate, has_memory, values_of
from tests.tables import for_each

Values = dict[str, float]
Law = Callable[[float, Values], float]

WITHOUT_MEMORY = {key: model for key, model in MATERIALS.items() if not has_memory(model)}


def modulus(excess: float, v: Values) -> float:
    """``2 dW/dI_1`` at ``I_1 - 3``: neo-Hookean, times what stiffens it."""
    quadratic = v.get("alpha", 0.0) * excess
    second = v.get("alpha_fung2", 0.0) * excess
    exponential = math.expm1(v.get("alpha_fung", 0.0) * excess)
    return v.get("G", 0.0) * (1.0 + quadratic + second + 0.5 * second**2 + exponential)


def viscosity(shear: float, v: Values) -> float:
    """Carreau (1972), Newtonian without thinning."""
    return v.get("mu", 0.0) * (1.0 + (v.get("shear_time", 0.0) * shear) ** 2) ** (
        -0.5 * v.get("thinning", 0.0)
    )


def quadrature(
    radius: float,
    velocity: float,
    values: Values,
    *,
    stiffness: Law = modulus,
    viscosity: Law = viscosity,
) -> float:
    """``2 int_R^inf (tau_rr - tau_tt)/r dr`` by adaptive quadrature over ``s = R/r``."""

    def integrand(s: float) -> float:
        squared = (1.0 - s**3 * (1.0 - (REST / radius) ** 3)) ** (-2.0 / 3.0)  # l^2
        excess = 2.0 * squared + squared**-2 - 3.0
        elastic = stiffness(excess, values) * (squared**-2 - squared)
        shear = 2.0 * math.sqrt(3.0) * abs(velocity) / radius * s**3
        # 2 G (e_rr - e_tt)
        small = -2.0 * values.get("G_lin", 0.0) * s**3 * (1.0 - (REST / radius) ** 3)
        return (
            2.0
            * (elastic + small - 6.0 * viscosity(shear, values) * velocity * s**3 / radius)
            / s
        )

    return quad(integrand, 0.0, 1.0, epsabs=1e-13, epsrel=1e-12, limit=400)[0]


@for_each("model", WITHOUT_MEMORY)
@pytest.mark.parametrize(("radius", "velocity"), STATES)
def test_that_the_stress_integral_is_the_quadrature_over_the_gel(model, radius, velocity):
    values = values_of(model)
    expected = quadrature(radius, velocity, values)
    assert evaluate(model, radius, velocity, values).value == pytest.approx(
        expected, rel=1e-9, abs=1e-10
    )


@pytest.mark.parametrize("half", [0.5, 1.0])
def test_that_qkv_is_half_the_square_of_the_first_invariant(half):
    """``177/20 + ...`` follows from ``W = G/2 [(I_1-3) + alpha/2 (I_1-3)^2]`` and not from the form without the 1/2."""

    def stiffness(excess: float, v: Values) -> float:
        return v["G"] * (1.0 + 2.0 * half * v["alpha"] * excess)

    values = values_of(material("qkv"))
    expected = quadrature(0.9, 0.0, values, stiffness=stiffness)
    agrees = float(evaluate(material("qkv"), 0.9, 0.0, values).value) == pytest.approx(
        expected, rel=1e-6
    )
    assert agrees == (half == 0.5)


@pytest.mark.parametrize(
    ("stretch", "alpha", "tolerance"), [(0.15, 0.01, 1e-10), (8.0, 0.3, 1e-8)]
)
def test_that_exponential_stiffening_is_integrated_where_it_is_extreme(
    stretch, alpha, tolerance
):
    """Exponents up to 20 and 40: what lies near the wall decides."""
    values = {"G": 1.0, "alpha_fung": alpha}
    expected = quadrature(stretch * REST, 0.0, values)
    assert evaluate(
        material("fungexp"), stretch * REST, 0.0, values
    ).value == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize("thinning", [0.05, 0.5, 1.0])
@pytest.mark.parametrize("reduced", [1e-3, 1.0, 30.0, 1e4])
def test_that_thinning_is_integrated_over_five_decades_of_shear_rate(thinning, reduced):
    values = {
        "mu": 1.0,
        "thinning": thinning,
        "shear_time": reduced / (2.0 * math.sqrt(3.0)),
    }
    expected = quadrature(1.0, 1.0, values)
    assert evaluate(material("carreau"), 1.0, 1.0, values).value == pytest.approx(
        expected, abs=1e-11
    )
