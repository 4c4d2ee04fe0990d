"""How much wider the intervals of a fit must be than independent frames say, for what its residuals
have in common.

A misfit drifts over the event. Taken for correlated noise, such a drift costs nothing, and the fit
may pass beside the curves as a whole; with independent frames it passes through them, but states
intervals as if each frame told something new. The variance of an estimate by weights ``W`` that
take frames as independent, under residuals of covariance ``S``, is ``H^-1 (J^T W S W J) H^-1``
(White, Econometrica 50, 1982). ``S`` is that of the most probable law with correlated frames.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from imr_torch.assimilate.noise_law import LocalNoise, best_scales
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.observe import Noise

CORRELATION_TIMES = tuple(0.01 * 2.0 ** (k / 4.0) for k in range(34))
"""Correlation times that are tried, t*."""

INDEPENDENT = 0.25
"""Prior probability that frames are independent; all correlation times together have the rest."""


def interval_factor(fits: Sequence[Neighbourhood], law: Noise) -> float:
    """The factor on intervals of the gel; where fits have gels of their own, one for all.

    Args:
        fits: each fitted point with its local sensitivities.
        law: by which they weigh frames, of independent ones.
    """
    laws = [replace(law, correlation_time=time) for time in (0.0, *CORRELATION_TIMES)]
    local = [LocalNoise.of(near, laws) for near in fits]
    log_scales, _ = best_scales(local)
    value = torch.stack([one.marginal(log_scales[:, None])[:, 0] for one in local]).sum(0)
    value[0] += math.log(INDEPENDENT)
    value[1:] += math.log((1.0 - INDEPENDENT) / len(CORRELATION_TIMES))
    best = int(value.argmax())
    if best == 0:
        return 1.0
    drifting = replace(laws[best], scale=math.exp(float(log_scales[best])))
    parts = [_variances(near, law, drifting) for near in fits]
    added, told = (sum(part) for part in zip(*parts, strict=True))
    return max(1.0, math.sqrt(added / max(told, 1e-300)))


def _variances(near: Neighbourhood, law: Noise, drifting: Noise) -> tuple[float, float]:
    """Summed variances of the gel's whitened coordinates by residuals of the drifting law, and by
    those of the other.
    """
    batch = near.posterior.batch
    factors = batch.noise_factors / batch.counts.sqrt()
    sd, true_sd = (noise.sd(near.centre, batch.times) * factors for noise in (law, drifting))
    by_gel, by_nuisance = (
        torch.where(batch.mask, 1.0 / sd, 0.0)[..., None] * x for x in near.slopes
    )
    nuisance = torch.eye(by_nuisance.shape[-1], dtype=torch.float64) + by_nuisance.mT @ by_nuisance
    own = by_gel - by_nuisance @ torch.linalg.solve(nuisance, by_nuisance.mT @ by_gel)
    gaps = (batch.times[:, :, None] - batch.times[:, None, :]).abs()
    moved = (true_sd / sd)[..., None] * own
    scatter = (moved.mT @ torch.exp(-gaps / drifting.correlation_time) @ moved).sum(0)
    told = (own.mT @ own).sum(0)
    inverse = torch.linalg.inv(torch.eye(len(told), dtype=torch.float64) + told)
    return float((inverse @ scatter).trace()), float((inverse @ told).trace())
