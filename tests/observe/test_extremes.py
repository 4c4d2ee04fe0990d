"""Collapse times of curves whose collapses are known."""

import math

import pytest
import torch
from torch import Tensor

from imr_torch.float64 import linspace, randn, tensor
from imr_torch.material import PARAMETERS
from imr_torch.observe import collapse_time
from imr_torch.random import generator
from imr_torch.simulate import PolytropicSimulator

PERIOD = 1.7
TIMES = linspace(0.0, 6.0, 601)


def ringing(damping: float = 0.0) -> Tensor:
    return 0.5 + 0.4 * torch.exp(-damping * TIMES) * torch.cos(
        2.0 * math.pi * TIMES / PERIOD
    )


@pytest.mark.parametrize("number", [1, 2, 3])
def test_that_collapses_of_a_cosine_are_half_periods(number):
    assert collapse_time(TIMES, ringing(), number) == pytest.approx(
        (number - 0.5) * PERIOD, abs=0.006
    )


def test_that_a_collapse_that_was_not_recorded_is_at_infinity():
    assert collapse_time(TIMES, ringing(), 5) == math.inf
    assert collapse_time(TIMES[:60], ringing()[:60], 1) == math.inf
    assert collapse_time(TIMES, torch.exp(-TIMES), 1) == math.inf


def test_that_a_minimum_counts_only_once_the_curve_has_climbed_from_it():
    """The record ends a tenth of its range above the minimum, or just before."""
    radius = ringing()
    climbed = int(torch.nonzero((TIMES > PERIOD / 2) & (radius > 0.1 + 0.08))[0])
    assert collapse_time(TIMES[: climbed - 1], radius[: climbed - 1], 1) == math.inf
    assert collapse_time(TIMES[: climbed + 2], radius[: climbed + 2], 1) == pytest.approx(
        PERIOD / 2, abs=0.006
    )


@pytest.mark.parametrize("seed", range(5))
def test_that_frame_noise_makes_no_collapse(seed):
    noisy = ringing() + 0.01 * randn(601, generator=generator(seed))
    for number in (1, 2, 3):
        assert collapse_time(TIMES, noisy, number) == pytest.approx(
            (number - 0.5) * PERIOD, abs=0.15
        )
    assert collapse_time(TIMES, noisy, 5) == math.inf


def test_that_collapses_of_a_simulated_bubble_are_where_its_wall_turns():
    gel = PARAMETERS.pack({"G": 5e3, "mu": 0.05})
    solution = PolytropicSimulator()(gel, tensor([800.0, 0.2]), TIMES)
    turns = torch.nonzero((solution.velocity[:-1] < 0.0) & (solution.velocity[1:] >= 0.0))[
        :, 0
    ]
    for number in (1, 2):
        found = collapse_time(TIMES, solution.radius, number)
        assert (
            TIMES[turns[number - 1]] - 1e-9 <= found <= TIMES[turns[number - 1] + 1] + 1e-9
        )
