"""Smooth deviations: evidence against dense algebra, and shots told apart that differ from those
that are alike.
"""

import math
from dataclasses import replace

import pytest
import torch
from torch.distributions import MultivariateNormal

from imr_torch.assimilate import Posterior, infer_frame_noise
from imr_torch.assimilate.matern import MATERN
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.assimilate.slow_noise import BesideSlowNoise, smooth_deviations
from imr_torch.float64 import tensor
from imr_torch.observe import ExperimentBatch, Noise
from imr_torch.random import generator
from tests.assimilate.test_frame_noise import curves, near, smooth, with_slow_noise
from tests.gap.synthetic import BASE, SIMULATOR


def known(batch: ExperimentBatch) -> Neighbourhood:
    """About the base model's fit, with the noise inferred there."""
    place = near(batch)
    return Posterior(
        BASE, infer_frame_noise(place).applied(batch), SIMULATOR
    ).neighbourhood(place.point)


def alike(batch: ExperimentBatch, size: float, seed: int) -> ExperimentBatch:
    """The same deviation in all shots."""
    own = smooth(size, batch.curves[0].times, generator(seed))
    return replace(
        batch, experiments=tuple(replace(e, radius=e.radius + own) for e in batch.curves)
    )


def dense_log_evidence(
    near: Neighbourhood, fitted: torch.Tensor, amount: float
) -> torch.Tensor:
    """Beside deviations of .3 in t*, with all that is fitted as columns of a covariance."""
    batch = near.posterior.batch
    columns = near.jacobian.flatten(1).mT
    observed = (batch.mean - near.centre).flatten() + columns @ near.coordinates
    columns = torch.cat((columns, fitted.flatten(1).mT), 1)
    lags = [MATERN * (times[:, None] - times).abs() / 0.3 for times in batch.times]
    smooth = [amount**2 * (1.0 + lag) * torch.exp(-lag) for lag in lags]
    noise = batch.sd(near.centre).square().flatten().diag()
    law = noise + torch.block_diag(*smooth) + columns @ columns.mT
    return MultivariateNormal(torch.zeros_like(observed), law).log_prob(observed)


def test_that_evidence_beside_slow_noise_is_that_of_dense_algebra():
    """Of what was fitted, and of what was fitted with each of two columns more."""
    near = known(curves(Noise(), spacing=0.08))
    beside = BesideSlowNoise.about(near, amounts=(0.004, 0.02), durations=(0.3,))
    times = near.posterior.batch.times
    more = torch.stack((0.01 * torch.sin(times), 0.02 * times))
    rows = beside.whiten(more)

    def mean_of_amounts(fitted: torch.Tensor) -> float:
        values = torch.stack([dense_log_evidence(near, fitted, a) for a in (0.004, 0.02)])
        return float(values.logsumexp(0)) - math.log(2.0)

    assert beside.log_evidence == pytest.approx(mean_of_amounts(more[:0]), abs=1e-8)
    with_one = [mean_of_amounts(more[k : k + 1]) for k in range(2)]
    assert beside.log_evidence_with(rows).tolist() == pytest.approx(with_one, abs=1e-8)
    both = beside.with_column(rows[:, 0]).log_evidence_with(rows[:, 1:])
    assert both == pytest.approx(mean_of_amounts(more), abs=1e-8)


def test_that_quiet_curves_have_no_smooth_deviation():
    found = smooth_deviations(known(curves(Noise())))
    assert max(found.own, found.common) < 0.0


@pytest.mark.parametrize("seed", range(3))
def test_that_noise_differs_between_shots_and_an_effect_does_not(seed):
    noise = smooth_deviations(
        known(with_slow_noise(curves(Noise(), seed=seed), 0.015, seed=seed + 20))
    )
    effect = smooth_deviations(
        known(alike(curves(Noise(), seed=seed), 0.015, seed=seed + 50))
    )
    assert noise.own > max(10.0, noise.common + 1.0)
    assert effect.common > max(10.0, effect.own + 3.0)


def test_that_one_shot_cannot_tell_them_apart():
    batch = with_slow_noise(curves(Noise()), 0.02)
    found = smooth_deviations(known(replace(batch, experiments=batch.experiments[:1])))
    assert found.own == pytest.approx(found.common, abs=1e-6)


def test_that_the_most_probable_point_is_found_from_afar():
    """From a displaced gel, evidence by linear extrapolation is off by more than what is left."""
    place = known(with_slow_noise(curves(Noise(), spacing=0.08), 0.01))
    away = place.posterior.neighbourhood(
        replace(place.point, gel=place.point.gel + tensor([0.1, -0.07]))
    )
    right, promised, found = (
        BesideSlowNoise.at_mode(place),
        BesideSlowNoise.about(away),
        BesideSlowNoise.at_mode(away),
    )
    assert found.log_evidence == pytest.approx(right.log_evidence, abs=0.3)
    assert abs(promised.log_evidence - right.log_evidence) > 3.0
    assert BesideSlowNoise.at_mode(away, steps=0).log_evidence == promised.log_evidence
