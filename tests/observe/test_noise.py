"""The noise law: its formula, what it draws, and what a fit of it recovers."""

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from imr_torch.float64 import rand, zeros
from imr_torch.observe import NUISANCES, Noise, Nuisance, displaced
from imr_torch.random import generator
from tests.linear import correlation, tensor
from tests.refusals import refused
from tests.tables import for_each


def frames(count: int = 12, seed: int = 0) -> Tensor:
    return torch.cumsum(0.02 + 0.1 * rand(count, generator=generator(seed)), 0)


def curve(times: Tensor) -> Tensor:
    return 0.6 + 0.4 * torch.cos(3.0 * times)


LAWS = {
    "published": Noise(),
    "scaled": Noise(scale=2.5),
    "correlated": Noise(correlation_time=0.15),
    "flat, correlated": Noise(floor=0.03, slope=0.0, drift=0.0, correlation_time=0.4),
}
ALL = for_each("noise", LAWS)


def test_that_the_published_law_is_a_fiftieth_of_the_deflection_and_a_160th_of_the_time():
    """Chu, Estrada & Bryngelson (2024):

    ``|R* - 1|/50 + t*/160``, here with a floor of .002 in quadrature.
    """
    sd = Noise().sd(tensor(1.0, 0.2, 1.1), tensor(0.0, 1.6, 3.2))
    law = tensor(0.0, 0.8 / 50 + 0.01, 0.1 / 50 + 0.02)
    assert_close(sd, (law.square() + 0.002**2).sqrt(), rtol=1e-14, atol=0.0)


def test_that_errors_of_the_edge_and_of_times_are_added_in_quadrature():
    noise = Noise(scale=2.0, slope=0.0, drift=0.0, edge=0.001, jitter=0.1)
    sd = noise.sd(tensor(1.0, 0.1), tensor(0.0, 1.0), tensor(0.0, 0.3))
    expected = tensor(0.002**2 + 0.001**2, 0.002**2 + 0.01**2 + 0.03**2).sqrt()
    assert_close(sd, 2.0 * expected, rtol=1e-14, atol=0.0)


@ALL
def test_that_a_draw_has_the_stated_mean_and_covariance(noise):
    times = frames()
    n = 40000
    radius = curve(times)
    draws = noise.draw(radius, times, n, generator=generator(3))
    assert draws.shape == (n, 12)
    standard = (draws - radius) / noise.sd(radius, times)
    assert standard.mean(0).abs().max() < 4.5 / n**0.5
    empirical = standard.mT @ standard / n
    assert_close(
        empirical,
        correlation(times, noise.correlation_time),
        rtol=0.0,
        atol=4.5 * (2.0 / n) ** 0.5,
    )


@pytest.mark.parametrize("name", ["scale", "floor", "slope", "drift", "correlation_time"])
def test_that_parts_are_finite_and_scale_and_floor_positive(name):
    bad = [-1.0, math.nan, math.inf]
    least = ">= 0"
    if name in ("scale", "floor"):
        bad.append(0.0)
        least = "> 0"
    else:
        assert getattr(Noise(**{name: 0.0}), name) == 0.0
    for value in bad:
        with refused(rf"Noise.{name} is {value}; expected a finite number {least}"):
            Noise(**{name: value})


# ---------------------------------------------------------------- nuisances


@pytest.mark.parametrize(
    "shift", [(0.05, 0.0, 0.0), (0.0, 0.03, 0.0), (0.0, 0.0, -0.1), (-0.02, 0.04, 0.07)]
)
def test_that_shifts_are_what_they_are_in_metres_and_seconds(shift):
    """The laboratory measured Rmax, R_inf and a clock; the bubble had ``Rmax (1+a)``, ``R_inf
    (1+c)`` and a start ``b`` early.
    """
    top = 3e-4
    rest = 6e-5
    scale = 2.0 * 0.056 / 101325.0
    speed = 9.777
    measured_times = frames() * top / speed
    true_top = top * (1.0 + shift[0])
    true_rest = rest * (1.0 + shift[2])
    designs, times, factor = displaced(
        tensor(top / scale, rest / top), frames(), tensor(*shift)
    )
    assert_close(
        designs, tensor(true_top / scale, true_rest / true_top), rtol=1e-12, atol=0.0
    )
    expected = (measured_times + shift[1] * top / speed) * speed / true_top
    assert_close(times, expected, rtol=1e-12, atol=0.0)
    assert factor == pytest.approx(true_top / top)


def test_that_displacement_broadcasts_over_members_and_keeps_the_rest_radius_possible():
    designs = tensor([500.0, 0.9], [900.0, 0.3])
    times = frames()[None].repeat(2, 1)
    shifts = zeros(4, 2, 3)
    shifts[0, 0, 2], shifts[1, 0, 2] = 0.5, -2.0
    moved, clock, factor = displaced(designs, times, shifts)
    assert (moved.shape, clock.shape, factor.shape) == ((4, 2, 2), (4, 2, 12), (4, 2, 1))
    assert ((moved[..., 1] > 0.0) & (moved[..., 1] < 1.0)).all()
    assert torch.equal(moved[2:], designs.expand(2, 2, 2))


@pytest.mark.parametrize("name", NUISANCES)
@pytest.mark.parametrize("value", [-0.1, 1.0, math.nan, math.inf])
def test_that_an_impossible_nuisance_is_named(name, value):
    with refused(rf"Nuisance.{name} is {value}; expected a standard deviation in \[0, 1\)"):
        Nuisance(**{name: value})
