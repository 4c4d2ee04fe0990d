"""Smooth deviations: evidence against dense algebra, and shots told apart that differ from those
that are alike.
"""

from dataclasses import replace

import pytest
import torch
from torch.distributions import MultivariateNormal

from imr_torch.assimilate import Posterior, infer_frame_noise
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.assimilate.slow_noise import smooth_deviations
from imr_torch.observe import ExperimentBatch, Noise
from imr_torch.random import generator
from tests.assimilate.test_frame_noise import curves, near, smooth, with_slow_noise
from tests.gap.synthetic import BASE, SIMULATOR


def known(batch: ExperimentBatch) -> Neighbourhood:
    """About the base model's fit, with the noise inferred there."""
    place = near(batch)
    return Posterior(BASE, infer_frame_noise(place).applied(batch), SIMULATOR).neighbourhood(
        place.point
    )


def alike(batch: ExperimentBatch, size: float, seed: int) -> ExperimentBatch:
    """The same deviation in all shots."""
    own = smooth(size, batch.curves[0].times, generator(seed))
    return replace(
        batch, experiments=tuple(replace(e, radius=e.radius + own) for e in batch.curves)
    )


def test_that_evidence_is_that_of_dense_algebra():
    """Gel and nuisances are integrated out as a Gaussian prior about the point, here one of zeros."""
    place = known(curves(Noise(), spacing=0.08))
    zero = replace(
        place,
        point=replace(
            place.point, gel=0.0 * place.point.gel, nuisances=0.0 * place.point.nuisances
        ),
    )
    batch, (by_gel, by_nuisance) = zero.posterior.batch, zero.slopes
    shots, frames = batch.times.shape
    columns = torch.zeros(
        shots, frames, by_gel.shape[-1] + shots * by_nuisance.shape[-1], dtype=torch.float64
    )
    columns[..., : by_gel.shape[-1]] = by_gel
    for shot in range(shots):
        first = by_gel.shape[-1] + shot * by_nuisance.shape[-1]
        columns[shot, :, first : first + by_nuisance.shape[-1]] = by_nuisance[shot]
    white = (
        batch.sd(zero.centre).square().flatten().diag()
        + columns.flatten(0, 1) @ columns.flatten(0, 1).mT
    )
    lags = 2.146193220620583 * (batch.times[0][:, None] - batch.times[0]).abs() / 0.3
    slow = torch.block_diag(*[0.004**2 * (1.0 + lags) * torch.exp(-lags)] * shots)
    residual = (batch.mean - zero.centre).flatten()
    mean = torch.zeros_like(residual)
    gained = [
        MultivariateNormal(mean, white + extra).log_prob(residual) for extra in (slow, 0.0 * slow)
    ]
    found = smooth_deviations(zero, amounts=(0.004,), durations=(0.3,))
    assert found.own == pytest.approx(float(gained[0] - gained[1]), abs=1e-5)


def test_that_quiet_curves_have_no_smooth_deviation():
    found = smooth_deviations(known(curves(Noise())))
    assert max(found.own, found.common) < 0.0


@pytest.mark.parametrize("seed", range(3))
def test_that_noise_differs_between_shots_and_an_effect_does_not(seed):
    noise = smooth_deviations(
        known(with_slow_noise(curves(Noise(), seed=seed), 0.015, seed=seed + 20))
    )
    effect = smooth_deviations(known(alike(curves(Noise(), seed=seed), 0.015, seed=seed + 50)))
    assert noise.own > max(10.0, noise.common + 1.0)
    assert effect.common > max(10.0, effect.own + 3.0)


def test_that_one_shot_cannot_tell_them_apart():
    batch = with_slow_noise(curves(Noise()), 0.02)
    found = smooth_deviations(known(replace(batch, experiments=batch.experiments[:1])))
    assert found.own == pytest.approx(found.common, abs=1e-6)
