"""Nuisances given the gel: exact where the simulator is linear in them, from any guess; and what
that does for weighing.
"""

import pytest
import torch
from torch.testing import assert_close

from imr_torch.assimilate import (
    Point,
    Posterior,
)
from imr_torch.float64 import eye, full, zeros
from imr_torch.observe import ExperimentBatch, predict
from tests.linear import BOTH, CORRELATED, NHKV, NOISE, LinearSimulator, experiments


def closed_form(parameters, batch: ExperimentBatch, simulator):
    """Ridge regression of the residual of each experiment on its two linear nuisances."""
    still = zeros(len(batch.experiments), 3)
    base = torch.where(batch.mask, predict(simulator, parameters, batch, still), 0.0)
    columns = []
    for j in range(3):
        moved = still.clone()
        moved[:, j] = batch.nuisance_sds[:, j] * (j > 0)
        columns.append(
            torch.where(batch.mask, predict(simulator, parameters, batch, moved), 0.0)
            - base
        )
    sd = batch.sd(base)
    slopes = torch.stack([batch.whiten(c, sd) for c in columns], dim=-1)
    hessian = slopes.mT @ slopes + eye(3)
    mean = torch.linalg.solve(
        hessian, slopes.mT @ batch.whiten(batch.mean - base, sd)[..., None]
    )[..., 0]
    return mean, hessian


@pytest.mark.parametrize("noise", [NOISE, CORRELATED], ids=["independent", "correlated"])
@pytest.mark.parametrize("start", [0.0, 1.5])
@pytest.mark.parametrize("fitted", [False, True], ids=["own slopes", "slopes of a fit"])
def test_that_one_step_is_exact_where_nuisances_are_linear(noise, start, fitted):
    batch = experiments(3, nuisance=BOTH, noise=noise)
    simulator = LinearSimulator()
    part = NHKV.models[0]
    gels = part.controls(4, seed=0)
    guess = full((4, 3, 3), start) * (batch.nuisance_sds > 0.0)
    posterior = Posterior(part, batch, simulator)
    there = Point(part.controls(1, seed=1)[0], guess[0])
    beside = posterior.neighbourhood(there) if fitted else None
    found, root = posterior.fit_nuisances(Point(gels, guess), beside=beside)
    for i in range(4):
        mean, hessian = closed_form(part.to_si(gels[i]), batch, simulator)
        assert_close(found[i], mean, rtol=1e-5, atol=1e-6)
        assert_close(root[i] @ root[i].mT, hessian, rtol=1e-5, atol=1e-6)
