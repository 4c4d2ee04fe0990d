"""The truths of effects that the library does not hold, before any fit sees them."""

import pytest
import torch

from benchmarks.gap import closures
from imr_torch.float64 import linspace, tensor
from imr_torch.material import PARAMETERS, TERMS
from imr_torch.material.memory import maxwell
from imr_torch.units import Surroundings

RADIUS, VELOCITY, REST = tensor([0.4, -1.3, 0.2])


def test_that_a_fit_knows_nothing_of_them():
    assert not {"surface", "darcy", "loss", "fast_time"} & set(PARAMETERS.names)
    assert not {"surface_viscosity", "two_times"} & {term.name for term in TERMS}


def test_that_an_interface_resists_by_four_times_its_viscosity_and_velocity_over_the_radius_squared():
    outer = Surroundings()
    size = outer.max_radius(tensor(400.0))
    speed = size / outer.time_scale(size)
    given = closures.parameters_of("surface_viscosity", 3.0, 400.0)
    stress = closures.surface_viscosity(RADIUS, VELOCITY, REST, given["surface"])[0]
    expected = -4.0 * 3e-6 * (VELOCITY * speed) / (RADIUS * size) ** 2
    assert outer.far_field_pressure * stress == pytest.approx(float(expected))


def test_that_two_times_that_are_one_are_one():
    """The library's fluid of Maxwell, each arm holding half of its stress."""
    one = maxwell(
        RADIUS, VELOCITY, REST, tensor(0.7), tensor(0.1), tensor(0.3), tensor(0.0)
    )
    half = tensor(0.35)
    two = closures.two_times(
        RADIUS, VELOCITY, REST, half, half, tensor(0.1), tensor(0.3), tensor(0.3)
    )
    assert torch.allclose(torch.stack(two[:3]), torch.stack(one[:3]))
    assert two[3] + two[4] == pytest.approx(float(one[3]))


@pytest.mark.parametrize(
    ("law", "memory", "given"),
    [
        (closures.surface_viscosity, (), (0.02,)),
        (closures.opening_darcy, (1.1,), (0.3,)),
        (closures.growing_loss, (1.7,), (0.3,)),
        (closures.two_times, (0.2, -0.1), (0.1, 0.05, 0.3)),
    ],
)
def test_that_its_rate_is_that_of_its_stress(law, memory, given):
    """Central differences along a motion of constant acceleration."""
    step = 1e-5
    force = 2.0
    memory = tensor(memory)
    given = [tensor(x) for x in given]
    _, rate, inertia, *changes = law(RADIUS, VELOCITY, REST, *memory, *given)
    ends = []
    for t in (-step, step):
        moved = memory + t * tensor(changes)
        radius = RADIUS + VELOCITY * t + 0.5 * force * t * t
        ends.append(law(radius, VELOCITY + force * t, REST, *moved, *given)[0])
    slope = (ends[1] - ends[0]) / (2.0 * step)
    assert rate + force * inertia == pytest.approx(float(slope), rel=1e-6)


def test_that_a_dropped_frame_shifts_those_after_it_by_one():
    dense = linspace(0.0, 1.0, 821)
    whole = closures.film_dense("none", 0.0, dense, 400.0, 10)
    spoilt = closures.film_dense("dropped_frame", 7.0, dense, 400.0, 10)
    assert torch.equal(spoilt[:-7], whole[:-7])
    assert torch.equal(spoilt[-7:-1], whole[-6:])
    assert spoilt[-1] == dense[810]


def test_that_an_edge_drifts_from_none_to_its_strength():
    dense = torch.ones(821).double()
    drift = closures.film_dense("drifting_edge", 2.0, dense, 400.0, 10) - 1.0
    size = float(Surroundings().max_radius(tensor(400.0)))
    assert drift[0] == 0.0
    assert drift[40] * size == pytest.approx(1e-6)
    assert drift[80] * size == pytest.approx(2e-6)


def test_that_what_is_no_sphere_is_one_until_it_has_collapsed():
    dense = (linspace(0.0, 4.0, 821) - 0.9).abs() + 0.1
    seen = closures.film_dense("no_sphere", 1.0, dense, 400.0, 10) / dense[:801:10]
    first = int(dense[:801:10].argmin())
    assert torch.equal(seen[: first + 1], torch.ones(first + 1).double())
    assert seen[-1] == pytest.approx(1.03, abs=1e-6)
