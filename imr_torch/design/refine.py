"""Gauss-Newton refinement: from simulated gels to the gel of a model that explains a datum best,
for many data at once.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from imr_torch.assimilate.options import CheckedOptions
from imr_torch.design.likelihood import Data, Linear, infer_linear
from imr_torch.design.response import Response, Shot, simulate_response
from imr_torch.material import ModelBelief
from imr_torch.types import DatasetValues, DrawnValues


@dataclass(frozen=True)
class RefinementOptions(CheckedOptions):
    """How far and how long a gel is refined.

    Args:
        close: distance from the linearised optimum, posterior standard deviations, at which
            evidence linearised there is as good as at the optimum.
        longest: most standard deviations of the belief in one step.
        shorter: factor on the next step where one did not raise the posterior density.
        shortest: factor below which no further one is tried.
        start_behind: nats below the floor at which not even a first step is made.

    >>> from imr_torch.design.refine import RefinementOptions
    >>> RefinementOptions().longest
    4.0
    """

    close: float = 0.5
    longest: float = 4.0
    shorter: float = 0.3
    shortest: float = 0.01
    start_behind: float = 150.0


def best_starts(
    data: Data, gels: Response, shot: Shot, *, per_distance: float = 20.0
) -> Int[Tensor, "data"]:
    """The gel to start a refinement of each datum from.

    It is the one of largest linearised evidence, less a penalty for the distance to the linearised
    optimum, which would have to be travelled. The distance alone chooses local minima: there the
    optimum is near whatever the misfit.

    Args:
        data: ``n`` data.
        gels: candidates.
        shot: how they are observed.
        per_distance: penalty, nats per square of a standard deviation of the belief.
    """
    scores = []
    for k in range(len(gels)):
        linear = infer_linear(data, gels[k : k + 1], shot.plan)
        distance = (linear.mean - gels.controls[k]).square().sum(-1)
        scores.append(linear.log_evidence - per_distance * distance)
    return torch.stack(scores).argmax(0)


def refine_gels(
    data: Data,
    at: Response,
    shot: Shot,
    part: ModelBelief,
    iterations: int,
    *,
    floor: DatasetValues | None = None,
    options: RefinementOptions | None = None,
) -> Response:
    """Gauss-Newton steps towards the maximum of the posterior density of each datum.

    Args:
        data: ``n`` data.
        at: ``n`` gels to start from.
        shot: designs and how they are observed.
        part: the model.
        iterations: steps of each datum; where one failed, the next is shorter.
        floor: data whose linearised evidence falls below this are not refined further; far below
            it, not at all.
        options: how far each goes.
    """
    options = options or RefinementOptions()
    length = torch.ones(len(data), 1, dtype=torch.float64)
    for iteration in range(iterations):
        here = infer_linear(data, at, shot.plan)
        step = here.mean - at.controls
        distance = (step[:, None] @ here.chol).norm(dim=-1)[:, 0]
        active = (distance > options.close) & (length[:, 0] > options.shortest)
        if floor is not None:
            active &= here.log_evidence > (floor if iteration else floor - options.start_behind)
        moving = torch.nonzero(active)[:, 0]
        if len(moving) == 0:
            break
        longest = step.norm(dim=-1, keepdim=True).clamp_min(options.longest)
        tried = (at.controls + length * step * (options.longest / longest))[moving]
        moved = simulate_response(shot, part, tried)
        rows = moving[moved.good]
        moved = moved[moved.good]
        there = infer_linear(data[rows], moved, shot.plan)
        gains = _log_posterior(there, moved) > _log_posterior(here, at)[rows]
        at = at.replace_rows(rows[gains], moved[gains])
        length *= options.shorter
        length[rows[gains]] = 1.0
    return at


def _log_posterior(linear: Linear, at: Response) -> DrawnValues:
    """``n`` log densities of each datum and of its gel."""
    return linear.log_likelihood - 0.5 * at.controls.square().sum(-1)
