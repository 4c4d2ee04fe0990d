"""A medium of each bubble's own: the bubble of other surroundings, seen in the units of the present
ones.
"""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from imr_torch.material import LIBRARY
from imr_torch.observe import predict  # noqa: F401 - the effects of the camera
from imr_torch.simulate import (
    Accuracy,
    Conditions,
    Gilmore,
    KellerMiksis,
    PolytropicSimulator,
    Resolution,
    TransportSimulator,
)
from imr_torch.simulate.setting import OF_MEDIUM
from imr_torch.units import Surroundings
from tests.simulate.bubble import FINE, gel, grid, largest_difference, sine, tensor

ASSUMED = Surroundings()
DESIGN = tensor(300.0, 0.22)
TIMES = grid(2.2, 45)
BASE = {"G": 4e3, "mu": 0.08, "tau": 4e-6}
FACTORS = {
    "density": 1.1,
    "sound_speed": 1.2,
    "surface_tension": 1.4,
    "far_field_pressure": 1.03,
    "temperature": 301.15 / 298.15,
}
SIMULATORS = {
    "polytropic": PolytropicSimulator(stepping=FINE),
    "tensors": PolytropicSimulator(stepping=FINE, engine="torchdiffeq"),
    "transport": TransportSimulator(accuracy=Accuracy(1e-5, Resolution(8, 8))),
}


def radii(kind: str, field: str, **conditions) -> tuple[Tensor, Tensor, Tensor]:
    """R* without a change, by the parameter, and by surroundings at the same Rmax, R_inf and seconds."""
    there = replace(ASSUMED, **{field: FACTORS[field] * getattr(ASSUMED, field)})
    size = ASSUMED.max_radius(DESIGN[0])
    design = torch.stack((there.weber(size), DESIGN[1]))
    times = TIMES * (ASSUMED.time_scale(size) / there.time_scale(size))
    here, moved = (
        replace(SIMULATORS[kind], conditions=Conditions(s, **conditions))
        for s in (ASSUMED, there)
    )
    by_parameter = here(
        gel(**BASE, **{OF_MEDIUM[field]: math.log(FACTORS[field])}), DESIGN, TIMES
    ).radius
    return (
        here(gel(**BASE), DESIGN, TIMES).radius,
        by_parameter,
        moved(gel(**BASE), design, times).radius,
    )


@pytest.mark.parametrize(
    ("kind", "field"),
    [
        ("tensors", "density"),
        *(
            (kind, name)
            for kind in ("polytropic", "transport")
            for name in FACTORS
            if name != "temperature"
        ),
    ],
)
def test_that_the_parameter_is_the_medium_itself_to_solver_error(kind, field):
    before, ours, there = radii(kind, field)
    assert largest_difference(ours, there) < 2e-6
    assert largest_difference(ours, before) > 2e-3


@pytest.mark.parametrize(
    "motion", [KellerMiksis(), Gilmore()], ids=lambda motion: motion.key
)
def test_that_density_is_exact_in_every_radial_equation_and_under_driving(motion):
    """A driving is in Pa and seconds, so it must reach a bubble that moves at another pace at the same moments."""
    before, ours, there = radii(
        "polytropic", "density", motion=motion, driving=sine(2e4, 3e4, 0.3)
    )
    assert largest_difference(ours, there) < 2e-6
    assert largest_difference(ours, before) > 0.05


def test_that_a_temperature_is_exact_for_polytropic_gas_and_nearly_so_with_transport():
    for kind, share in (("polytropic", 1e-9), ("transport", 0.08)):
        before, ours, there = radii(kind, "temperature")
        effect = largest_difference(there, before)
        assert effect > 0.01
        assert largest_difference(ours, there) < share * effect


def test_that_contents_at_rest_follow_the_medium_and_not_the_effect_of_the_same_name():
    by_medium = SIMULATORS["polytropic"](
        gel(**BASE, medium_tension=0.5), DESIGN, TIMES
    ).radius
    by_effect = SIMULATORS["polytropic"](
        gel(**BASE, surface_tension=0.5), DESIGN, TIMES
    ).radius
    assert largest_difference(by_medium, by_effect) > 1e-3


def test_that_density_is_a_cause_beside_the_clock_and_the_others_are_none():
    assert LIBRARY["density"].family == LIBRARY["clock"].family
    assert not {"medium_tension", "medium_pressure", "medium_temperature"} & set(LIBRARY)
