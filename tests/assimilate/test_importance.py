"""Importance sampling against closed forms: densities, tails of known shape, moments and evidence
of a Gaussian.
"""

import math

import pytest
import torch
from scipy import special
from torch import Tensor

from imr_torch.assimilate.importance import (
    ImportanceSample,
    are_reliable,
    effective_size,
    smooth_tail,
)
from imr_torch.assimilate.proposals import Kernels
from imr_torch.float64 import arange, eye, linspace, rand, randn, zeros
from imr_torch.random import generator
from tests.curved import assert_posterior, mean_error, sd_error
from tests.linear import tensor

CHOL = tensor([0.5, 0.0], [0.3, 0.2])
MEAN = tensor(1.0, -2.0)


def test_that_kernels_on_a_single_heavy_point_still_have_a_shape_and_reach_out():
    points = randn(200, 2, generator=generator(4))
    log_weights = zeros(200)
    log_weights[7] = 500.0
    proposal = Kernels.through_draws(points, log_weights)
    assert effective_size(proposal.weights[:-1]) == pytest.approx(30.0, rel=0.01)
    assert proposal.chol.diagonal().min() > 1.0


@pytest.mark.parametrize("shape", [0.2, 0.5, 0.8, 1.2])
def test_that_the_shape_of_a_pareto_tail_is_found(shape):
    """Generalised Pareto weights; 40 000 of them leave an error of some (1 + k)/sqrt(600)."""
    weights = 1.0 + (rand(40_000, generator=generator(5)).pow(-shape) - 1.0) / shape
    error = (1.0 + shape) / math.sqrt(600.0)
    assert smooth_tail(weights.log())[1] == pytest.approx(shape, abs=3.0 * error)


@pytest.mark.parametrize("count", [1, 24])
def test_that_too_few_weights_are_never_reliable(count):
    log_weights = torch.cat((torch.zeros(count), torch.full((100,), -math.inf))).double()
    assert smooth_tail(log_weights)[1] == math.inf


def test_that_weights_a_thousand_nats_apart_are_judged_without_underflow():
    log_weights = -linspace(0.0, 1e5, 500)
    smoothed, shape = smooth_tail(log_weights)
    assert not torch.isnan(smoothed).any()
    assert shape > 1.0


@pytest.mark.parametrize(
    ("shape", "effective", "samples", "verdict"),
    [
        (0.3, 26.0, 256, True),
        (0.3, 25.0, 256, False),
        (0.3, 19.0, 100, False),
        (0.3, 20.0, 100, True),
        (0.6, 200.0, 256, False),
        (0.6, 900.0, 1000, True),
        (math.inf, 900.0, 1000, False),
    ],
)
def test_that_reliable_weights_have_a_light_tail_and_a_tenth_of_them_counts(
    shape, effective, samples, verdict
):
    assert are_reliable(shape, effective, samples) == verdict


def sample_of(
    draws: Tensor,
    prior: Tensor,
    likelihood: Tensor,
    proposal: Tensor,
    about: tuple[Tensor, Tensor] | None = None,
) -> ImportanceSample:
    """Weighted draws of one experiment without nuisances, by log densities; ``about`` a Gaussian."""
    count, size = draws.shape
    mean, chol = about or (zeros(size), eye(size))
    still = zeros(count, 1, 3)
    return ImportanceSample(
        draws, prior, likelihood, proposal, still, mean, chol, first_shape=0.0, rounds=1
    )


def gaussian_sample(scale: float, seed: int, count: int = 1000) -> ImportanceSample:
    """A posterior ``N((1, -2), C C^T)`` times ``e^-7``, with the proposal ``scale`` times as wide."""
    proposal = Kernels.about_mean(MEAN, scale * CHOL)
    controls = proposal.draw_points(count, generator(seed))
    target = (
        torch.distributions.MultivariateNormal(MEAN, scale_tril=CHOL).log_prob(controls)
        - 7.0
    )
    prior = -0.5 * controls.square().sum(1) - math.log(2.0 * math.pi)
    likelihood = (target - prior)[:, None]
    return sample_of(
        controls, prior, likelihood, proposal.log_prob(controls), (MEAN, scale * CHOL)
    )


def test_that_moments_and_evidence_of_a_gaussian_come_out_within_their_errors():
    sample = gaussian_sample(1.0, 0)
    assert sample.reliable
    assert sample.failed == 0
    assert_posterior(sample, MEAN, CHOL @ CHOL.mT, -7.0)
    assert mean_error(sample).max() < 0.03


def test_that_draws_correct_the_gaussian_about_the_mode_of_a_skewed_posterior():
    """The logarithm of a gamma variable of shape 8: mode ln 8, curvature 8, mean and variance by
    di- and trigamma functions.
    """
    shape = 8.0
    mode = torch.log(tensor(shape))
    chol = tensor([shape**-0.5])
    mean = special.digamma(shape)
    sd = special.polygamma(1, shape) ** 0.5
    found = []
    weighted = []
    for seed in range(200):
        proposal = Kernels.about_mean(mode, chol)
        draws = proposal.draw_points(256, generator(seed))
        target = shape * draws - draws.exp()
        sample = sample_of(
            draws, 0.0 * target[:, 0], target, proposal.log_prob(draws), (zeros(1), chol)
        )
        centre, scale = sample.correct_gaussian(mode, chol)
        found.append((float(centre), float(scale)))
        weighted.append((float(sample.mean), float(sample.covariance.sqrt())))
    moments = tensor(*found)
    plain = tensor(*weighted)
    assert abs(mode - mean) > 0.15 * sd  # what is to be corrected
    torch.testing.assert_close(moments.mean(0), tensor(mean, sd), rtol=0.0, atol=0.01 * sd)
    assert (moments.std(0) < 0.8 * plain.std(0)).all()


def test_that_errors_of_moments_are_the_scatter_over_seeds():
    """That of the evidence: tests/select/test_evidence.py."""
    samples = [gaussian_sample(1.0, seed, 200) for seed in range(150)]
    for value, error in (
        (
            torch.stack([s.mean[0] for s in samples]),
            torch.stack([mean_error(s)[0] for s in samples]),
        ),
        (
            torch.stack([s.covariance[1, 1].sqrt() for s in samples]),
            torch.stack([sd_error(s)[1] for s in samples]),
        ),
    ):
        assert value.std() == pytest.approx(float(error.square().mean().sqrt()), rel=0.25)


def test_that_resampling_takes_each_draw_in_proportion_to_its_weight():
    sample = gaussian_sample(1.5, 2)
    chosen = sample.resample_draws(5000, generator(0))
    counts = torch.bincount(chosen, minlength=len(sample))
    assert ((counts - 5000 * sample.weights).abs() <= 1.0 + 1e-9).all()
    assert not torch.equal(chosen, chosen.sort().values)


@pytest.mark.parametrize(("variance", "size"), [(0.2, 1), (0.1, 1), (0.3, 3), (0.2, 3)])
def test_that_the_error_of_an_evidence_whose_draws_are_not_reliable_covers_it(
    variance, size
):
    """Proposals narrower than the posterior: log evidence 0, mostly missed from below, which the
    spread of weights hides.
    """
    count = 256
    within = []
    plain = []
    for seed in range(60):
        source = generator(seed)
        draws = math.sqrt(variance) * randn(count, size, generator=source)
        log_target = -0.5 * (draws.square() + math.log(2.0 * math.pi)).sum(1)
        log_proposal = -0.5 * (
            draws.square() / variance + math.log(2.0 * math.pi * variance)
        ).sum(1)
        sample = sample_of(draws, log_target, zeros(count, 1), log_proposal)
        spread = float(count * sample.weights.std() / math.sqrt(count))
        if sample.reliable:
            assert sample.log_evidence_error == spread
            continue
        within.append(abs(sample.log_evidence) < 2.0 * sample.log_evidence_error)
        plain.append(abs(sample.log_evidence) < 2.0 * spread)
    assert len(within) > 25
    assert sum(within) > 0.95 * len(within)
    assert sum(plain) < 0.8 * len(plain)


@pytest.mark.parametrize(
    ("datum", "noise", "hangs_on"),
    [(0.5, 0.2, (False, True)), (4.0, 1.0, (True, True)), (1.0, 50.0, (True, False))],
    ids=["informed", "in conflict", "uninformed"],
)
def test_that_power_sensitivities_are_those_of_a_conjugate_posterior(
    datum, noise, hangs_on
):
    """Prior N(0, 1) to the power a, likelihood N(datum, noise^2) to the power b: precision ``a + b/s^2``,
    mean ``b y/s^2`` over it; derivatives in ln a and ln b at 1 are written out.
    """
    inverse = noise**-2
    precision = 1.0 + inverse
    mean = datum * inverse / precision
    sd = precision**-0.5
    levels = (arange(4000) + 0.5) / 4000
    controls = (mean + sd * torch.special.ndtri(levels))[:, None]
    prior = torch.distributions.Normal(0.0, 1.0).log_prob(controls[:, 0])
    likelihood = torch.distributions.Normal(datum, noise).log_prob(controls)
    exact = torch.distributions.Normal(mean, sd).log_prob(controls[:, 0])
    sample = sample_of(controls, prior, likelihood, exact)
    by_prior = max(mean / precision / sd, 0.5 / precision)
    by_data = max(datum * inverse / precision**2 / sd, 0.5 * inverse / precision)
    found = sample.power_sensitivities[:, 0].tolist()
    expected = [math.log(2.0) * by_prior, math.log(2.0) * by_data]
    assert found == pytest.approx(expected, rel=2e-2)
    assert tuple(x >= 0.3 for x in found) == hangs_on
