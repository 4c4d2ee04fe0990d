"""Every law that both engines use: on tensors it gives the numbers that it gives compiled, and the same derivatives.

Laws are taken from their registries, so that a new one is tested by itself. Stress terms are in
``tests/material``.
"""

import re

import pytest
import torch

from imr_torch.elementary import obstacle_of
from imr_torch.float64 import linspace, tensor
from imr_torch.material import LIBRARY
from tests.simulate.bubble import assert_that_rates_are_derivatives

# ---------------------------------------------------------------- effects


@pytest.mark.parametrize(
    "name", [e.name for e in LIBRARY.values() if e.far_field is not None]
)
def test_that_both_rates_of_a_far_field_are_those_of_its_pressure(name):
    effect = LIBRARY[name]
    time = linspace(0.0, 3.0, 61, requires_grad=True)
    for start in effect.starts:
        pressure = effect.far_field(time, *tensor(start))
        assert_that_rates_are_derivatives(pressure, time, (1e-13, 1e-12))


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
def test_that_what_a_law_may_not_use_is_named(law, message):
    assert re.search(message, obstacle_of(law) or "")
