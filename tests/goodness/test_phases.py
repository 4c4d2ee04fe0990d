"""Phases of a bubble's motion; and those in which the noise law says too much: they count as the
residuals leave room for, and cancel no misfit elsewhere.
"""

import math

import pytest
import torch

from imr_torch.float64 import linspace, ones, randn
from imr_torch.goodness.phases import (
    PHASES,
    noise_shares,
    phase_clock,
    phase_name,
    phase_numbers,
)
from imr_torch.random import generator


def test_that_the_phase_clock_reads_one_at_the_first_collapse_and_two_at_the_second():
    times = linspace(0.0, 5.0, 501)[None]
    curve = (
        torch.cos(0.5 * math.pi * times)
    ).abs()  # collapses at 1, 3 and 5, tops at 2 and 4
    clock = phase_clock(times, curve, torch.ones_like(times, dtype=torch.bool))[0]
    expected = torch.where(times[0] <= 1.0, times[0], 0.5 * (times[0] + 1.0))
    assert torch.allclose(clock, expected, atol=1e-9)
    assert [phase_name(c) for c in (0.2, 0.9, 1.5, 2.0, 2.5)] == list(PHASES)


def test_that_the_phase_clock_runs_on_where_a_record_ends_before_any_collapse():
    times = linspace(0.0, 0.5, 11)[None]
    clock = phase_clock(times, 1.0 - times, torch.ones_like(times, dtype=torch.bool))
    assert torch.isfinite(clock).all()
    assert phase_name(float(clock[0, -1])) == "first collapse"


def test_that_phase_numbers_are_those_of_the_names():
    times = linspace(0.0, 6.0, 301)[None]
    curve = 0.4 + 0.6 * torch.cos(2.9 * times).abs() * torch.exp(-0.5 * times)
    mask = torch.ones_like(times, dtype=torch.bool)
    numbers = phase_numbers(times, curve, mask)[0]
    assert sorted(set(numbers.tolist())) == list(range(len(PHASES)))
    assert (numbers.diff() >= 0).all()
    assert phase_name(0.0) == PHASES[int(numbers[0])]


def test_that_the_law_counts_whole_where_it_is_right():
    source = generator(0)
    phase = torch.arange(200) // 40
    lost = sum(
        bool(
            (
                noise_shares([torch.randn(200, generator=source).double().square()], phase)
                < 1.0
            ).any()
        )
        for _ in range(300)
    )
    assert lost <= 6  # 1500 phases at a chance of .001 each: 1.5 expected


def test_that_a_phase_quieter_than_the_law_counts_as_it_is():
    phase = torch.arange(200) // 40
    scale = ones(200)
    scale[160:] = 0.2
    square = (scale * randn(200, generator=generator(1))).square()
    # the hypothesis that leaves least decides
    shares = noise_shares([square, 2.0 * square], phase)
    assert shares[:160].tolist() == [1.0] * 160
    assert shares[160:].tolist() == pytest.approx([0.04] * 40, rel=0.5)
    none = torch.where(phase == 4, -1, phase)
    assert noise_shares([square], none).tolist() == [1.0] * 200  # frames that do not count
