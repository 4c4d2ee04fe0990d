"""Kalman filters, many side by side, that whiten curves under independent noise and a smooth
Gaussian process.

The process has a Matern-3/2 covariance, which is that of the first of two state variables
(Hartikainen & Sarkka, IEEE MLSP 2010), so a curve costs in proportion to its frames.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.types import ExperimentFrames, FrameMask, LawValues

MATERN = 2.146193
"""Rate of a Matern-3/2 covariance times the lag at which it has fallen to 1/e."""


def matern_whitened(
    times: ExperimentFrames,
    mask: FrameMask,
    noise: Float[Tensor, "laws experiments frames"],
    smooth: LawValues,
    rates: LawValues,
    columns: Float[Tensor, "columns experiments frames"],
) -> tuple[
    Float[Tensor, "laws columns experiments frames"], Float[Tensor, "laws experiments"]
]:
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
    shape = noise.shape
    seen = np.empty((shape[0], shape[1], len(columns), shape[2]))
    log_det = np.empty(shape[:2])
    given = (times, mask, noise, smooth, rates, columns.movedim(0, 1))
    _compile_filter()(*(x.contiguous().numpy() for x in given), seen, log_det)
    return torch.from_numpy(seen).transpose(1, 2), torch.from_numpy(log_det)


@cache
def _compile_filter() -> Callable[..., None]:
    from numba import njit  # half a second, not to be waited for where no curve is whitened

    try:
        return njit(cache=True, nogil=True)(_filter_curves)
    except RuntimeError:  # no folder that can be written
        return njit(nogil=True)(_filter_curves)


def _filter_curves(
    times: Any,
    mask: Any,
    noise: Any,
    smooth: Any,
    rates: Any,
    columns: Any,
    seen: Any,
    log_det: Any,
) -> None:
    """Fill ``seen`` (laws x experiments x columns x frames) and ``log_det`` (laws x experiments)."""
    count = columns.shape[1]
    for law in range(noise.shape[0]):
        variance, rate = smooth[law], rates[law]
        bent = variance * rate**2  # of the process's derivative
        for curve in range(noise.shape[1]):
            # value and derivative, as the frames before predict them
            state = np.zeros((count, 2))
            p00, p01, p11 = variance, 0.0, bent
            total_log = 0.0
            for frame in range(noise.shape[2]):
                if frame:
                    gap = times[curve, frame] - times[curve, frame - 1]
                    x = rate * gap
                    decay = math.exp(-x)
                    a00, a01 = decay * (1.0 + x), decay * gap
                    a10, a11 = -decay * rate * x, decay * (1.0 - x)
                    for column in range(count):
                        value, slope = state[column]
                        state[column, 0] = a00 * value + a01 * slope
                        state[column, 1] = a10 * value + a11 * slope
                    q00 = p00 - variance  # what the last frame told, carried on to this one
                    q11 = p11 - bent
                    p00, p01, p11 = (
                        variance
                        + a00 * a00 * q00
                        + 2.0 * a00 * a01 * p01
                        + a01 * a01 * q11,
                        a00 * a10 * q00 + (a00 * a11 + a01 * a10) * p01 + a01 * a11 * q11,
                        bent + a10 * a10 * q00 + 2.0 * a10 * a11 * p01 + a11 * a11 * q11,
                    )
                if not mask[curve, frame]:
                    seen[law, curve, :, frame] = 0.0
                    continue
                total = p00 + noise[law, curve, frame]
                g0, g1 = p00 / total, p01 / total
                total_log += 0.5 * math.log(total)
                for column in range(count):
                    innovation = columns[curve, column, frame] - state[column, 0]
                    seen[law, curve, column, frame] = innovation / math.sqrt(total)
                    state[column, 0] += g0 * innovation
                    state[column, 1] += g1 * innovation
                p00, p01, p11 = p00 - g0 * p00, p01 - g0 * p01, p11 - g1 * p01
            log_det[law, curve] = total_log
