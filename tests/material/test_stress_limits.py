"""Limits in which one model is another, and how fast they are reached."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from imr_torch.material import Stress, material
from tests.material.gels import STATES, evaluate

GEL = {"G": 0.08, "mu": 0.05}
ENTRIES = ("value", "rate", "acceleration")
EVERYWHERE = pytest.mark.parametrize(("radius", "velocity"), STATES)


def memory(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def assert_equal(one: Stress, other: Stress) -> None:
    assert [float(getattr(one, name)) for name in ENTRIES] == [
        float(getattr(other, name)) for name in ENTRIES
    ]


@EVERYWHERE
def test_that_a_carreau_gel_of_flow_index_one_is_newtonian_exactly(
    radius: float, velocity: float
) -> None:
    thick = evaluate(
        material("carreau"), radius, velocity, GEL | {"thinning": 0.0, "shear_time": 3.0}
    )
    assert_equal(thick, evaluate(material("nhkv"), radius, velocity, GEL))


def test_that_thinning_is_monotone_in_the_flow_index_and_in_the_shear_rate() -> None:
    """Mean viscosity ``-S R/(4 U)``: never more than ``mu``, falling with both."""

    def mean(thinning: float, velocity: float) -> float:
        stress = evaluate(
            material("carreau"), 0.5, velocity, {"mu": 1.0, "thinning": thinning, "shear_time": 0.4}
        )
        return -float(stress.value) * 0.5 / (4.0 * velocity)

    table = np.array(
        [[mean(s, u) for u in (0.01, 0.1, 1.0, 10.0, 100.0)] for s in (0.0, 0.2, 0.5, 0.8, 1.0)]
    )
    assert np.all(np.abs(table[0] - 1.0) < 1e-15)
    assert np.all(np.diff(table[1:], axis=1) < 0.0)
    assert np.all(np.diff(table, axis=0) < 0.0)
    assert np.all(table > 0.0)


def test_that_a_fully_thinned_gel_has_the_closed_form_of_a_viscosity_as_the_inverse_of_shear() -> (
    None
):
    """``n = 0``: ``int_0^1 (1 + (g x)^2)^(-1/2) dx = asinh(g)/g``."""
    velocity = -3.0
    radius = 0.4
    time = 0.7
    g = 2.0 * math.sqrt(3.0) * time * abs(velocity) / radius
    stress = evaluate(
        material("carreau"), radius, velocity, {"mu": 0.05, "thinning": 1.0, "shear_time": time}
    )
    expected = -4.0 * 0.05 * velocity / radius * math.asinh(g) / g
    assert float(stress.value) == pytest.approx(expected, rel=1e-12)


@EVERYWHERE
@pytest.mark.parametrize(
    ("key", "name"), [("gen_qkv", "alpha"), ("fung2", "alpha_fung2"), ("fungexp", "alpha_fung")]
)
def test_that_a_stiffening_gel_without_stiffening_is_neo_hookean(
    key: str, name: str, radius: float, velocity: float
) -> None:
    assert_equal(
        evaluate(material(key), radius, velocity, GEL | {name: 0.0}),
        evaluate(material("nhkv"), radius, velocity, GEL),
    )


def stiffening(key: str, name: str, alpha: float, radius: float) -> float:
    return float(evaluate(material(key), radius, 0.0, {"G": 1.0, name: alpha}).value)


@pytest.mark.parametrize("radius", [0.15, 0.6, 0.9])
def test_that_the_three_stiffening_laws_part_by_one_order_of_alpha_each(radius: float) -> None:
    """qKV is Fung to first order, second-order Fung to second: differences are of the second and
    third power of alpha.
    """
    alphas = np.array([1e-3, 2e-3, 4e-3])
    fung = np.array([stiffening("fungexp", "alpha_fung", a, radius) for a in alphas])
    second = np.array([stiffening("fung2", "alpha_fung2", a, radius) for a in alphas])
    first = np.array([stiffening("gen_qkv", "alpha", a, radius) for a in alphas])
    for difference, order in ((fung - first, 2.0), (fung - second, 3.0)):
        assert np.log2(difference[1:] / difference[:-1]) == pytest.approx(order, abs=0.1)


def test_that_a_linear_gel_is_the_small_strain_limit_of_the_neo_hookean() -> None:
    strain = 1e-5
    rest = 0.23 * (1.0 + strain)
    linear, neo = (
        float(evaluate(material(k), rest, 0.0, {n: 1.0}).value)
        for k, n in (("linkv", "G_lin"), ("nhe", "G"))
    )
    assert linear == pytest.approx(neo, rel=5.0 * strain)
    assert linear == pytest.approx(-4.0 * strain, rel=5.0 * strain)


@EVERYWHERE
def test_that_full_retardation_is_newtonian(radius: float, velocity: float) -> None:
    """The branch takes nothing off and, from its relaxed start, has nothing to add."""
    for key, name, rows, plain in (("zener", "tau", 1, "nhkv"), ("ucm", "tau_ucm", 2, "newtonian")):
        gel = GEL | {name: 0.4, "retardation": 1.0}
        relaxed = evaluate(material(key), radius, velocity, gel, memory(*[0.0] * rows))
        assert_equal(relaxed, evaluate(material(plain), radius, velocity, GEL))


@EVERYWHERE
def test_that_no_relaxation_time_is_no_memory(radius: float, velocity: float) -> None:
    for key, name in (("zener", "tau"), ("sns", "tau_sns")):
        assert_equal(
            evaluate(material(key), radius, velocity, GEL | {name: 0.0}, memory(7.0)),
            evaluate(material("nhkv"), radius, velocity, GEL),
        )
