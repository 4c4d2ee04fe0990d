"""The verdict on the Gaussian answer, both ways, and its repair against quadrature.

Draws that come upon a lower minimum have the fit made again from there; others have not.
"""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from imr_torch.assimilate import (
    Assimilation,
    ModelFit,
    Posterior,
    SearchOptions,
    Verdict,
    WeighingOptions,
    weigh,
)
from imr_torch.assimilate.importance import largest_shape
from imr_torch.assimilate.refit import find_lower_draw
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import ones
from imr_torch.observe import ExperimentBatch
from imr_torch.progress import ProgressLine
from tests.curved import CurvedSimulator, assert_posterior, quadrature
from tests.linear import BOTH, NOISE, LinearSimulator, exact, experiments, fit_linear, prior
from tests.refusals import refused


def weighed(assimilation: Assimilation, simulator=None, **how) -> ModelFit:
    """Its one fit with weighted draws."""
    return weigh(assimilation, simulator or LinearSimulator(), seed=0, **how).fits[0]


@pytest.fixture(scope="module")
def simple():
    return fit_linear(experiments(3, nuisance=BOTH))


@pytest.fixture(scope="module")
def truth(simple):
    return exact(simple.prior.models[0], simple.batch)


def changed(assimilation: Assimilation, **fields) -> Assimilation:
    """The assimilation with its one fit altered."""
    return replace(assimilation, fits=(replace(assimilation.fits[0], **fields),))


def test_that_a_gaussian_posterior_is_trusted_in_one_round(simple):
    before = simple.fits[0]
    after = weighed(simple)
    assert before.verdict is Verdict.UNCHECKED
    assert before.trust.startswith("no draws were weighted")
    assert after.verdict is Verdict.TRUSTED
    assert after.sample.rounds == 1
    assert after.sample.effective_samples > 200.0
    assert after.trust.startswith(
        "interval computation checked: weighted draws confirm the Gaussian fit (k "
    )
    assert after.trust.endswith("of 256)")
    sds = torch.linalg.norm(before.posterior.chol, dim=1)
    moved = (after.posterior.mean - before.posterior.mean).abs() / sds
    # what chance leaves of a correction that is not needed; .06 by weighted draws alone
    assert moved.max() < 0.03
    assert_close(
        torch.linalg.norm(after.posterior.chol, dim=1) / sds,
        ones(2),
        rtol=0.0,
        atol=0.03,
    )
    assert simple.fits[0].sample is None


@pytest.mark.parametrize("shift", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("width", [0.1, 0.3, 1.7])
def test_that_a_wrong_gaussian_is_repaired_to_the_exact_posterior(
    simple, truth, width, shift
):
    fit = simple.fits[0]
    mean = fit.mean + shift * fit.chol[:, 0]
    wrong = changed(
        simple, mean=mean, chol=width * fit.chol, nuisances=fit.nuisances_at(mean)
    )
    right = weighed(wrong, samples=256, rounds=8)
    sample = right.sample
    assert right.verdict is Verdict.REPAIRED
    assert "repaired" in right.trust
    assert sample.rounds > 1 or width > 1.0
    assert_posterior(sample, truth.mean, truth.covariance, truth.log_evidence)
    chol = right.prior.chol
    assert_close(right.posterior.mean, right.prior.mean + chol @ sample.mean)
    assert_close(
        right.posterior.chol @ right.posterior.chol.mT, chol @ sample.covariance @ chol.mT
    )


def test_that_a_gaussian_far_too_narrow_shows_a_heavy_tail(simple):
    narrow = changed(simple, chol=0.05 * simple.fits[0].chol)
    once = weighed(narrow, rounds=1)
    assert once.sample.first_shape > 0.7
    assert once.verdict is Verdict.REFUSED
    assert once.trust.startswith("intervals not reliable: quote none of this model (k ")
    assert f"; k is above {largest_shape(len(once.sample)):.2f})" in once.trust
    assert torch.equal(once.posterior.mean, narrow.fits[0].posterior.mean)


@pytest.mark.parametrize(
    ("width", "left"), [(1.5, 300), (0.8, 700)]
)  # by a Gaussian that is too narrow, 484 are left
def test_that_nuisances_are_integrated_out_even_where_their_gaussian_is_wrong(
    simple, truth, width, left
):
    """A conditional Gaussian of the nuisances that is too wide or too narrow costs samples and changes no answer."""
    wrong = changed(simple, nuisance_chol=simple.fits[0].nuisance_chol / width)
    sample = weighed(wrong, samples=2048, rounds=1).sample
    assert_posterior(sample, truth.mean, truth.covariance, truth.log_evidence)
    assert sample.log_evidence_error > 0.005
    assert sample.effective_samples > left


def test_that_kept_nuisances_are_draws_of_their_posterior(simple, truth):
    sample = weighed(simple, samples=2048).sample
    mean = (sample.weights[:, None, None] * sample.nuisances).sum(0)
    assert_close(mean, truth.nuisances, rtol=0.0, atol=0.1)
    assert sample.nuisances[:, :, 0].abs().max() == 0.0  # Rmax is known here


@pytest.mark.parametrize("bend", [0.0, 0.5, 1.5])
def test_that_moments_of_a_curved_posterior_equal_quadrature(bend):
    simulator = CurvedSimulator(bend)
    batch = experiments(1)
    fit = weighed(fit_linear(batch, simulator), simulator, samples=1024, rounds=6)
    truth = quadrature(fit, batch, simulator)
    sample = fit.sample
    assert fit.verdict is (Verdict.REPAIRED if bend else Verdict.TRUSTED)
    sds = assert_posterior(sample, truth.mean, truth.covariance, truth.log_evidence)
    gaussian = ((fit.mean - truth.mean).abs() / sds).max()
    repaired = ((sample.mean - truth.mean).abs() / sds).max()
    assert repaired < 0.15
    assert not bend or gaussian > 2.0 * repaired


def test_that_quantiles_of_a_curved_posterior_are_those_of_its_draws_and_not_of_a_gaussian():
    simulator = CurvedSimulator(1.5)
    batch = experiments(1)
    fit = weighed(fit_linear(batch, simulator), simulator, samples=4096, rounds=6)
    assert fit.verdict is Verdict.REPAIRED
    truth = quadrature(fit, batch, simulator)
    levels = [0.05, 0.5, 0.95]
    for column, marginal in enumerate(fit.prior.marginals):
        controls = marginal.to_control(fit.posterior.quantile(levels)[:, column])
        found = (controls - fit.prior.mean[column]) / fit.prior.chol[column, column]
        assert [truth.below(column, float(x)) for x in found] == pytest.approx(
            levels, abs=0.03
        )


def test_that_the_draws_of_a_model_do_not_depend_on_company():
    both = fit_linear(experiments(2, nuisance=BOTH), belief=prior(("newtonian", "nhkv")))
    together = weigh(both, LinearSimulator(), seed=0)["nhkv"].sample
    (alone,) = weigh(replace(both, fits=(both["nhkv"],)), LinearSimulator(), seed=0).fits
    for name in ("controls", "by_experiment", "nuisances"):
        assert_close(getattr(alone.sample, name), getattr(together, name))


def test_that_draws_of_which_all_fail_are_an_error(simple):
    """That some which fail weigh nothing: tests/select/test_evidence.py."""
    with refused(r"nhkv: none of 256 draws could be simulated", ConvergenceError):
        weigh(simple, LinearSimulator(fails=True), seed=0)


@pytest.mark.parametrize(("samples", "rounds"), [(24, 4), (256, 0)])
def test_that_too_few_samples_or_rounds_are_refused(simple, samples, rounds):
    with refused(r"must be at least 25, and rounds"):
        weigh(simple, LinearSimulator(), seed=0, samples=samples, rounds=rounds)


def test_that_the_noise_of_the_weights_alone_condemns_nothing():
    """Over 30 seeds a Gaussian posterior is never repaired: the divergence that Monte Carlo error
    makes is taken off.
    """
    batch = ExperimentBatch(experiments(1).experiments, NOISE)
    fit = fit_linear(batch, belief=prior(("gen_qkv",)))
    verdicts = [
        weigh(fit, LinearSimulator(), seed=seed, samples=100).fits[0].verdict
        for seed in range(30)
    ]
    assert verdicts.count(Verdict.TRUSTED) >= 28


def test_that_a_draw_whose_clock_is_impossible_weighs_nothing_and_does_not_end_the_batch(
    simple,
):
    """A conditional Gaussian of the time zero so wide that records would begin long before the maximum radius."""

    class Strict(LinearSimulator):
        def __call__(self, parameters, designs, times):
            assert times.min() > -0.5
            return super().__call__(parameters, designs, times)

    wild = changed(simple, nuisance_chol=0.05 * simple.fits[0].nuisance_chol)
    fit = weigh(wild, Strict(), seed=0, samples=256, rounds=1).fits[0]
    assert fit.verdict is Verdict.REFUSED
    assert 0.0 < fit.sample.effective_samples < 100.0


def test_that_a_model_that_is_improbable_by_its_evidence_alone_gets_one_round():
    """Both optima are alike; what sets the models apart is the volume of a parameter that the data
    do not need.
    """
    both = fit_linear(experiments(3), belief=prior(("nhkv", "gen_qkv")))
    assert abs(both["gen_qkv"].cost - both["nhkv"].cost) < 1.0
    tight = replace(
        both, fits=tuple(replace(fit, chol=0.7 * fit.chol) for fit in both.fits)
    )
    for drop_behind, again in ((2.0, False), (4.0, True)):
        said: list[ProgressLine] = []
        weighted = weigh(
            tight,
            LinearSimulator(),
            seed=0,
            samples=256,
            drop_behind=drop_behind,
            progress=said.append,
        )
        assert (weighted["gen_qkv"].sample.rounds > 1) == again
        assert weighted["nhkv"].sample.rounds > 1
        assert len(said) == 1 + sum(fit.sample.rounds for fit in weighted.fits)
        assert said[1].step == "NHKV, round 1 of at most 4"
        done = [line.part * line.size for line in said]
        assert done == sorted(set(done))  # in units of what was planned
        assert said[-1].part == 1.0


def test_that_no_round_follows_draws_of_which_too_few_are_effective(simple):
    poor = changed(simple, chol=0.02 * simple.fits[0].chol)

    def rounds(share: float) -> int:
        options = WeighingOptions(hopeless=share)
        weighted = weigh(
            poor, LinearSimulator(), seed=0, samples=25, rounds=8, options=options
        )
        return weighted.fits[0].sample.rounds

    assert rounds(1.0) == 3 < rounds(0.0)


@pytest.mark.parametrize("times", [1.0, 10.0])
def test_that_nuisances_are_placed_anew_where_they_do_not_follow_the_gel_linearly(
    simple, times
):
    """With a fit whose nuisances move with the gel many times as far as they should, the draws are
    as good as with the right one; without placing them anew they are not.
    """
    moved = changed(simple, nuisance_response=times * simple.fits[0].nuisance_response)

    def effective(options: WeighingOptions) -> float:
        fit = weighed(moved, rounds=1, options=options)
        return fit.sample.effective_samples

    assert effective(WeighingOptions()) > 200.0
    left_there = effective(WeighingOptions(lost=1e9))
    assert (left_there > 200.0) is (times == 1.0)


def test_that_many_curves_cost_few_of_the_draws():
    """Each integral over nuisances scatters, and weights are products over experiments. Nuisances
    of the second round are placed anew.
    """
    parts = [experiments(3, nuisance=BOTH, seed=seed) for seed in range(8)]
    many = fit_linear(
        replace(parts[0], experiments=tuple(e for p in parts for e in p.experiments))
    )
    fit = many.fits[0]
    off = changed(many, mean=fit.mean + 0.5 * fit.chol[:, 0])
    sample = weighed(off, rounds=2).sample
    assert sample.rounds == 2
    assert sample.effective_samples > 190.0  # with 15 degrees of freedom 146 are left


@pytest.fixture(scope="module")
def right():
    options = SearchOptions(raw_samples=24, starts=2)
    return fit_linear(experiments(3, nuisance=BOTH), options=options)


def ended_too_high(right: Assimilation, away: float) -> Assimilation:
    """As if the search had ended some standard deviations from the minimum, and there were one."""
    fit = right.fits[0]
    mean = fit.mean + away * fit.chol[:, 0]
    there = replace(
        fit, mean=mean, nuisances=fit.nuisances_at(mean), cost=fit.cost + 0.5 * away**2
    )
    return replace(right, fits=(there,))


def test_that_a_fit_above_another_minimum_is_made_again_from_there(right):
    wrong = ended_too_high(right, 4.0)
    truth = exact(right.prior.models[0], right.batch)
    said = []
    mended = weighed(wrong, progress=said.append)
    assert mended.cost == pytest.approx(right.fits[0].cost, abs=1e-6)
    assert mended.certificate.converged
    assert mended.verdict is Verdict.TRUSTED
    assert_close(mended.mean, truth.mean, rtol=0.0, atol=1e-3)
    assert mended.sample.log_evidence == pytest.approx(
        truth.log_evidence, abs=5.0 * mended.sample.log_evidence_error
    )
    assert any(
        line == "NHKV: draws found a minimum that is 8.0 nats lower" for line in said
    )
    assert wrong.fits[0].sample is None


def test_that_it_stays_where_that_is_not_asked_for(right):
    wrong = ended_too_high(right, 4.0)
    assert weighed(wrong, options=WeighingOptions(refits=0)).cost == wrong.fits[0].cost


@pytest.mark.parametrize(
    ("away", "behind", "found"), [(0.0, 0.0, False), (4.0, 0.0, True), (4.0, 200.0, False)]
)
def test_that_a_draw_is_lower_only_in_another_basin_and_of_a_model_that_may_matter(
    right, away, behind, found
):
    options = WeighingOptions(refits=0)
    fit = weighed(ended_too_high(right, away), options=options)
    posterior = Posterior(fit.prior, right.batch, LinearSimulator())
    assert (
        find_lower_draw(fit, fit.cost - behind, posterior, options) is not None
    ) is found


def test_that_a_fit_that_only_looks_too_high_is_not_made_again(right):
    """Too narrow a Gaussian of the nuisances makes all draws look more probable than the optimum;
    their costs are not lower.
    """
    fit = right.fits[0]
    said = []
    narrow = replace(right, fits=(replace(fit, nuisance_chol=2.0 * fit.nuisance_chol),))
    weighted = weighed(narrow, progress=said.append)
    assert not any(line.startswith("assimilation") for line in said)
    assert weighted.cost == fit.cost
    assert weighted.sample.rounds == 2
