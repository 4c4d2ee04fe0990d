"""Draws that come upon a lower minimum have the fit made again from there; others have not."""

from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import Assimilation, EnsembleOptions, Verdict, assimilate, weigh
from imr_torch.assimilate.lower import lower_minima
from imr_torch.observe import Nuisance
from tests.linear import LinearSimulator, exact, experiments, prior

BOTH = Nuisance(time_zero=0.2, rest_radius=0.3)


@pytest.fixture(scope="module")
def right() -> Assimilation:
    options = EnsembleOptions(scouts=24, starts=2)
    return assimilate(prior(("nhkv",)), experiments(3, nuisance=BOTH), LinearSimulator(), seed=1, options=options)


def ended_too_high(right: Assimilation, away: float) -> Assimilation:
    """As if the search had ended some standard deviations from the minimum, and there were one."""
    fit = right.fits[0]
    mean = fit.mean + away * fit.chol[:, 0]
    there = replace(fit, mean=mean, nuisances=fit.nuisances_at(mean), cost=fit.cost + 0.5 * away**2)
    return replace(right, fits=(there,))


def test_that_a_fit_above_another_minimum_is_made_again_from_there(right: Assimilation) -> None:
    wrong, truth, said = ended_too_high(right, 4.0), exact(right.prior.models[0], right.batch), []
    mended = weigh(wrong, LinearSimulator(), seed=0, progress=said.append).fits[0]
    assert mended.cost == pytest.approx(right.fits[0].cost, abs=1e-6)
    assert mended.certificate.converged
    assert mended.verdict is Verdict.TRUSTED
    torch.testing.assert_close(mended.mean, truth.mean, rtol=0.0, atol=1e-3)
    assert mended.sample.log_evidence == pytest.approx(truth.log_evidence, abs=5.0 * mended.sample.log_evidence_error)
    assert any(line == "nhkv: draws found a minimum that is 8.0 nats lower" for line in said)
    assert wrong.fits[0].sample is None


def test_that_it_stays_where_that_is_not_asked_for(right: Assimilation) -> None:
    wrong = ended_too_high(right, 4.0)
    assert weigh(wrong, LinearSimulator(), seed=0, refit=False).fits[0].cost == wrong.fits[0].cost


def test_that_nothing_is_simulated_where_no_draw_is_more_probable_or_the_model_is_far_behind(right: Assimilation) -> None:
    def unused(*_args, **_kwargs):
        raise AssertionError("a fit was made")

    sound = weigh(right, LinearSimulator(), seed=0, refit=False)
    assert lower_minima(sound, unused, seed=0) == {}
    wrong = weigh(ended_too_high(right, 4.0), LinearSimulator(), seed=0, refit=False).fits[0]
    rival = replace(sound.fits[0], cost=wrong.cost - 200.0)
    assert lower_minima(replace(sound, fits=(wrong, rival)), unused, seed=0) == {}
