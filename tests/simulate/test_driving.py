"""Far-field driving: its derivatives, its table, and what it does to a bubble."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from imr_torch.float64 import linspace
from imr_torch.simulate import (
    RADIAL_EQUATIONS,
    Accuracy,
    Conditions,
    GasMixture,
    Medium,
    PolytropicGas,
    PolytropicSimulator,
    Resolution,
    TabulatedDriving,
    TransportSimulator,
)
from imr_torch.units import Surroundings
from tests.refusals import refusals
from tests.simulate.bubble import (
    FINE,
    MOTIONS,
    assert_that_rates_are_derivatives,
    gel,
    grid,
    largest_difference,
    sampled,
    sine,
    tensor,
)
from tests.simulate.si_reference import Reference
from tests.tables import for_each

PERIOD = 4e-5
SINE = sine(6e4, 1.0 / PERIOD, 0.4)


TABLE = TabulatedDriving((0.0, 1e-5, 3e-5, 6e-5), (0.0, 2e4, -5e4, 1e4))
EVERY = {"sine": SINE, "table": TABLE}


@for_each("driving", EVERY)
def test_that_both_derivatives_are_those_of_the_pressure(driving):
    """By autograd, so that gradients through a solve that knows only the pressure are right too."""
    time = linspace(1e-7, 5.9e-5, 97, requires_grad=True)
    assert_that_rates_are_derivatives(driving(time), time, (1e-6, 1e-1))


def test_that_a_table_is_met_at_its_samples_and_held_beyond_them():
    driving = TABLE
    knots = torch.tensor(driving.times, dtype=torch.float64)
    assert driving(knots)[0].tolist() == pytest.approx(driving.pressures, abs=1e-9)
    value, rate, bend = driving(tensor(-1e-5, -1.0, 6.1e-5, 1.0).reshape(2, 2))
    assert value.tolist() == [[0.0, 0.0], [pytest.approx(1e4)] * 2]
    assert rate.abs().sum() + bend.abs().sum() == 0.0
    # the spline joins the constants without a kink
    near = driving(tensor(1e-12, 6e-5 - 1e-12))[1]
    assert near.abs().max() < 1e-5 * 1e9


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda x: f"{x.key}-{x.liquid.key}")
def test_that_a_driven_bubble_is_scipys_in_every_radial_equation(motion):
    times = grid(1.6, 33)
    conditions = Conditions(motion=motion, driving=SINE)
    driven = Reference(conditions, mu=0.02)
    expected = driven.solve(300.0, 0.25, times.numpy(), rtol=1e-9)[0]
    solution = PolytropicSimulator(conditions, FINE)(
        gel(mu=0.02), tensor(300.0, 0.25), times
    )
    assert_close(solution.radius, torch.tensor(expected), rtol=0.0, atol=2e-6)


def isothermal(**options) -> Conditions:
    """Gas that conducts so well that it is polytropic with exponent 1, in both simulators."""
    mixture = GasMixture(
        conductivity_slope=5.3e2, conductivity_offset=1.17e5, vapour="absent"
    )
    return Conditions(
        gas=PolytropicGas(1.0, vapour=False),
        mixture=mixture,
        medium=Medium(warm=False),
        **options,
    )


@pytest.mark.parametrize("key", RADIAL_EQUATIONS)
def test_that_both_simulators_are_driven_alike(key):
    conditions = isothermal(
        motion=RADIAL_EQUATIONS[key], driving=SINE, initial_velocity=-1.5
    )
    arguments = gel(G=4e3, mu=0.1), tensor(300.0, 0.5), grid(1.5, 16)
    polytropic = PolytropicSimulator(conditions, FINE)(*arguments)
    transport = TransportSimulator(conditions, Accuracy(3e-5, Resolution(8, 4)))(*arguments)
    assert transport.ok
    assert transport.velocity[0] == pytest.approx(-1.5 / Surroundings().velocity_scale)
    assert largest_difference(transport.radius, polytropic.radius) < 3e-4


PULSED = {
    "linkv": {"G_lin": 1e3},
    "nhkv": {"G": 1e3},
    "gen_qkv": {"G": 1e3, "alpha": 0.25},
    "zener": {"G": 1e3, "tau": 1e-7},
}
PULSED |= {"ucm": {"tau_ucm": 1e-7, "retardation": 0.1}}


@pytest.mark.parametrize("key", RADIAL_EQUATIONS)
def test_that_a_bubble_returns_to_rest_after_a_slow_pulse_of_tension(key):
    """A bubble of 10 um at rest in a very viscous gel, a tension of almost one atmosphere for .1 ms: 2000 units of time,
    which only the implicit solver strides over.
    """
    pulse = sampled(lambda t: -1e5 * np.exp(-(((t - 3e-4) / 1e-4) ** 2)), 2.1e-3)
    gels = torch.stack([gel(mu=0.5, **values) for values in PULSED.values()])
    outer = Surroundings(101325.0, 1064.0, 0.07, 298.15, 1484.0)
    times = linspace(0.0, 2e-3, 101) / outer.time_scale(10e-6)
    mixture = GasMixture(vapour="frozen")
    conditions = Conditions(
        outer,
        PolytropicGas(1.4, "rest"),
        mixture,
        Medium(warm=False),
        RADIAL_EQUATIONS[key],
        driving=pulse,
    )
    simulator = TransportSimulator(conditions, Accuracy(3e-4, Resolution(6, 4)))
    radius = simulator(gels, tensor(outer.weber(10e-6), 1.0 - 1e-9), times).radius
    assert (radius[:, -1] - 1.0).abs().max() < 1e-2
    assert (radius.amax(1) > 1.02).all()  # it did swell


test_that_bad_options_are_named = refusals(
    (
        lambda: TabulatedDriving((0.0, 1.0), (0.0, 1.0)),
        r"2 times and 2 pressures; expected as many of each, at least three",
    ),
    (
        lambda: TabulatedDriving((0.0, 1.0, 1.0), (0.0, 1.0, 2.0)),
        r"times must increase; sort them and drop repeated ones",
    ),
    (
        lambda: Conditions(motion="gilmore"),
        r"Conditions.motion is 'gilmore'; expected a RadialEquation",
    ),
)
