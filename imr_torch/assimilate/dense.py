"""Fitted curves at so many times that a collapse is drawn round, and not as a kink between two
frames.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.fit import ModelFit
from imr_torch.float64 import linspace
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator


def dense_curve(
    fit: ModelFit,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    points: int = 600,
) -> tuple[Float[Tensor, "experiments points"], Float[Tensor, "experiments points"]]:
    """The fitted curve at so many times that a collapse is drawn round: two ``E x D`` tensors, t*
    and R/Rmax.

    Args:
        fit: the fit.
        batch: its data.
        simulator: makes the bubbles.
        points: ``D``, evenly along the polygon of the curve in a frame as wide as the record and as
            high as Rmax; 600 leave no corner at the size of a page.
    """
    last = torch.where(batch.mask, batch.times, 0.0).amax(1, keepdim=True)
    first = batch.times[:, :1].clamp_max(0.0)
    # of eight times as many, evenly in time: of a record of four collapse times one each .001 t*
    share = linspace(0.0, 1.0, 8 * points)
    times = first + (last - first) * share
    shifts = fit.nuisances * batch.nuisance_sds
    curve = predict(simulator, fit.parameters(fit.mean), batch, shifts, times=times)
    rises = curve.nan_to_num().diff(dim=1)
    length = torch.nn.functional.pad(torch.hypot(rises, share.diff()).cumsum(1), (1, 0))
    wanted = length[:, -1:] * linspace(0.0, 1.0, points)
    chosen = torch.searchsorted(length, wanted).clamp_max(len(share) - 1)
    # strictly increasing also where a collapse takes less than one of the times computed
    apart = 1e-9 * torch.arange(points)
    return times.gather(1, chosen) + apart, curve.gather(1, chosen)
