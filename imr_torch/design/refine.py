"""Gauss-Newton refinement: from simulated gels to the gel of a model that explains a datum best,
for many data at once.
"""

import torch
from jaxtyping import Int
from torch import Tensor

from imr_torch.design.likelihood import Data, Linear, infer
from imr_torch.design.response import Response, Shot, respond
from imr_torch.material import ModelBelief
from imr_torch.types import DatasetValues, DrawnValues

_CLOSE = (
    0.5  # posterior standard deviations: evidence linearised there is as good as at the optimum
)
_LONGEST_STEP = 4.0  # standard deviations of the belief
_SHORTER = 0.3  # of a step that did not raise the posterior density
_PER_DISTANCE = 20.0  # nats per square of a standard deviation of the belief
_START_BEHIND = 150.0  # nats below the floor at which not even a first step is made
_SHORTEST = 0.01  # shorter steps are not tried


def best_starts(data: Data, gels: Response, shot: Shot) -> Int[Tensor, "data"]:
    """The gel to start a refinement of each datum from.

    It is the one of largest linearised evidence, less a penalty for the distance to the linearised
    optimum, which would have to be travelled. The distance alone chooses local minima: there the
    optimum is near whatever the misfit.

    Args:
        data: ``n`` data.
        gels: candidates.
        shot: how they are observed.
    """
    scores = []
    for k in range(len(gels)):
        linear = infer(data, gels[k : k + 1], shot.plan)
        distance = (linear.mean - gels.controls[k]).square().sum(-1)
        scores.append(linear.log_evidence - _PER_DISTANCE * distance)
    return torch.stack(scores).argmax(0)


def refine(
    data: Data,
    at: Response,
    shot: Shot,
    part: ModelBelief,
    iterations: int,
    *,
    floor: DatasetValues | None = None,
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
    """
    length = torch.ones(len(data), 1, dtype=torch.float64)
    for iteration in range(iterations):
        here = infer(data, at, shot.plan)
        step = here.mean - at.controls
        distance = (step[:, None] @ here.chol).norm(dim=-1)[:, 0]
        active = (distance > _CLOSE) & (length[:, 0] > _SHORTEST)
        if floor is not None:
            active &= here.log_evidence > (floor if iteration else floor - _START_BEHIND)
        moving = torch.nonzero(active)[:, 0]
        if len(moving) == 0:
            break
        longest = step.norm(dim=-1, keepdim=True).clamp_min(_LONGEST_STEP)
        tried = (at.controls + length * step * (_LONGEST_STEP / longest))[moving]
        moved = respond(shot, part, tried)
        rows = moving[moved.good]
        moved = moved[moved.good]
        there = infer(data[rows], moved, shot.plan)
        gains = _log_posterior(there, moved) > _log_posterior(here, at)[rows]
        at = at.replaced(rows[gains], moved[gains])
        length *= _SHORTER
        length[rows[gains]] = 1.0
    return at


def _log_posterior(linear: Linear, at: Response) -> DrawnValues:
    """``n`` log densities of each datum and of its gel."""
    return linear.log_likelihood - 0.5 * at.controls.square().sum(-1)
