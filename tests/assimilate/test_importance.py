"""Importance sampling against closed forms: densities, tails of known shape, moments and evidence
of a Gaussian.
"""

import math

import pytest
import torch
from scipy import special, stats

from imr_torch.assimilate.importance import (
    ImportanceSample,
    are_reliable,
    effective_size,
    largest_shape,
    smooth_tail,
)
from imr_torch.assimilate.proposals import Kernels, mixture_log_prob
from imr_torch.characterization.result import SENSITIVE
from imr_torch.random import generator
from tests.curved import mean_error, sd_error
from tests.linear import tensor

CHOL = tensor([0.5, 0.0], [0.3, 0.2])
MEAN = tensor(1.0, -2.0)


def test_that_one_kernel_is_a_student_t() -> None:
    points = torch.randn(50, 2, generator=generator(0), dtype=torch.float64)
    expected = stats.multivariate_t(MEAN.numpy(), (CHOL @ CHOL.mT).numpy(), df=7).logpdf(
        points.numpy()
    )
    torch.testing.assert_close(
        Kernels.about_mean(MEAN, CHOL).log_prob(points), torch.as_tensor(expected)
    )


def test_that_a_mixture_is_the_mean_of_its_kernels() -> None:
    points = torch.randn(50, 2, generator=generator(0), dtype=torch.float64)
    other = tensor(0.0, 1.0)
    both = Kernels(
        torch.stack((MEAN, other)), tensor(0.25, 0.75), torch.stack((CHOL, 2.0 * CHOL)), MEAN, CHOL
    )
    one = Kernels.about_mean(MEAN, CHOL)
    two = Kernels.about_mean(other, 2.0 * CHOL)
    expected = (0.25 * one.log_prob(points).exp() + 0.75 * two.log_prob(points).exp()).log()
    torch.testing.assert_close(both.log_prob(points), expected)
    torch.testing.assert_close(mixture_log_prob([one, two], [100, 300], points), expected)


def test_that_draws_have_the_moments_of_the_density() -> None:
    proposal = Kernels(
        tensor([0.0, 0.0], [4.0, 1.0]),
        tensor(0.5, 0.5),
        torch.stack((CHOL, 2.0 * CHOL)),
        MEAN,
        CHOL,
    )
    draws = proposal.draw_points(100_000, generator(1))
    inner = 2.5 * CHOL @ CHOL.mT * 7.0 / 5.0
    torch.testing.assert_close(draws.mean(0), tensor(2.0, 0.5), rtol=0.0, atol=0.03)
    torch.testing.assert_close(
        torch.cov(draws.mT), inner + tensor([4.0, 1.0], [1.0, 0.25]), rtol=0.02, atol=0.01
    )


def test_that_kernels_through_weighted_points_follow_the_weighted_density() -> None:
    """Uniform points weighted to a Gaussian: half are narrow kernels on them, half is one wide
    kernel.
    """
    points = 10.0 * torch.rand(4000, 2, generator=generator(2), dtype=torch.float64) - 5.0
    proposal = Kernels.through_draws(points, -0.5 * (points - tensor(1.0, 0.0)).square().sum(1))
    draws = proposal.draw_points(50_000, generator(3))
    narrow = float(proposal.chols[0, 0, 0] / proposal.chol[0, 0])
    variance = 0.5 * (1.0 + narrow**2 * 7.0 / 5.0) + 0.5 * 1.5**2 * 7.0 / 5.0
    assert narrow < 0.5
    torch.testing.assert_close(draws.mean(0), tensor(1.0, 0.0), rtol=0.0, atol=0.1)
    torch.testing.assert_close(
        torch.cov(draws.mT), variance * torch.eye(2, dtype=torch.float64), rtol=0.1, atol=0.1
    )


def test_that_kernels_on_a_single_heavy_point_still_have_a_shape_and_reach_out() -> None:
    points = torch.randn(200, 2, generator=generator(4), dtype=torch.float64)
    log_weights = torch.zeros(200, dtype=torch.float64)
    log_weights[7] = 500.0
    proposal = Kernels.through_draws(points, log_weights)
    assert float(effective_size(proposal.weights[:-1])) == pytest.approx(30.0, rel=0.01)
    assert float(proposal.chol.diagonal().min()) > 1.0


@pytest.mark.parametrize("shape", [0.2, 0.5, 0.8, 1.2])
def test_that_the_shape_of_a_pareto_tail_is_found(shape: float) -> None:
    """Generalised Pareto weights have tails of their own shape;

    40 000 of them leave an error of some (1 + k)/sqrt(600).
    """
    uniform = torch.rand(40_000, generator=generator(5), dtype=torch.float64)
    weights = 1.0 + (uniform.pow(-shape) - 1.0) / shape
    assert smooth_tail(weights.log())[1] == pytest.approx(
        shape, abs=3.0 * (1.0 + shape) / math.sqrt(600.0)
    )


def test_that_smoothing_keeps_scale_order_and_all_but_the_tail() -> None:
    log_weights = 30.0 + torch.randn(1000, generator=generator(6), dtype=torch.float64)
    smoothed, _ = smooth_tail(log_weights)
    assert torch.equal(smoothed.argsort(), log_weights.argsort())
    body = log_weights.argsort()[: 1000 - math.ceil(3.0 * math.sqrt(1000.0))]
    torch.testing.assert_close(smoothed[body], log_weights[body])
    assert float(smoothed.amax()) <= float(log_weights.amax()) + 1e-9
    assert not torch.equal(smoothed, log_weights)


def test_that_smoothing_halves_the_error_of_a_heavy_tailed_mean() -> None:
    """Weights with an infinite variance (k = .6) and the mean 1 + 1/(1 - .6): fewer wild estimates."""
    plain = []
    smoothed = []
    for seed in range(200):
        weights = (
            1.0
            + (torch.rand(500, generator=generator(seed), dtype=torch.float64).pow(-0.6) - 1.0)
            / 0.6
        )
        plain.append(float(weights.mean()) - 3.5)
        smoothed.append(float(smooth_tail(weights.log())[0].exp().mean()) - 3.5)
    assert tensor(*smoothed).square().mean().sqrt() < 0.75 * tensor(*plain).square().mean().sqrt()


def test_that_equal_weights_have_no_tail_and_impossible_ones_take_no_part() -> None:
    equal = torch.zeros(100, dtype=torch.float64)
    assert smooth_tail(equal)[1] == 0.0
    some = torch.randn(400, generator=generator(7), dtype=torch.float64)
    with_failed = torch.cat((some, torch.full((50,), -math.inf, dtype=torch.float64)))
    (alone, shape), (together, same) = smooth_tail(some), smooth_tail(with_failed)
    assert shape == same
    torch.testing.assert_close(together[:400], alone)
    assert bool(torch.isinf(together[400:]).all())


@pytest.mark.parametrize("count", [1, 24])
def test_that_too_few_weights_are_never_reliable(count: int) -> None:
    log_weights = torch.cat((torch.zeros(count), torch.full((100,), -math.inf))).double()
    assert smooth_tail(log_weights)[1] == math.inf


def test_that_weights_a_thousand_nats_apart_are_judged_without_underflow() -> None:
    log_weights = -torch.linspace(0.0, 1e5, 500, dtype=torch.float64)
    smoothed, shape = smooth_tail(log_weights)
    assert not bool(torch.isnan(smoothed).any())
    assert shape > 1.0


@pytest.mark.parametrize(
    ("count", "limit"), [(100, 0.5), (256, 0.5848), (1000, 2.0 / 3.0), (10_000, 0.7)]
)
def test_that_fewer_draws_allow_only_lighter_tails(count: int, limit: float) -> None:
    assert largest_shape(count) == pytest.approx(limit, abs=1e-4)


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
    shape: float, effective: float, samples: int, verdict: bool
) -> None:
    assert are_reliable(shape, effective, samples) == verdict


def gaussian_sample(scale: float, seed: int, count: int = 1000) -> ImportanceSample:
    """A posterior ``N((1, -2), C C^T)`` times ``e^-7``, with the proposal ``scale`` times as wide."""
    proposal = Kernels.about_mean(MEAN, scale * CHOL)
    controls = proposal.draw_points(count, generator(seed))
    target = torch.distributions.MultivariateNormal(MEAN, scale_tril=CHOL).log_prob(controls) - 7.0
    prior = -0.5 * controls.square().sum(1) - math.log(2.0 * math.pi)
    likelihood = (target - prior)[:, None]
    still = torch.zeros(count, 1, 3, dtype=torch.float64)
    return ImportanceSample(
        controls, prior, likelihood, proposal.log_prob(controls), still, MEAN, scale * CHOL, 0.0, 1
    )


def test_that_moments_and_evidence_of_a_gaussian_come_out_within_their_errors() -> None:
    sample = gaussian_sample(1.0, 0)
    assert sample.reliable
    assert sample.failed == 0
    assert sample.log_evidence == pytest.approx(-7.0, abs=4.0 * sample.log_evidence_error)
    assert bool(((sample.mean - MEAN).abs() < 4.0 * mean_error(sample)).all())
    sds = (CHOL @ CHOL.mT).diagonal().sqrt()
    assert bool(((sample.covariance.diagonal().sqrt() - sds).abs() < 4.0 * sd_error(sample)).all())
    assert float(mean_error(sample).max()) < 0.03


def test_that_moments_of_a_gaussian_are_left_as_they_are_by_the_draws() -> None:
    """To what Pareto smoothing changes of the weights: all other chance cancels, in 100 draws as in
    1000.
    """
    mean, chol = gaussian_sample(1.3, 0, 100).correct_gaussian(MEAN, CHOL)
    torch.testing.assert_close(mean, MEAN, rtol=0.0, atol=0.01)
    torch.testing.assert_close(chol, CHOL, rtol=0.0, atol=0.01)


def test_that_draws_correct_the_gaussian_about_the_mode_of_a_skewed_posterior() -> None:
    """The logarithm of a gamma variable of shape 8: mode ln 8, curvature 8, mean and variance by
    di- and trigamma functions.
    """
    shape = 8.0
    zero = torch.zeros(1, dtype=torch.float64)
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
        still = torch.zeros(256, 1, 3, dtype=torch.float64)
        sample = ImportanceSample(
            draws, 0.0 * target[:, 0], target, proposal.log_prob(draws), still, zero, chol, 0.0, 1
        )
        centre, scale = sample.correct_gaussian(mode, chol)
        found.append((float(centre), float(scale)))
        weighted.append((float(sample.mean), float(sample.covariance.sqrt())))
    moments = tensor(*found)
    plain = tensor(*weighted)
    assert abs(float(mode) - mean) > 0.15 * sd  # what is to be corrected
    torch.testing.assert_close(moments.mean(0), tensor(mean, sd), rtol=0.0, atol=0.01 * sd)
    assert bool((moments.std(0) < 0.8 * plain.std(0)).all())


def test_that_stated_errors_are_the_scatter_over_seeds() -> None:
    samples = [gaussian_sample(1.0, seed, 200) for seed in range(150)]
    for value, error in (
        (
            tensor(*[s.log_evidence for s in samples]),
            tensor(*[s.log_evidence_error for s in samples]),
        ),
        (
            torch.stack([s.mean[0] for s in samples]),
            torch.stack([mean_error(s)[0] for s in samples]),
        ),
        (
            torch.stack([s.covariance[1, 1].sqrt() for s in samples]),
            torch.stack([sd_error(s)[1] for s in samples]),
        ),
    ):
        assert float(value.std()) == pytest.approx(float(error.square().mean().sqrt()), rel=0.25)


def test_that_a_proposal_far_too_narrow_is_found_out() -> None:
    """In two dimensions a t of a tenth the width has weights of shape near 1; the right width has a
    bounded one.
    """
    narrow = gaussian_sample(0.1, 1)
    right = gaussian_sample(1.0, 1)
    assert not narrow.reliable
    assert narrow.pareto_k > 0.7
    assert right.pareto_k < 0.3
    assert right.effective_samples > 0.9 * len(right)


def test_that_resampling_takes_each_draw_in_proportion_to_its_weight() -> None:
    sample = gaussian_sample(1.5, 2)
    chosen = sample.resample_draws(5000, generator(0))
    counts = torch.bincount(chosen, minlength=len(sample))
    assert bool(((counts - 5000 * sample.weights).abs() <= 1.0 + 1e-9).all())
    assert not torch.equal(chosen, chosen.sort().values)


@pytest.mark.parametrize(("variance", "size"), [(0.2, 1), (0.1, 1), (0.3, 3), (0.2, 3)])
def test_that_the_error_of_an_evidence_whose_draws_are_not_reliable_covers_it(variance, size):
    """Proposals narrower than the posterior: log evidence 0, mostly missed from below, which the
    spread of weights hides.
    """
    count = 256
    within = []
    plain = []
    for seed in range(60):
        source = torch.Generator().manual_seed(seed)
        draws = math.sqrt(variance) * torch.randn(
            count, size, generator=source, dtype=torch.float64
        )
        log_target = -0.5 * (draws.square() + math.log(2.0 * math.pi)).sum(1)
        log_proposal = -0.5 * (draws.square() / variance + math.log(2.0 * math.pi * variance)).sum(
            1
        )
        zero = torch.zeros(count, dtype=torch.float64)
        still = torch.zeros(count, 1, 3)
        sample = ImportanceSample(
            draws,
            log_target,
            zero[:, None],
            log_proposal,
            still,
            torch.zeros(size),
            torch.eye(size),
            first_shape=0.0,
            rounds=1,
        )
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
    datum: float, noise: float, hangs_on: tuple[bool, bool]
) -> None:
    """Prior N(0, 1) to the power a, likelihood N(datum, noise^2) to the power b: precision ``a + b/s^2``,
    mean ``b y/s^2`` over it; derivatives in ln a and ln b at 1 are written out.
    """
    inverse = noise**-2
    precision = 1.0 + inverse
    mean = datum * inverse / precision
    sd = precision**-0.5
    levels = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000
    controls = (mean + sd * torch.special.ndtri(levels))[:, None]
    prior = torch.distributions.Normal(0.0, 1.0).log_prob(controls[:, 0])
    likelihood = torch.distributions.Normal(datum, noise).log_prob(controls)
    exact = torch.distributions.Normal(mean, sd).log_prob(controls[:, 0])
    sample = ImportanceSample(
        controls,
        prior,
        likelihood,
        exact,
        torch.zeros(4000, 1, 3),
        torch.zeros(1),
        torch.eye(1),
        first_shape=0.0,
        rounds=1,
    )
    by_prior = max(mean / precision / sd, 0.5 / precision)
    by_data = max(datum * inverse / precision**2 / sd, 0.5 * inverse / precision)
    found = sample.power_sensitivities[:, 0].tolist()
    expected = [math.log(2.0) * by_prior, math.log(2.0) * by_data]
    assert found == pytest.approx(expected, rel=2e-2)
    assert tuple(x >= SENSITIVE for x in found) == hangs_on
