"""Observation noise of single measured curves, estimated from their frame-to-frame roughness.

A frame is compared with the cubic through its two neighbours on either side, which removes what a smooth curve does between
frames and keeps what the camera adds. Two amounts are taken from that: a constant part (pixels), which rules where the bubble
is large and slow, and a multiple of the published law (light, shape, clock), which rules elsewhere; a camera need not have
them in the published proportion, and noise that is too small anywhere makes a false gap. Roughness shows only the part of the
noise that changes from frame to frame; repeats of public records differ by deviations that last 0.14 to 0.4 in t*. So the
noise is taken as correlated, with the amounts at which it would look as rough as the traces do, and with no less than repeats
of public records differ by, which no roughness shows where a camera's records are smooth. Where frames are too few, it
is no less than the published law.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.observe.experiments import Experiment
from imr_torch.observe.noise import Noise

CORRELATION_TIME = 0.14
"""Shortest correlation time seen between repeats of public records, in t*."""
LEAST = 0.25
"""Smallest multiple of the published law: repeats of public records differ by 0.2 to 0.9 of it late, and by more early."""
LEAST_CONSTANT = 0.002
"""Smallest constant part, in R*: repeats differ by 1 to 10 times the published noise early, where this is what it is."""

SD_OVER_MAD = 1.482602
"""Standard deviation of a Gaussian over its median absolute deviation."""

FEW = 40
"""Frames with neighbours on both sides, of all traces, below which two amounts read off them may be several times too small."""

_REACH = 2  # neighbours on either side
_GROUPS = 4  # of frames, by how much of their noise is of the published law; the two amounts must suit all
_TRIED = 80  # values of each amount
_MOST = 32.0  # times the least of each


def noise_of_traces(experiments: Sequence[Experiment], *, correlation_time: float = CORRELATION_TIME) -> Noise:
    """Noise of a constant part and a multiple of the published law, from the traces' roughness, neither below its least.

    Medians over frames are taken, so the few frames at a collapse, where no cubic follows the curve, do not count; traces
    so coarse that half of the frames are like that come out too noisy, which costs power and makes no false gap.

    Args:
        experiments: the traces, dimensionless.
        correlation_time: assumed e-folding time of the noise, in t*; 0 for independent frames.

    Raises:
        InputDataError: if no trace has five frames.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.observe import noise_of_traces
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=1)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> noise = noise_of_traces([shot])
    >>> noise.correlation_time, noise.scale > 0.25
    (0.14, True)
    """
    unit = Noise(correlation_time=correlation_time)
    seen = [(e.times[frames], row[frames]) for e in experiments for row in e.radius if len(frames := _frames(row)) > 2 * _REACH]
    rows = [_roughness(times, radius, unit) for times, radius in seen]
    if not rows:
        raise InputDataError("No trace has five frames, so their noise cannot be estimated; give the noise.")
    rough, constant, law = (torch.cat(parts) for parts in zip(*rows, strict=True))
    steps = torch.logspace(0.0, 1.0, _TRIED, base=_MOST, dtype=torch.float64)
    least = LEAST if len(rough) >= FEW else 1.0
    scales, constants = least * steps, LEAST_CONSTANT * steps
    misfit = torch.zeros(_TRIED, _TRIED, dtype=torch.float64)
    for group in torch.argsort(law / constant).chunk(_GROUPS):
        for i, scale in enumerate(scales.tolist()):
            variance = scale**2 * law[group] + constants[:, None].square() * constant[group]
            spread = SD_OVER_MAD * (rough[group].abs() / variance.sqrt()).median(-1).values
            misfit[i] += len(group) * spread.clamp_min(1e-9).log().square()
    misfit[constants < unit.floor * scales[:, None]] = torch.inf  # never less of it than in the published proportion
    row, column = divmod(int(misfit.argmin()), _TRIED)
    return replace(unit, scale=float(scales[row]), floor=float(constants[column] / scales[row]))


def _frames(radius: Tensor) -> Tensor:
    """Indices of the frames that a repeat has."""
    return torch.nonzero(torch.isfinite(radius))[:, 0]


def _roughness(times: Tensor, radius: Tensor, unit: Noise) -> tuple[Tensor, Tensor, Tensor]:
    """Frames less the cubic through their neighbours, and its variance by either part of the noise: ``n_t - 4`` tensors."""
    width = 2 * _REACH + 1
    t, r = times.unfold(0, width, 1), radius.unfold(0, width, 1)
    weights = _weights(t)
    gap = (t[:, :, None] - t[:, None, :]).abs()
    correlation = torch.exp(-gap / unit.correlation_time) if unit.correlation_time else torch.eye(width).to(gap).expand_as(gap)
    law = (unit.sd(r, t).square() - unit.floor**2).clamp_min(0.0).sqrt()
    parts = (weights * sd for sd in (torch.ones_like(r), law))
    constant, growing = (torch.einsum("ni,nij,nj->n", part, correlation, part) for part in parts)
    return (weights * r).sum(1), constant, growing


def _weights(t: Tensor) -> Tensor:
    """Weights of the frames of each window: 1 for the centre, minus Lagrange's basis at its time for the neighbours."""
    weights = torch.ones_like(t)
    others = [i for i in range(t.shape[1]) if i != _REACH]
    for i in others:
        factors = [(t[:, _REACH] - t[:, j]) / (t[:, i] - t[:, j]) for j in others if j != i]
        weights[:, i] = -torch.stack(factors).prod(0)
    return weights
