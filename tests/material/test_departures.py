"""Corrections to the elastic stress: each against the picture it is a closure of."""

import math

import pytest
import torch
from scipy.integrate import quad
from torch import Tensor

from imr_torch.float64 import linspace, tensor
from imr_torch.material import Stress, material
from imr_torch.material.departures import DEPARTURES
from tests.material.gels import (
    RELAXATION_TIMES,
    REST,
    evaluate,
    memory_rate,
    stress_of,
    stress_of_term,
    tensors,
)

DAMAGE, VISCOUS_DAMAGE, YIELD_STRESS, GRADED_MODULUS, PERMANENT_SET = DEPARTURES
GEL = {"G": 0.08, "alpha": 0.7}
RADII = pytest.mark.parametrize("radius", [0.06, 0.15, 0.229, 0.3, 0.9, 1.4])


def scalars(*values: float) -> list[Tensor]:
    return [tensor(x) for x in values]


def elastic(radius: float, velocity: float, rest: float = REST) -> Stress:
    return stress_of(material("qkv"), *scalars(radius, velocity, rest), tensors(GEL))


@RADII
def test_that_a_graded_gel_is_the_quadrature_of_its_modulus(radius):
    """``S = 2 int G(r0) (b^-4 - b^2)/r dr`` over the gel, with the hoop stretch ``b = r/r0``."""

    def integrand(s: float) -> float:
        cube = (radius / s) ** 3 - radius**3 + REST**3  # r0^3
        b = radius / s / cube ** (1.0 / 3.0)
        return 2.0 * 0.08 * 1.5 * REST**3 / cube * (b**-4 - b**2) / s

    expected = quad(integrand, 0.0, 1.0, epsabs=1e-14, epsrel=1e-12)[0]
    stress = stress_of_term(
        GRADED_MODULUS,
        *scalars(radius, 0.0, REST),
        tensors({"G": 0.08, "graded_modulus": 1.5}),
    )
    assert stress.value == pytest.approx(expected, rel=1e-9, abs=1e-13)


def test_that_a_graded_gel_passes_smoothly_through_its_rest():
    """Its weight is 0/0 there, which the closed form must not show."""
    edge = tensor([-1e-4, 0.0, 1e-4])
    stretch = torch.exp(edge[:, None] + 1e-9 * tensor([-1.0, 1.0]))
    stress = stress_of_term(
        GRADED_MODULUS,
        stretch,
        stretch,
        torch.ones_like(stretch),
        tensors({"G": 1.0, "graded_modulus": 1.0}),
    )
    jump = (stress.value[:, 1] - stress.value[:, 0]) / 2e-9
    assert (jump + 2.0).abs().max() < 1e-2  # dS/d ln l = -2 G g at rest
    assert (stress.rate[:, 1] - stress.rate[:, 0]).abs().max() < 1e-6
    assert (
        stress_of_term(
            GRADED_MODULUS,
            *scalars(1.0, 0.0, 1.0),
            tensors({"G": 1.0, "graded_modulus": 1.0}),
        ).value
    ) == 0.0


@pytest.mark.parametrize("lost", [0.0, 0.4, 1.0])
def test_that_damage_takes_its_share_of_the_elastic_stress(lost):
    whole = elastic(0.6, -1.2)
    held = tensor([lost])
    part = stress_of_term(
        DAMAGE, *scalars(0.6, -1.2, REST), tensors(GEL | {"damage": 0.3}), held
    )
    assert part.value + whole.value == pytest.approx(
        (1.0 - lost) * float(whole.value), rel=1e-13
    )


@pytest.mark.parametrize(
    ("healing", "velocity", "held", "expected"),
    [
        (0.0, -50.0, 0.0, 25.0),
        (0.0, 50.0, 0.0, 25.0),
        (0.0, 50.0, 0.5, 12.5),
        (0.0, 50.0, 1.0, 0.0),
        (0.0, 0.0, 0.2, 0.0),
        (2.0, 0.0, 0.5, -1.0),
        (2.0, 50.0, 25.0 / 27.0, 0.0),
        (2.0, 50.0, 0.0, 25.0),
    ],
)
def test_that_damage_grows_with_the_path_in_either_direction_to_all_or_heals_and_settles(
    healing, velocity, held, expected
):
    """``D = 1 - exp(-k int |dR/R|)``: at a speed far above the rounding, ``D' = k (1 - D) |U|/R``; and
    ``- D/t_h``, so that at a constant strain rate ``D`` stands still at ``k e/(k e + 1/t_h)``.
    """
    theta = tensors(GEL | {"damage": 0.3, "healing": healing})
    rate = memory_rate([DAMAGE], *scalars(0.6, velocity, REST), theta, tensor([held]))
    assert rate == pytest.approx(expected, rel=1e-3, abs=1e-3 if healing else 1e-12)
    assert DAMAGE.relaxation_rate(theta) == healing


@pytest.mark.parametrize("lost", [0.0, 0.4, 1.0])
def test_that_viscous_damage_takes_its_share_of_the_newtonian_stress_and_grows_with_the_path(
    lost,
):
    point = scalars(0.6, -50.0, REST)
    held = tensor([lost])
    whole = stress_of(material("newtonian"), *point, tensors({"mu": 0.05}))
    theta = tensors({"mu": 0.05, "viscous_damage": 0.3})
    part = stress_of_term(VISCOUS_DAMAGE, *point, theta, held)
    growth = float(memory_rate([VISCOUS_DAMAGE], *point, theta, held))
    assert growth == pytest.approx(0.3 * (1.0 - lost) * 50.0 / 0.6, rel=1e-3, abs=1e-12)
    assert part.value == pytest.approx(-lost * float(whole.value), rel=1e-13)
    assert part.acceleration == pytest.approx(-lost * float(whole.acceleration), rel=1e-13)
    assert part.rate == pytest.approx(
        -lost * float(whole.rate) - growth * float(whole.value), rel=1e-13
    )


@pytest.mark.parametrize("relaxing", RELAXATION_TIMES)
def test_that_viscous_damage_leaves_a_stress_that_relaxes_alone(relaxing):
    """The law of the branch has taken the Newtonian stress already."""
    theta = tensors({"mu": 0.05, "viscous_damage": 0.3, relaxing: 0.2})
    stress = stress_of_term(VISCOUS_DAMAGE, *scalars(0.6, -1.0, REST), theta, tensor([0.5]))
    assert stress.value == stress.rate == stress.acceleration == 0.0


@pytest.mark.parametrize("velocity", [-5.0, -0.5, 0.5, 5.0])
def test_that_a_yield_stress_opposes_motion_over_the_sheared_gel(velocity):
    """``2 int_R^r_y 2 tau_y/(2r) dr = 2 tau_y ln(r_y/R)`` with the shear rate at ``r_y`` a tenth, in units of ``|U|/R = .1``."""
    radius = 0.4
    stress = 0.02
    extent = math.log(abs(velocity) / radius / 0.1) / 3.0
    value = float(
        stress_of_term(
            YIELD_STRESS,
            *scalars(radius, velocity, REST),
            tensors({"yield_stress": stress}),
        ).value
    )
    assert value == pytest.approx(-math.copysign(2.0 * stress * extent, velocity), rel=0.02)


def test_that_a_yield_stress_vanishes_smoothly_at_a_turning_point():
    velocity = linspace(-1e-3, 1e-3, 5)
    theta = tensors({"yield_stress": 0.02})
    values = stress_of_term(
        YIELD_STRESS,
        torch.full_like(velocity, 0.4),
        velocity,
        torch.full_like(velocity, REST),
        theta,
    ).value
    assert values[2] == 0.0
    torch.testing.assert_close(values, -values.flip(0), rtol=1e-12, atol=0.0)
    assert values.abs().max() < 1e-6


@RADII
def test_that_a_set_gel_is_the_gel_referred_to_the_radius_it_was_stretched_to(radius):
    share = 0.1
    change = stress_of_term(
        PERMANENT_SET, *scalars(radius, -0.8, REST), tensors(GEL | {"permanent_set": share})
    )
    whole = elastic(radius, -0.8)
    moved = elastic(radius, -0.8, REST * (1.0 + share * (1.0 / REST - 1.0)))
    for name in ("value", "rate", "acceleration"):
        assert getattr(change, name) + getattr(whole, name) == pytest.approx(
            float(getattr(moved, name)), rel=1e-12, abs=1e-13
        )


def test_that_all_departures_leave_a_gel_without_modulus_alone():
    for name in ("damage", "graded_modulus", "permanent_set"):
        assert (
            evaluate(material(f"nhkv+{name}"), 0.5, -1.0, GEL | {name: 0.2}).value
            != elastic(0.5, -1.0).value
        )
        stress = evaluate(material(f"newtonian+{name}"), 0.5, -1.0, {"mu": 0.05, name: 0.2})
        assert (
            stress.value == evaluate(material("newtonian"), 0.5, -1.0, {"mu": 0.05}).value
        )
