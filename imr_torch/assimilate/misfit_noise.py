"""The noise law for a model that misses the curves: what it leaves is a misfit that drifts over the event, not noise."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from imr_torch.assimilate.noise_law import most_probable_law
from imr_torch.assimilate.noise_prior import NoisePrior
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.observe import Noise


def misfit_law(fits: Sequence[Neighbourhood], prior: NoisePrior) -> Noise:
    """The noise law for a model that misses the curves: independent frames, enlarged for what its residuals have in common.

    A misfit drifts over the event. Taken for correlated noise, such a drift costs nothing, and the fit may pass beside the
    curves as a whole; with independent frames it passes through them, but states intervals as if each frame told something
    new. The variance of an estimate by independent weights ``W`` under residuals of covariance ``S`` is
    ``H^-1 (J^T W S W J) H^-1`` (White, Econometrica 50, 1982); the noise is enlarged by what that adds to the mean variance of
    the gel, with ``S`` of the most probable law of correlated noise.

    Args:
        fits: as for :func:`imr_torch.assimilate.noise_law.most_probable_law`.
        prior: of the law.
    """
    law, drifting = most_probable_law(fits, prior, independent=True), most_probable_law(fits, prior)
    if drifting.correlation_time == 0.0:
        return law
    added, told = (sum(parts) for parts in zip(*(_variances(near, law, drifting) for near in fits), strict=True))
    widened = max(1.0, math.sqrt(added / told))
    return replace(law, scale=widened * law.scale, widened=widened)


def _variances(near: Neighbourhood, law: Noise, drifting: Noise) -> tuple[float, float]:
    """Summed variances of the gel's whitened coordinates by residuals of the drifting law, and by those of the other."""
    batch = near.posterior.batch
    factors = batch.noise_factors / batch.counts.sqrt()
    sd, true_sd = (noise.sd(near.centre, batch.times) * factors for noise in (law, drifting))
    by_gel, by_nuisance = (torch.where(batch.mask, 1.0 / sd, 0.0)[..., None] * x for x in near.slopes)
    nuisance = torch.eye(3, dtype=torch.float64) + by_nuisance.mT @ by_nuisance
    own = by_gel - by_nuisance @ torch.linalg.solve(nuisance, by_nuisance.mT @ by_gel)
    gaps = (batch.times[:, :, None] - batch.times[:, None, :]).abs()
    moved = (true_sd / sd)[..., None] * own
    scatter = (moved.mT @ torch.exp(-gaps / drifting.correlation_time) @ moved).sum(0)
    told = (own.mT @ own).sum(0)
    inverse = torch.linalg.inv(torch.eye(len(told), dtype=torch.float64) + told)
    return float((inverse @ scatter).trace()), float((inverse @ told).trace())
