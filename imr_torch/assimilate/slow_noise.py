"""Evidence for smooth deviations from a model: noise of the camera that lasts several frames, or an
unknown effect.

Noise differs from shot to shot; an effect of the gel, of the contents or of the set-up moves all
shots alike at the same phase of their first cycle. Both are Gaussian processes with Matern-3/2
covariance beside the noise of single frames, the first independent between shots, the second common
to them, in part or whole. Of a single shot they are the same.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from imr_torch.assimilate.matern import MATERN
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.float64 import tensor
from imr_torch.observe import collapse_time


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
