"""The parameter vector: packing, bounds, units."""

import pytest
import torch
from torch.testing import assert_close

from imr_torch.float64 import full, tensor
from imr_torch.material import PARAMETERS, Parameter, dimensionless
from imr_torch.units import Surroundings
from tests.refusals import refusals, refused


def test_that_parameters_are_made_dimensionless_by_the_published_numbers():
    s = Surroundings()
    max_radius = tensor([2e-4, 5e-4])
    theta = dimensionless(
        PARAMETERS.pack({"G": 2770.0, "mu": 0.186, "alpha": 0.48, "tau": 3e-6}),
        max_radius,
        s,
    )
    speed = (101325.0 / 1060.0) ** 0.5
    assert_close(theta["G"].expand(2), full((2,), 2770.0 / 101325.0))
    assert_close(theta["mu"], 0.186 * speed / (101325.0 * max_radius))
    assert_close(theta["tau"], 3e-6 * speed / max_radius)
    assert theta["alpha"] == pytest.approx(0.48)


def test_that_units_convert_there_and_back():
    s = Surroundings(far_field_pressure=9e4, density=998.0, surface_tension=0.072)
    assert s.weber(2e-4) == pytest.approx(9e4 * 2e-4 / 0.144)
    assert s.max_radius(s.weber(2e-4)) == pytest.approx(2e-4, rel=1e-15)
    assert s.time_scale(2e-4) == pytest.approx(2e-4 * (998.0 / 9e4) ** 0.5)


@pytest.mark.parametrize("name", list(PARAMETERS.names))
def test_that_bounds_are_inclusive_and_what_lies_beyond_is_named(name):
    entry = PARAMETERS[name]
    for bound, beyond in (
        (entry.lower, entry.lower - 1.0),
        (entry.upper, entry.upper + 1.0),
    ):
        assert PARAMETERS.pack({name: bound})[PARAMETERS.index([name])[0]] == bound
        for bad in (beyond, float("nan")):
            with refused(rf"Parameter '{name}' is .*Parameters are given in SI units\."):
                PARAMETERS.pack({name: tensor([bound, bad])})


def test_that_packed_values_broadcast_and_the_rest_is_neutral():
    G = tensor([[1e3], [2e3]])
    mu = tensor([0.1, 0.2, 0.3])
    packed = PARAMETERS.pack({"G": G, "mu": mu})
    assert packed.shape == (2, 3, len(PARAMETERS))
    assert packed.dtype == torch.float64
    columns = PARAMETERS.index(["G", "mu"])
    assert torch.equal(packed[..., columns[0]], G.expand(2, 3))
    assert torch.equal(packed[..., columns[1]], mu.expand(2, 3))
    rest = [i for i in range(len(PARAMETERS)) if i not in columns]
    assert torch.equal(packed[..., rest], PARAMETERS.neutral(2, 3)[..., rest])
    assert torch.equal(PARAMETERS.pack({}), PARAMETERS.neutral())


def test_that_registering_the_same_parameter_twice_changes_nothing():
    before = PARAMETERS.names
    assert PARAMETERS.register(PARAMETERS["G"]) == PARAMETERS["G"]
    assert PARAMETERS.names == before


test_that_bad_input_is_named = refusals(
    (lambda: PARAMETERS["E"], r"Unknown parameter 'E'; known are G, mu, alpha"),
    (
        lambda: PARAMETERS.register(
            Parameter("G", "another", "Pa", "pressure", 0.0, 1.0, 0.0)
        ),
        r"Parameter 'G' is registered already with another definition",
    ),
    (
        lambda: Parameter("x", "x", "1", "none", 1.0, 2.0, 0.0),
        r"neutral value 0.0 lies outside its bounds \[1.0, 2.0\]",
    ),
    (
        lambda: Surroundings(density=-1.0),
        r"Surroundings.density is -1.0; expected a positive finite number",
    ),
    (lambda: Surroundings(temperature=float("nan")), r"Surroundings.temperature is nan"),
)
