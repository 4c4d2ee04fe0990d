"""Statistics of replicates against closed forms, and both ways: silent on calibrated numbers, loud
on others.
"""

import math

import pytest
import torch
from scipy import stats

from imr_torch.calibration import coverage, envelope, uniformity
from imr_torch.float64 import arange, rand, tensor
from imr_torch.random import generator
from tests.refusals import refusals


def grid(n):
    """Numbers more uniform than any draw."""
    return [(i + 0.5) / n for i in range(n)]


def uniform(n, seed=0):
    return rand(n, generator=generator(seed))


def test_that_a_uniform_grid_passes_and_its_bins_are_equal():
    result = uniformity(grid(200))
    assert result.counts == (10,) * 20
    assert result.chi_square_p == pytest.approx(1.0)
    assert result.spread == pytest.approx(1.0, abs=0.02)
    assert result.p > 0.9


def test_that_p_values_are_uniform_for_uniform_numbers():
    tests = [uniformity(uniform(100, seed).tolist()) for seed in range(200)]
    assert stats.kstest([t.kolmogorov_p for t in tests], "uniform").pvalue > 0.01
    assert stats.kstest([t.spread_p for t in tests], "uniform").pvalue > 0.01
    assert 0.01 < sum(t.chi_square_p < 0.1 for t in tests) / 200 < 0.2


@pytest.mark.parametrize(
    "bend",
    [
        lambda u: torch.special.ndtr(0.5 * torch.special.ndtri(u)),  # intervals too wide
        lambda u: torch.special.ndtr(2.0 * torch.special.ndtri(u)),  # too narrow
        lambda u: torch.special.ndtr(torch.special.ndtri(u) + 0.5),  # biased
    ],
    ids=["wide", "narrow", "biased"],
)
def test_that_a_wrong_posterior_is_found(bend):
    assert uniformity(bend(uniform(200)).tolist()).p < 1e-3


def test_that_the_spread_is_that_of_the_normal_scores():
    narrow = torch.special.ndtr(1.3 * torch.special.ndtri(tensor(grid(300))))
    assert uniformity(narrow.tolist()).spread == pytest.approx(1.3, rel=0.02)


def test_that_the_envelope_holds_uniform_numbers_as_often_as_it_says():
    rows = uniform(400 * 80).reshape(400, 80).sort(dim=1).values
    steps = arange(81) / 80
    distance = torch.maximum((steps[1:] - rows).amax(1), (rows - steps[:-1]).amax(1))
    inside = (distance < envelope(80)).tolist()
    assert stats.binomtest(sum(inside), 400, 0.95).pvalue > 0.01


def test_that_coverage_counts_central_intervals_with_clopper_and_pearson_s_limits():
    result = coverage([0.02, 0.3, 0.5, 0.7, 0.9, 0.97], 0.9)
    assert result.share == pytest.approx(4 / 6)
    assert result.low == pytest.approx(stats.beta.ppf(0.025, 4, 3))
    assert result.high == pytest.approx(stats.beta.ppf(0.975, 5, 2))
    assert result.fits


def test_that_missing_coverage_is_seen():
    assert coverage(grid(400), 0.9).fits
    narrow = torch.special.ndtr(2.0 * torch.special.ndtri(torch.tensor(grid(400)))).tolist()
    result = coverage(narrow, 0.9)
    assert result.share == pytest.approx(
        2.0 * stats.norm.cdf(stats.norm.ppf(0.95) / 2.0) - 1.0, abs=5e-3
    )
    assert not result.fits


test_that_bad_input_is_named = refusals(
    (
        lambda: uniformity([0.1, 1.2] * 20),
        "uniformity: expected at least one number, all within",
    ),
    (lambda: uniformity([math.nan] * 20), "uniformity: expected at least one number"),
    (lambda: uniformity([0.5] * 9), "9 values are too few for 2 bins; 10 are needed"),
    (lambda: coverage([], 0.9), "coverage: expected at least one number"),
)
