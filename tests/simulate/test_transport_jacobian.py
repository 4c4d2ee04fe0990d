"""The Jacobian and the step built on it."""

from dataclasses import replace

import pytest
import torch

from imr_torch.float64 import eye, full, rand, tensor
from imr_torch.material import PARAMETERS
from imr_torch.random import generator
from imr_torch.simulate import (
    PRESETS,
    RADIAL_EQUATIONS,
    Conditions,
    Resolution,
)
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.linearise import linearise_equations
from imr_torch.simulate.rhs import HEAD, Equations
from imr_torch.simulate.rosenbrock import rosenbrock_step
from tests.simulate.bubble import CLOSURES, sine
from tests.tables import for_each


def gels(**columns):
    """Three gels, from three values of each parameter."""
    return PARAMETERS.pack({name: tensor(values) for name, values in columns.items()})


PLAIN = {
    "G": (2770.0, 8310.0, 1000.0),
    "mu": (0.186, 0.09, 0.02),
    "alpha": (0.48, 0.0, 1.0),
}
PARAMETER_ROWS = gels(**PLAIN)
DESIGNS = tensor([[550.0, 0.22], [900.0, 0.14], [120.0, 0.3]])
REMEMBERING = {
    "Zener": {"tau": (2e-5, 0.0, 1e-6), "retardation": (0.2, 0.0, 0.5)},
    "upper-convected": {"tau_ucm": (2e-5, 3e-6, 1e-6), "retardation": (0.2, 0.0, 0.5)},
    "Giesekus": {
        "tau_giesekus": (2e-5, 0.0, 1e-6),
        "mobility": (0.2, 0.0, 0.5),
        "retardation": (0.2, 0.0, 0.5),
    },
    "standard solids": {
        "G_lin": (1e3, 0.0, 2e3),
        "tau_sls": (2e-5, 0.0, 1e-6),
        "tau_sns": (0.0, 1e-5, 0.0),
    },
}
ACTING = {
    "mirrored": {"wall": (0.2, -0.1, 0.0)},
    "leaking": {"gas_loss": (0.3, 0.0, 1.0)},
    "trapping": {"condensation": (0.5, 0.0, 0.1)},
    "losing energy": {"energy_loss": (1.0, 0.0, 0.3)},
    "in other surroundings": {
        "sound_speed": (0.3, 0.0, -1.0),
        "compressibility": (0.5, 0.0, 1.0),
        "heat_exchange": (0.5, 0.0, -0.5),
        "vapour_pressure": (0.05, 0.0, 0.01),
    },
    "in a sound field": {
        "sound_field": (0.3, 0.0, 0.1),
        "sound_frequency": (1.0, 0.0, 2.0),
        "pulse": (0.5, 0.0, -0.4),
    },
}


def rough_state(equations, vapour=True):
    """A state with fields of every kind, far from the start."""
    random = generator(3)
    n = equations.n
    m = equations.m
    y = equations.inside.nodes[:, None]

    def noise(rows):
        return rand(rows, 3, generator=random)

    state = equations.start()
    state[0], state[1] = torch.tensor([0.5, 0.2, 1.2]), torch.tensor([-3.0, 6.0, 0.5])
    state[0, 1] = 0.1  # below rest
    state[2] += torch.log(torch.tensor([5.0, 40.0, 2.0]))
    state[3] = torch.tensor([0.1, 0.3, 0.05])
    state[HEAD : HEAD + n] = state[3] + 2.0 * (1.0 - y**2) + 0.1 * noise(n)
    state[HEAD + n : HEAD + 2 * n] = (0.3 + 0.3 * noise(n)) * float(vapour)
    state[HEAD + 2 * n : HEAD + 2 * n + m] = 0.1 * noise(m)
    state[HEAD + 2 * n + m :] = 0.2 * noise(equations.memory)
    return state


def dense_jacobians(equations, state, time):
    """The Jacobian of each member, side by side, by forward differentiation: a batch of its copies,
    each moved along one axis.
    """
    count, members = state.shape
    place = torch.arange(members).repeat_interleave(count)
    copies = equations.take(place)

    def rate(states):
        return copies.rate(copies.fields(states, time[place]))

    axes = eye(count).repeat(1, members)
    return torch.func.jvp(rate, (state[:, place].clone(),), (axes,))[1].split(count, 1)


def assert_jacobian_is_automatic(equations, vapour=True):
    """At a rough state, relative to each row."""
    state = rough_state(equations, vapour)
    time = tensor([0.3, 0.7, 1.1])
    jacobian, _ = linearise_equations(equations, equations.fields(state, time))
    for i, dense in enumerate(dense_jacobians(equations, state, time)):
        size = dense.abs().amax(1, keepdim=True).clamp_min(1e-10)
        assert ((jacobian[:, :, i] - dense) / size).abs().max() < 1e-10


@pytest.mark.parametrize(
    "resolution", [Resolution(4, 6), Resolution(5, 5)], ids=["unequal", "equal"]
)
@for_each("conditions", CLOSURES)
def test_the_jacobian_is_that_of_automatic_differentiation(conditions, resolution):
    equations = Equations(
        Bubbles.of(PARAMETER_ROWS, DESIGNS, conditions), *resolution.grids()
    )
    assert_jacobian_is_automatic(equations, conditions.mixture.vapour == "transported")


def few_equations(columns, conditions) -> Equations:
    return Equations(
        Bubbles.of(gels(**columns), DESIGNS, conditions), *Resolution(4, 4).grids()
    )


@for_each("motion", RADIAL_EQUATIONS)
@for_each("columns", REMEMBERING)
def test_so_it_does_with_every_gel_in_every_radial_equation(columns, motion):
    conditions = Conditions(motion=motion, driving=sine(5e4, 2e4))
    assert_jacobian_is_automatic(few_equations(PLAIN | columns, conditions))


@pytest.mark.parametrize("key", ["published", "authors_code"])
@for_each("columns", ACTING)
def test_so_it_does_with_every_effect(columns, key):
    for motion in (RADIAL_EQUATIONS["keller_miksis"], RADIAL_EQUATIONS["gilmore"]):
        conditions = replace(PRESETS[key], motion=motion)
        assert_jacobian_is_automatic(few_equations(PLAIN | columns, conditions))


@for_each("motion", RADIAL_EQUATIONS)
def test_the_slope_in_time_is_that_of_the_acceleration(motion):
    """By automatic differentiation, with driving, a sound field and a pulse at once."""
    columns = PLAIN | ACTING["in a sound field"]
    conditions = Conditions(motion=motion, driving=sine(5e4, 2e4))
    equations = few_equations(columns, conditions)
    state = rough_state(equations)
    time = tensor([0.3, 0.7, 1.1])
    _, slope = linearise_equations(equations, equations.fields(state, time))

    def acceleration(time):
        return equations.rate(equations.fields(state, time))[1]

    expected = torch.func.jvp(acceleration, (time,), (torch.ones_like(time),))[1]
    torch.testing.assert_close(slope, expected, rtol=1e-12, atol=1e-12)


ORDERS = {
    "free": (PLAIN, Conditions()),
    "driven": (PLAIN, Conditions(driving=sine(5e4, 2e4))),
    "Zener": (PLAIN | REMEMBERING["Zener"], Conditions()),
    "upper-convected, driven, Gilmore": (
        PLAIN | REMEMBERING["upper-convected"],
        Conditions(motion=RADIAL_EQUATIONS["gilmore"], driving=sine(5e4, 2e4)),
    ),
}


@for_each(("columns", "conditions"), ORDERS)
def test_steps_are_of_fourth_order(columns, conditions):
    equations = Equations(
        Bubbles.of(gels(**columns), DESIGNS, conditions), *Resolution(8, 8).grids()
    )

    def radius(steps):
        state = equations.start()
        step = full((3,), 0.6 / steps)
        for i in range(steps):
            state = rosenbrock_step(equations, state, step, i * step)[0]
        return state[:2]

    exact = radius(80)  # its error is a sixteenth of that of half as many steps
    coarse, fine = ((radius(n) - exact).abs().amax(0) for n in (20, 40))
    assert (torch.log2(coarse / fine) > 3.5).all()
