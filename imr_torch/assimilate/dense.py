"""Fitted curves at so many times that a collapse is drawn round, and not as a kink between two
frames.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.fit import ModelFit
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator

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
        times = torch.cat((times, _along(times, curve, added)), 1).sort(1).values
        times = times + 1e-9 * torch.arange(
            times.shape[1], dtype=torch.float64
        )  # strictly increasing
    return times, predict(simulator, parameters, batch, shifts, times=times)


def _along(times: Tensor, curve: Tensor, count: int) -> Tensor:
    """Times of points evenly along the polygon of a curve, in a frame as wide as the record and as
    high as Rmax.
    """
    length = torch.hypot(
        times.diff(dim=1) / (times[:, -1:] - times[:, :1]), curve.diff(dim=1).nan_to_num()
    ).cumsum(1)
    length = torch.nn.functional.pad(length, (1, 0))
    wanted = length[:, -1:] * torch.linspace(0.0, 1.0, count + 2, dtype=torch.float64)[1:-1]
    right = torch.searchsorted(length, wanted.contiguous()).clamp(1, times.shape[1] - 1)
    low = length.gather(1, right - 1)
    high = length.gather(1, right)
    weight = ((wanted - low) / (high - low).clamp_min(1e-300)).clamp(0.0, 1.0)
    return times.gather(1, right - 1) * (1.0 - weight) + times.gather(1, right) * weight
