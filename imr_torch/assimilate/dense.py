"""Fitted curves at so many times that a collapse is drawn round, and not as a kink between two
frames.
"""

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from imr_torch.assimilate.fit import ModelFit
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator

Vector = NDArray[np.float64]

_UNIFORM = 200  # points of a drawn curve that lie evenly in time
_ALONG = (200, 200)  # those added evenly along the curve found so far, which a collapse needs


def dense_curve(
    fit: ModelFit, batch: ExperimentBatch, simulator: Simulator
) -> tuple[Float[Tensor, "experiments points"], Float[Tensor, "experiments points"]]:
    """The fitted curve at so many times that a collapse is drawn round: two ``E x D`` tensors, t*
    and R/Rmax.

    Args:
        fit: the fit.
        batch: its data.
        simulator: makes the bubbles.
    """
    last = torch.where(batch.mask, batch.times, 0.0).amax(1, keepdim=True)
    first = batch.times[:, :1].clamp_max(0.0)
    times = first + (last - first) * torch.linspace(0.0, 1.0, _UNIFORM, dtype=torch.float64)
    parameters = fit.parameters(fit.mean)
    shifts = fit.nuisances * batch.nuisance_sds
    for added in _ALONG:
        curve = predict(simulator, parameters, batch, shifts, times=times)
        more = [_along(t, r, added) for t, r in zip(times.numpy(), curve.numpy(), strict=True)]
        times = torch.cat((times, torch.from_numpy(np.stack(more))), 1).sort(1).values
        times = times + 1e-9 * torch.arange(times.shape[1])  # strictly increasing
    return times, predict(simulator, parameters, batch, shifts, times=times)


def _along(times: Vector, curve: Vector, count: int) -> Vector:
    """Times of points evenly along the polygon of a curve, in a frame as wide as the record and as
    high as Rmax.
    """
    steps = np.hypot(np.diff(times) / np.ptp(times), np.nan_to_num(np.diff(curve)))
    length = np.concatenate(([0.0], steps.cumsum()))
    return np.interp(np.linspace(0.0, length[-1], count + 2)[1:-1], length, times)
