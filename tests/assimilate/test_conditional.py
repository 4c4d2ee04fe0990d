"""Nuisances given the gel: exact where the simulator is linear in them, from any guess; and what
that does for weighing.
"""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from imr_torch.assimilate import (
    Point,
    Posterior,
    SearchOptions,
    WeighingOptions,
    assimilate,
    weigh,
)
from imr_torch.observe import ExperimentBatch, predict
from tests.curved import mean_error
from tests.linear import BOTH, CORRELATED, NOISE, LinearSimulator, exact, experiments, prior


def closed_form(parameters, batch: ExperimentBatch, simulator):
    """Ridge regression of the residual of each experiment on its two linear nuisances."""
    still = torch.zeros(len(batch.experiments), 3, dtype=torch.float64)
    base = torch.where(batch.mask, predict(simulator, parameters, batch, still), 0.0)
    columns = []
    for j in range(3):
        moved = still.clone()
        moved[:, j] = batch.nuisance_sds[:, j] * (j > 0)
        columns.append(
            torch.where(batch.mask, predict(simulator, parameters, batch, moved), 0.0) - base
        )
    sd = batch.sd(base)
    slopes = torch.stack([batch.whiten(c, sd) for c in columns], dim=-1)
    hessian = slopes.mT @ slopes + torch.eye(3, dtype=torch.float64)
    mean = torch.linalg.solve(hessian, slopes.mT @ batch.whiten(batch.mean - base, sd)[..., None])[
        ..., 0
    ]
    return mean, hessian


@pytest.mark.parametrize("noise", [NOISE, CORRELATED], ids=["independent", "correlated"])
@pytest.mark.parametrize("start", [0.0, 1.5])
@pytest.mark.parametrize("fitted", [False, True], ids=["own slopes", "slopes of a fit"])
def test_that_one_step_is_exact_where_nuisances_are_linear(noise, start, fitted):
    batch = experiments(3, nuisance=BOTH, noise=noise)
    simulator = LinearSimulator()
    part = prior(("nhkv",)).models[0]
    gels = part.controls(4, seed=0)
    guess = torch.full((4, 3, 3), start, dtype=torch.float64) * (batch.nuisance_sds > 0.0)
    beside = Point(part.controls(1, seed=1)[0], guess[0]) if fitted else None
    posterior = Posterior(part, batch, simulator)
    found, root = posterior.fit_nuisances(Point(gels, guess), beside=beside)
    for i in range(4):
        mean, hessian = closed_form(part.to_si(gels[i]), batch, simulator)
        torch.testing.assert_close(found[i], mean, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(root[i] @ root[i].mT, hessian, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("fitted", [False, True], ids=["own slopes", "slopes of a fit"])
def test_that_what_cannot_be_simulated_keeps_its_guess(fitted):
    batch = experiments(2, nuisance=BOTH)
    part = prior(("nhkv",)).models[0]
    gels = part.controls(3, seed=0)
    guess = torch.full((3, 2, 3), 0.3, dtype=torch.float64)
    guess[1, 0, 1] = -1e3  # a clock that is so early that there is no bubble yet
    beside = Point(gels[0], guess[0]) if fitted else None
    posterior = Posterior(part, batch, LinearSimulator())
    found, root = posterior.fit_nuisances(Point(gels, guess), beside=beside)
    assert torch.equal(found[1, 0], guess[1, 0])
    if not fitted:
        assert torch.equal(root[1, 0], torch.eye(3, dtype=torch.float64))  # of the prior
    assert not torch.equal(found[1, 1], guess[1, 1])
    failing = Posterior(part, batch, LinearSimulator(fails=True))
    failed, _ = failing.fit_nuisances(Point(gels, guess), beside=beside)
    assert torch.equal(failed, guess)


def test_that_weighing_survives_nuisances_that_do_not_move_as_the_fit_says():
    batch = experiments(3, nuisance=BOTH)
    simulator = LinearSimulator()
    fitted = assimilate(
        prior(("nhkv",)), batch, simulator, seed=1, options=SearchOptions(raw_samples=24)
    )
    fit = fitted.fits[0]
    spoilt = replace(
        fit,
        nuisance_response=torch.zeros_like(fit.nuisance_response),
        nuisances=fit.nuisances + 1.5,
    )
    spoilt = replace(spoilt, nuisance_chol=2.0 * fit.nuisance_chol)
    truth = exact(fitted.prior.models[0], batch)
    weighed = partial(weigh, replace(fitted, fits=(spoilt,)), simulator, seed=0, rounds=1)
    as_it_says = weighed(options=WeighingOptions(lost=math.inf)).fits[0].sample
    again = weighed().fits[0].sample
    assert not as_it_says.reliable
    assert again.reliable
    assert again.log_evidence == pytest.approx(
        truth.log_evidence, abs=5.0 * again.log_evidence_error
    )
    assert bool(((again.mean - truth.mean).abs() < 5.0 * mean_error(again)).all())
