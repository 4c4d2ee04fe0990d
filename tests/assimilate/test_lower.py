"""Draws that come upon a lower minimum have the fit made again from there; others have not."""

from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import (
    Assimilation,
    ModelFit,
    Point,
    Posterior,
    SearchOptions,
    Verdict,
    WeighingOptions,
    assimilate,
    weigh,
)
from imr_torch.assimilate.weighing import lower_point
from imr_torch.observe import Nuisance
from tests.linear import LinearSimulator, exact, experiments, prior

BOTH = Nuisance(time_zero=0.2, rest_radius=0.3)


@pytest.fixture(scope="module")
def right() -> Assimilation:
    options = SearchOptions(raw_samples=24, starts=2)
    return assimilate(
        prior(("nhkv",)), experiments(3, nuisance=BOTH), LinearSimulator(), seed=1, options=options
    )


def ended_too_high(right: Assimilation, away: float) -> Assimilation:
    """As if the search had ended some standard deviations from the minimum, and there were one."""
    fit = right.fits[0]
    mean = fit.mean + away * fit.chol[:, 0]
    there = replace(fit, mean=mean, nuisances=fit.nuisances_at(mean), cost=fit.cost + 0.5 * away**2)
    return replace(right, fits=(there,))


def test_that_a_fit_above_another_minimum_is_made_again_from_there(right: Assimilation) -> None:
    wrong = ended_too_high(right, 4.0)
    truth = exact(right.prior.models[0], right.batch)
    said = []
    mended = weigh(wrong, LinearSimulator(), seed=0, progress=said.append).fits[0]
    assert mended.cost == pytest.approx(right.fits[0].cost, abs=1e-6)
    assert mended.certificate.converged
    assert mended.verdict is Verdict.TRUSTED
    torch.testing.assert_close(mended.mean, truth.mean, rtol=0.0, atol=1e-3)
    assert mended.sample.log_evidence == pytest.approx(
        truth.log_evidence, abs=5.0 * mended.sample.log_evidence_error
    )
    assert any(line == "nhkv: draws found a minimum that is 8.0 nats lower" for line in said)
    assert wrong.fits[0].sample is None


def test_that_it_stays_where_that_is_not_asked_for(right: Assimilation) -> None:
    wrong = ended_too_high(right, 4.0)
    assert (
        weigh(wrong, LinearSimulator(), seed=0, options=WeighingOptions(refits=0)).fits[0].cost
        == wrong.fits[0].cost
    )


def test_that_a_draw_is_better_only_above_another_minimum_and_of_a_model_that_may_matter(
    right: Assimilation,
) -> None:
    batch = right.batch
    simulator = LinearSimulator()
    sound = weigh(right, simulator, seed=0, options=WeighingOptions(refits=0)).fits[0]
    assert (
        lower_point(sound, sound.cost, Posterior(sound.prior, batch, simulator), WeighingOptions())
        is None
    )
    wrong = weigh(
        ended_too_high(right, 4.0), simulator, seed=0, options=WeighingOptions(refits=0)
    ).fits[0]
    point = lower_point(
        wrong, wrong.cost, Posterior(wrong.prior, batch, simulator), WeighingOptions()
    )
    assert point is not None
    assert -float(Posterior(wrong.prior, batch, simulator).log_joint(point)) < wrong.cost - 0.1
    assert (
        lower_point(
            wrong, wrong.cost - 200.0, Posterior(wrong.prior, batch, simulator), WeighingOptions()
        )
        is None
    )


def test_that_a_fit_that_only_looks_too_high_is_not_made_again(right: Assimilation) -> None:
    """Too narrow a Gaussian of the nuisances makes all draws look more probable than the optimum;
    their costs are not lower.
    """
    fit = right.fits[0]
    said = []
    narrow = replace(right, fits=(replace(fit, nuisance_chol=2.0 * fit.nuisance_chol),))
    weighted = weigh(narrow, LinearSimulator(), seed=0, progress=said.append).fits[0]
    assert not any(line.startswith("assimilation") for line in said)
    assert weighted.cost == fit.cost
    assert weighted.sample.rounds == 2


def test_that_a_minimum_that_is_not_lower_is_not_taken_and_the_fit_is_weighted_to_the_end(
    right: Assimilation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However often the draws promise one."""
    promised = []

    def promise(fit: ModelFit, best: float, *_: object) -> Point:
        promised.append(best)
        return fit.point

    monkeypatch.setattr("imr_torch.assimilate.weighing.lower_point", promise)
    fit = right.fits[0]
    said = []
    narrow = replace(right, fits=(replace(fit, nuisance_chol=2.0 * fit.nuisance_chol),))
    options = WeighingOptions(refits=1)
    weighted = weigh(narrow, LinearSimulator(), seed=0, options=options, progress=said.append).fits[
        0
    ]
    assert sum(line.startswith("assimilation: iteration 1,") for line in said) == len(promised) == 1
    assert weighted.cost == fit.cost
    assert weighted.sample.rounds == 2


def test_that_a_model_fitted_again_is_weighted_beside_others_whose_rounds_are_ahead(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All rounds are made; the third has several nuisances to a draw, of which one is kept in
    proportion to its weight.
    """
    monkeypatch.setattr("imr_torch.assimilate.weighing._State.is_refused", True)
    batch = experiments(3, nuisance=BOTH)
    options = SearchOptions(raw_samples=24, starts=2)
    both = assimilate(
        prior(("newtonian", "nhkv")), batch, LinearSimulator(), seed=1, options=options
    )
    wrong = replace(
        both, fits=(both.fits[0], *ended_too_high(replace(both, fits=both.fits[1:]), 4.0).fits)
    )
    said = []
    weighted = weigh(wrong, LinearSimulator(), seed=0, samples=1024, rounds=3, progress=said.append)
    assert sum(line.startswith("draws: round") for line in said) == 4
    for fit in weighted.fits:
        truth = exact(fit.prior, batch)
        sample = fit.sample
        assert sample.rounds == 3
        assert len(sample) == 1024
        assert sample.log_evidence == pytest.approx(
            truth.log_evidence, abs=4.0 * sample.log_evidence_error
        )
        weights = sample.weights[:, None, None]
        mean = (weights * sample.nuisances).sum(0)
        torch.testing.assert_close(mean, truth.nuisances, rtol=0.0, atol=0.1)
        again = (
            weigh(
                replace(both, fits=(both[fit.model],)),
                LinearSimulator(),
                seed=3,
                samples=1024,
                rounds=1,
            )
            .fits[0]
            .sample
        )
        sd = (weights * (sample.nuisances - mean).square()).sum(0).sqrt()
        mean = (again.weights[:, None, None] * again.nuisances).sum(0)
        expected = (again.weights[:, None, None] * (again.nuisances - mean).square()).sum(0).sqrt()
        torch.testing.assert_close(sd, expected, rtol=0.1, atol=0.0)
