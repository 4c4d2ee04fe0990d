"""Evidence for smooth deviations from a model: noise of the camera that lasts several frames, or an
unknown effect.

Noise differs from shot to shot; an effect of the gel, of the contents or of the set-up moves all
shots alike at the same phase of their first cycle. Both are Gaussian processes with Matern-3/2
covariance beside the noise of single frames, the first independent between shots, the second common
to them, in part or whole. Of a single shot they are the same.

Kalman filters, many side by side, that whiten curves under independent noise and a smooth
Gaussian process.

The process has a Matern-3/2 covariance, which is that of the first of two state variables
(Hartikainen & Sarkka, IEEE MLSP 2010), so a curve costs in proportion to its frames.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import MultivariateNormal

from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.float64 import tensor, zeros
from imr_torch.observe import collapse_time
from imr_torch.types import ExperimentFrames, FrameMask

MATERN = 2.146193
"""Rate of a Matern-3/2 covariance times the lag at which it has fallen to 1/e."""


def matern_whitened(
    times: ExperimentFrames,
    mask: FrameMask,
    noise: Float[Tensor, "laws experiments frames"],
    smooth: Float[Tensor, "laws"],
    rates: Float[Tensor, "laws"],
    columns: Float[Tensor, "columns experiments frames"],
) -> tuple[Float[Tensor, "laws columns experiments frames"], Float[Tensor, "laws experiments"]]:
    """Columns whitened under independent noise and a smooth Gaussian process, by Kalman filters
    side by side.

    Args:
        times: dimensionless, increasing.
        mask: frames that count.
        noise: variance of the independent noise.
        smooth: variance of the process, whose covariance is ``(1 + x) exp(-x)`` of it, ``x`` the
            rate times the lag.
        rates: of the process.
        columns: what is whitened.

    Returns:
        The whitened columns, 0 where the mask is not set, and half the log determinants of the
        covariances.
    """
    count, experiments, frames = noise.shape
    variance, rate = (x[:, None].expand(count, experiments) for x in (smooth, rates))
    bent = variance * rate.square()  # of the process's derivative
    value = zeros(count, len(columns), experiments)
    slope = torch.zeros_like(value)
    p00 = variance
    p01 = torch.zeros_like(variance)
    p11 = bent
    seen = zeros(count, len(columns), experiments, frames)
    log_det = torch.zeros_like(variance)
    gaps = torch.nn.functional.pad(times.diff(dim=1), (1, 0))
    for k in range(frames):
        if k:
            x = rate * gaps[:, k]
            decay = torch.exp(-x)
            a00 = decay * (1.0 + x)
            a01 = decay * gaps[:, k]
            a10 = -decay * rate * x
            a11 = decay * (1.0 - x)
            value, slope = (
                a00[:, None] * value + a01[:, None] * slope,
                a10[:, None] * value + a11[:, None] * slope,
            )
            q00, q11 = (
                p00 - variance,
                p11 - bent,
            )  # what the last frame told, carried on to this one
            p00, p01, p11 = (
                variance + a00 * a00 * q00 + 2.0 * a00 * a01 * p01 + a01 * a01 * q11,
                a00 * a10 * q00 + (a00 * a11 + a01 * a10) * p01 + a01 * a11 * q11,
                bent + a10 * a10 * q00 + 2.0 * a10 * a11 * p01 + a11 * a11 * q11,
            )
        used = mask[:, k]
        total = p00 + noise[:, :, k]
        innovation = columns[None, :, :, k] - value
        seen[..., k] = torch.where(used, innovation * total.rsqrt()[:, None], 0.0)
        log_det = log_det + torch.where(used, 0.5 * total.log(), 0.0)
        g0 = torch.where(used, p00 / total, 0.0)
        g1 = torch.where(used, p01 / total, 0.0)
        value = value + g0[:, None] * innovation
        slope = slope + g1[:, None] * innovation
        p00, p01, p11 = p00 - g0 * p00, p01 - g0 * p01, p11 - g1 * p01
    return seen, log_det


@dataclass(frozen=True)
class SmoothDeviations:
    """Log evidence, nats, over no smooth deviation, gel and nuisances integrated out.

    Args:
        own: of deviations that each shot has for itself, as noise of the camera that lasts several
            frames.
        common: of deviations that are alike in all shots, as an effect that the model lacks.
    """

    own: float
    common: float


def smooth_deviations(
    near: Neighbourhood,
    *,
    amounts: Sequence[float] = (0.001, 0.002, 0.004, 0.008, 0.016),
    durations: Sequence[float] = (0.14, 0.24, 0.4),
    shares: Sequence[float] = (0.5, 0.9),
    most_frames: int = 900,
) -> SmoothDeviations:
    """Evidence for smooth deviations about a fit, to first order.

    Args:
        near: a fitted point with its local sensitivities; the noise of its batch is that of single
            frames.
        amounts: standard deviations of a deviation in R*, equally probable.
        durations: lags in t* at which its correlation has fallen to 1/e, equally probable; repeats
            of public records differ by deviations that last .14 to .4.
        shares: of its variance that is common to all shots, equally probable, where it is.
        most_frames: frames in all; of more, every second, third, ... is used. Time grows with their
            cube.
    """
    batch = near.posterior.batch
    used = batch.mask & (
        torch.arange(batch.mask.shape[1]) % -(-int(batch.mask.sum()) // most_frames) == 0
    )
    shot = torch.arange(len(used))[:, None].expand_as(used)[used]
    times = batch.times[used]
    phases = _cycle_phases(near)[used]
    noise = (batch.sd(near.centre).square() / batch.counts)[used]
    columns = near.jacobian[:, used].mT
    observed = (batch.mean - near.centre)[used] + columns @ near.coordinates
    explained = columns @ columns.mT + torch.diag(noise)  # by gel and nuisances, and single frames
    same = (shot[:, None] == shot).to(noise)

    def evidence_of(amount: float, duration: float, share: float) -> Tensor:
        lags = (MATERN * ((x[:, None] - x).abs() / duration) for x in (times, phases))
        own, common = ((1.0 + lag) * torch.exp(-lag) for lag in lags)
        smooth = amount**2 * ((1.0 - share) * same * own + share * common)
        mean = torch.zeros_like(observed)
        law = MultivariateNormal(mean, explained + smooth, validate_args=False)
        return law.log_prob(observed)

    none = evidence_of(0.0, 1.0, 0.0)

    def mean_evidence(shares: Sequence[float]) -> float:
        values = torch.stack(
            [evidence_of(*values) for values in product(amounts, durations, shares)]
        )
        return float(values.logsumexp(0) - math.log(len(values)) - none)

    return SmoothDeviations(mean_evidence((0.0,)), mean_evidence(shares))


def _cycle_phases(near: Neighbourhood) -> Tensor:
    """Times by the length of the first cycle, over its mean in all shots: ``E x T``; times where a
    shot has no collapse.
    """
    batch = near.posterior.batch
    rows = zip(batch.times, near.centre, batch.mask, strict=True)
    ends = [collapse_time(t[m], r[m], 1) for t, r, m in rows]
    if not all(math.isfinite(end) for end in ends):
        return batch.times
    lengths = tensor(ends)
    return batch.times * (lengths.mean() / lengths)[:, None]
