"""Kalman filters, many side by side, that whiten curves under independent noise and a smooth
Gaussian process.

The process has a Matern-3/2 covariance, which is that of the first of two state variables
(Hartikainen & Sarkka, IEEE MLSP 2010), so a curve costs in proportion to its frames.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

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
    # in NumPy, whose small operations cost a quarter; laws side by side in memory; Any, since
    # pyright takes minutes to infer types of arrays that a loop computes from one another
    laws: Any = (x.movedim(0, -1).contiguous().numpy() for x in (smooth, rates, noise))
    variance, rate, independent = laws
    experiments, frames, count = independent.shape
    bent = variance * rate**2  # of the process's derivative
    value = np.zeros((len(columns), experiments, count))
    slope = np.zeros_like(value)
    p00 = variance
    p01 = 0.0
    p11 = bent
    seen = np.empty((frames, *value.shape))
    log_det = np.zeros((experiments, count))
    gaps = np.diff(times.numpy().T, axis=0, prepend=0.0)[..., None]
    for k, gap in enumerate(gaps):
        if k:
            x = rate * gap
            decay = np.exp(-x)
            a00 = decay * (1.0 + x)
            a01 = decay * gap
            a10 = -decay * rate * x
            a11 = decay * (1.0 - x)
            value, slope = a00 * value + a01 * slope, a10 * value + a11 * slope
            q00 = p00 - variance  # what the last frame told, carried on to this one
            q11 = p11 - bent
            p00, p01, p11 = (
                variance + a00 * a00 * q00 + 2.0 * a00 * a01 * p01 + a01 * a01 * q11,
                a00 * a10 * q00 + (a00 * a11 + a01 * a10) * p01 + a01 * a11 * q11,
                bent + a10 * a10 * q00 + 2.0 * a10 * a11 * p01 + a11 * a11 * q11,
            )
        used = mask[:, k, None].numpy()
        total = p00 + independent[:, k]
        innovation = columns[:, :, k, None].numpy() - value
        seen[k] = innovation * (used / np.sqrt(total))
        log_det += used * (0.5 * np.log(total))
        g0 = used * (p00 / total)
        g1 = used * (p01 / total)
        value += g0 * innovation
        slope += g1 * innovation
        p00, p01, p11 = p00 - g0 * p00, p01 - g0 * p01, p11 - g1 * p01
    return torch.from_numpy(seen.transpose(3, 1, 2, 0)), torch.from_numpy(log_det.T)
