"""Observation noise of real traces, of which there is one each: from how rough they are.

A frame is compared with the cubic through its two neighbours on either side, which removes what a smooth curve does between
frames and keeps what the camera adds. Roughness shows only the part of the noise that changes from frame to frame; repeats
of public records differ by deviations that last 0.14 to 0.4 in t*. So the noise is taken as correlated, and its scale is the
one at which correlated noise of the published law would look as rough as the traces do. A model is never asked to be better
than a quarter of the published noise.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.observe import Experiment, Noise

CORRELATION_TIME = 0.14
"""Shortest correlation time seen between repeats of public records, in t*."""
LEAST = 0.25
"""Smallest scale: 0.0005 in R* at the maximum, where frames of public records scatter by 0.0003 to 0.004."""

_REACH = 2  # neighbours on either side
_CONSISTENT = 1.482602  # standard deviation over median absolute deviation of a Gaussian


def noise_of_traces(experiments: Sequence[Experiment], *, correlation_time: float = CORRELATION_TIME) -> Noise:
    """Noise of the published shape with a scale from the traces' roughness.

    The median over frames is taken, so the few frames at a collapse, where no cubic follows the curve, do not count; traces
    so coarse that half of the frames are like that come out too noisy, which costs power and makes no false gap.

    Args:
        experiments: the traces, dimensionless.
        correlation_time: assumed e-folding time of the noise, in t*; 0 for independent frames.

    Raises:
        InputDataError: if no trace has five frames.
    """
    unit = Noise(correlation_time=correlation_time)
    roughness = [_standardised(e.times, row, unit) for e in experiments for row in e.radius if len(e.times) > 2 * _REACH]
    if not roughness:
        raise InputDataError("No trace has five frames, so their noise cannot be estimated; give the noise.")
    scale = _CONSISTENT * float(torch.cat(roughness).abs().median())
    return Noise(scale=max(scale, LEAST), correlation_time=correlation_time)


def _standardised(times: Tensor, radius: Tensor, unit: Noise) -> Tensor:
    """Frames less the cubic through their neighbours, over what unit noise would make of that: ``n_t - 4`` tensor."""
    width = 2 * _REACH + 1
    t, r = times.unfold(0, width, 1), radius.unfold(0, width, 1)
    weights = _weights(t)
    sd = unit.sd(r, t)
    gap = (t[:, :, None] - t[:, None, :]).abs()
    correlation = torch.exp(-gap / unit.correlation_time) if unit.correlation_time else torch.eye(width).to(gap).expand_as(gap)
    scaled = weights * sd
    variance = torch.einsum("ni,nij,nj->n", scaled, correlation, scaled)
    return (weights * r).sum(1) / variance.sqrt()


def _weights(t: Tensor) -> Tensor:
    """Weights of the frames of each window: 1 for the centre, minus Lagrange's basis at its time for the neighbours."""
    weights = torch.ones_like(t)
    others = [i for i in range(t.shape[1]) if i != _REACH]
    for i in others:
        factors = [(t[:, _REACH] - t[:, j]) / (t[:, i] - t[:, j]) for j in others if j != i]
        weights[:, i] = -torch.stack(factors).prod(0)
    return weights
