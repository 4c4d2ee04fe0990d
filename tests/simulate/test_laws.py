"""Every law that both engines use: on tensors it gives the numbers that it gives compiled, and the same derivatives.

Laws are taken from their registries, so that a new one is tested by itself. Stress terms are in
``tests/material``.
"""

import re

import pytest
import torch

from imr_torch.elementary import obstacle_of
from imr_torch.material import LIBRARY, PARAMETERS, Effect
from imr_torch.simulate import (
    RADIAL_EQUATIONS,
    PolytropicGas,
    RadialEquation,
    TabulatedDriving,
)
from imr_torch.simulate.conditions import compression_of
from imr_torch.simulate.driving import evaluate_spline
from imr_torch.simulate.radial import drive_wall
from tests.laws import assert_alike

STATES = (
    # radius, velocity, pressure, rate, inertia, far, far_rate, slowness, image, beyond
    (1.0, 0.0, 0.01, 0.0, 0.0, 1.0, 0.0, 0.00684, 0.0, 0.0),
    (0.6, -2.0, 0.3, 1.5, -0.02, 1.4, -3.0, 0.00684, -0.2, 0.3),
    (0.04, -170.0, 3000.0, 4e5, -1.3, 0.2, 20.0, 0.00684, 0.3, 1.0),
    (0.5, 3.0, -40.0, 60.0, -0.3, 6.0, 1.0, 0.05, 0.05, 0.1),
)


@pytest.mark.parametrize("motion", RADIAL_EQUATIONS.values(), ids=RADIAL_EQUATIONS)
@pytest.mark.parametrize("state", STATES, ids=["maximum", "falling", "collapse", "tension"])
def test_that_a_radial_equation_is_its_compiled_self(
    motion: RadialEquation, state: tuple[float, ...]
) -> None:
    near, away = (
        motion.liquid.at(torch.tensor(p, dtype=torch.float64), state[7])
        for p in (state[2], state[5])
    )
    driven = [float(x) for x in drive_wall(state, near, away)]
    found = assert_alike(type(motion).law, [*driven, *motion.form, *motion.constants], range(5))
    assert float(found) == float(
        motion.acceleration(*(torch.tensor(x, dtype=torch.float64) for x in state))
    )
    assert float(found) != 0.0


# ---------------------------------------------------------------- effects

MOVING = {
    "gas_loss": [
        (1.0, 0.0, 0.3),
        (0.31, -2.0, 0.3),
        (0.1, -7.0, 0.3),
        (0.06, 0.0, 0.3),
        (0.2, 5.0, 0.3),
    ],
    "vapour": [(1.0,), (3e-3,), (40.0,), (5e3,)],
    "far_field": [(0.0,), (0.7,), (2.9,)],
}
"""What the laws of effects take before the effect's parameters; all but the rest radius moves."""
LAWS = [
    (kind, effect)
    for kind in MOVING
    for effect in LIBRARY.values()
    if getattr(effect, kind) is not None
]


def amplitudes(effect: Effect) -> list[tuple[float, ...]]:
    """Parameters of an effect where it acts: its starts, and an amplitude halfway to its upper
    bound.
    """
    halfway = tuple(
        0.5 * (PARAMETERS[name].neutral + PARAMETERS[name].upper) for name in effect.names[:1]
    )
    return [*effect.starts, halfway + effect.starts[0][1:]]


@pytest.mark.parametrize(
    ("kind", "effect"), LAWS, ids=[f"{kind} of {effect.name}" for kind, effect in LAWS]
)
def test_that_the_law_of_an_effect_is_its_compiled_self(kind: str, effect: Effect) -> None:
    assert effect.compilable
    law = getattr(effect, kind)
    values = []
    for before in MOVING[kind]:
        for parameters in amplitudes(effect):
            found = assert_alike(law, [*before, *parameters], range(min(len(before), 2)))
            off = assert_alike(law, [*before, 0.0, *parameters[1:]], range(min(len(before), 2)))
            assert float((off - (1.0 if kind == "vapour" else 0.0)).abs().max()) == 0.0
            values.append(found - off)
    assert bool((torch.stack(values).abs().amax(0) > 0.0).all())


def test_that_laws_of_every_kind_are_tested() -> None:
    assert {kind for kind, _ in LAWS} == set(MOVING)
    acting = {
        e.name
        for e in LIBRARY.values()
        if e.gas_loss is not None or e.vapour is not None or e.far_field is not None
    }
    assert {effect.name for _, effect in LAWS} == acting


@pytest.mark.parametrize("name", [e.name for e in LIBRARY.values() if e.far_field is not None])
def test_that_both_rates_of_a_far_field_are_those_of_its_pressure(name: str) -> None:
    effect = LIBRARY[name]
    time = torch.linspace(0.0, 3.0, 61, dtype=torch.float64, requires_grad=True)
    assert effect.far_field is not None
    for start in effect.starts:
        value, rate, bend = effect.far_field(time, *torch.tensor(start, dtype=torch.float64))
        (by_value,) = torch.autograd.grad(value.sum(), time, retain_graph=True)
        (by_rate,) = torch.autograd.grad(rate.sum(), time)
        torch.testing.assert_close(rate.detach(), by_value, rtol=1e-12, atol=1e-13)
        torch.testing.assert_close(bend.detach(), by_rate, rtol=1e-12, atol=1e-12)


# ---------------------------------------------------------------- gas and driving


@pytest.mark.parametrize("radius", [1.0, 0.3, 0.02])
def test_that_polytropic_gas_is_its_compiled_self(radius: float) -> None:
    compression = assert_alike(compression_of, [radius, 1.3], [0, 1])
    assert float(compression) == pytest.approx(radius**-3.9, rel=1e-13)
    for velocity, left, lost, factor, trapped in (
        (-3.0, 1.0, 0.0, 1.0, 0.0),
        (2.0, 0.8, 0.3, 1.7, 0.2),
    ):
        arguments = [
            radius,
            velocity,
            left,
            lost,
            float(compression),
            factor,
            trapped,
            1e-2,
            1.3,
            0.03,
        ]
        assert_alike(PolytropicGas.law, arguments, range(10))


@pytest.mark.parametrize("lost", [0.0, 0.4])
@pytest.mark.parametrize("trapped", [0.0, 0.3])
def test_that_the_rate_of_polytropic_gas_is_that_of_its_pressure(
    trapped: float, lost: float
) -> None:
    """Along ``R(t)``, with gas that is lost and vapour whose saturation follows the compression."""
    exponent = 1.3
    velocity = -4.0

    def pressure(time: torch.Tensor) -> torch.Tensor:
        radius = 0.4 + velocity * time
        compression = compression_of(radius, exponent)
        left = 0.9 * torch.exp(-lost * time)
        return PolytropicGas.law(
            radius,
            velocity,
            left,
            lost,
            compression,
            compression**trapped,
            trapped,
            2e-2,
            exponent,
            0.03,
        )

    time = torch.tensor(0.0, dtype=torch.float64)
    value, slope = torch.func.jvp(lambda t: pressure(t)[0], (time,), (torch.ones_like(time),))
    assert float(pressure(time)[1]) == pytest.approx(float(slope), rel=1e-12)
    assert float(value) > 0.0


def test_that_a_table_is_its_compiled_self() -> None:
    """Before, at, between and after its samples."""
    driving = TabulatedDriving((0.0, 1e-5, 3e-5, 6e-5), (1e3, 2e4, -5e4, 1e4))
    values = []
    for time in (-1e-5, 0.0, 4e-6, 1e-5, 2.2e-5, 5.9e-5, 6e-5, 1e-3):
        values.append(assert_alike(evaluate_spline, [time, *driving.pieces], [0], slopes=False))
        given = torch.stack(driving(torch.tensor(time, dtype=torch.float64)))
        torch.testing.assert_close(values[-1], given, rtol=1e-15, atol=0.0)
    assert bool((torch.stack(values).abs().amax(0) > 0.0).all())


# ---------------------------------------------------------------- what cannot be compiled


def takes_the_size(x):
    return abs(x)


def uses_torch(x):
    return torch.tanh(x)


def asks_for_the_shape(x):
    return x.shape


def holds_a_function(x):
    return (lambda y: y)(x)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (takes_the_size, "takes_the_size uses 'abs', which has no compiled form"),
        (uses_torch, r"uses_torch uses 'torch' \(module\), which has no compiled form"),
        (asks_for_the_shape, "asks_for_the_shape uses .shape, which only tensors have"),
        (
            holds_a_function,
            "holds_a_function holds a function of its own; put it at the top of the module",
        ),
        (len, "is not a plain function at the top of a module"),
    ],
)
def test_that_what_a_law_may_not_use_is_named(law, message: str) -> None:
    assert re.search(message, obstacle_of(law) or "")
