"""Ridges: a bent posterior is covered to its ends, even where it folds back; failures end a side
and no more.
"""

import pytest
import torch
from torch.testing import assert_close

from imr_torch.assimilate import Posterior, Verdict, weigh
from imr_torch.assimilate.ridge import trace_ridge
from imr_torch.observe import Nuisance
from tests.curved import CurvedSimulator, assert_posterior, quadrature
from tests.linear import LinearSimulator, experiments, fit_linear


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("bend", [0.5, 1.5])
def test_that_a_bent_posterior_is_covered_to_its_ends(bend, seed):
    """G all but mute, so that its posterior is as wide as its prior, and mu bends along it, by up to ten times its width."""
    simulator = CurvedSimulator(bend, mute=0.05)
    batch = experiments(3)
    fit = weigh(
        fit_linear(batch, simulator, seed=seed),
        simulator,
        seed=seed,
    ).fits[0]
    truth = quadrature(fit, batch, simulator, points=241)
    sample = fit.sample
    assert fit.verdict is Verdict.REPAIRED
    assert sample.rounds <= 3
    assert sample.effective_samples > 100.0
    assert_posterior(sample, truth.mean, truth.covariance, truth.log_evidence)


def test_that_nuisances_go_along_the_ridge():
    """With each point's own nuisances the ridge is followed to where the profile is low, and weighing is content."""
    nuisance = Nuisance(time_zero=0.2, rest_radius=0.3)
    simulator = CurvedSimulator(0.7, mute=0.1)
    batch = experiments(2, nuisance=nuisance)
    fits = fit_linear(batch, simulator)
    proposal = trace_ridge(fits.fits[0], Posterior(fits.fits[0].prior, batch, simulator))
    assert proposal.weights[0] < 2e-3
    assert proposal.weights[-2] < 2e-3
    assert weigh(fits, simulator, seed=0).fits[0].sample.reliable


def test_that_failing_bubbles_end_one_side():
    batch = experiments(2)
    (fit,) = fit_linear(batch).fits
    whole = trace_ridge(fit, Posterior(fit.prior, batch, LinearSimulator()))
    top = float(fit.parameters(fit.mean)[0])
    one_sided = trace_ridge(
        fit, Posterior(fit.prior, batch, LinearSimulator(limit={"G": 1.001 * top}))
    )
    assert 3 < len(one_sided.centres) < len(whole.centres)
    none = trace_ridge(fit, Posterior(fit.prior, batch, LinearSimulator(fails=True)))
    assert_close(none.centres, fit.mean[None])


def test_that_a_repaired_belief_hands_on_a_cloud_with_the_width_that_it_has_locally():
    """Across the ridge the moments are many times as wide as the belief is anywhere; a straight one
    has no cloud.
    """
    batch = experiments(3)
    bent, straight = (
        weigh(fit_linear(batch, s, seed=0), s, seed=0).fits[0].posterior
        for s in (CurvedSimulator(1.5, mute=0.05), CurvedSimulator(0.0, mute=0.05))
    )
    assert straight.cloud is None
    moments = torch.linalg.slogdet(bent.chol @ bent.chol.mT).logabsdet
    local = -torch.linalg.slogdet(bent.cloud.precisions).logabsdet
    assert len(local) == 64
    assert (moments - local).median() > 2.0
    assert_close(bent.cloud.controls.mean(0), bent.mean, rtol=0.0, atol=0.15)
    scatter = torch.cov(bent.cloud.controls.mT).diagonal().sqrt() / torch.linalg.norm(
        bent.chol, dim=1
    )
    assert ((scatter > 0.85) & (scatter < 1.15)).all()
