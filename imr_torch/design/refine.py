"""Gauss-Newton refinement: from simulated gels to the gel of a model that explains a datum best,
for many data at once.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.design.likelihood import Data, Linear, infer
from imr_torch.design.response import Response, Shot, respond
from imr_torch.material import ModelBelief

_LONGEST_STEP = 4.0  # standard deviations of the belief
_SHORTER = 0.3  # of a step that did not raise the posterior density
_PER_DISTANCE = 20.0  # nats per square of a standard deviation of the belief
_START_BEHIND = 150.0  # nats below the floor at which not even a first step is made
_SHORTEST = 0.01  # shorter steps are not tried


def best_starts(
    data: Data, gels: Response, shot: Shot, *, not_own: bool = False
) -> tuple[Int[Tensor, "data"], Float[Tensor, "data"]]:
    """The gel to start a refinement of each datum from, and the evidence linearised there.

    It is the one of largest linearised evidence, less a penalty for the distance to the linearised
    optimum, which would have to be travelled. The distance alone chooses local minima: there the
    optimum is near whatever the misfit.

    Args:
        data: ``n`` data.
        gels: candidates.
        shot: how they are observed.
        not_own: whether row ``i`` of the data is of row ``i`` of the gels, which then is no
            candidate.
    """
    logs = []
    scores = []
    for k in range(len(gels)):
        linear = infer(data, gels[k : k + 1], shot.plan)
        score = linear.log_evidence - _PER_DISTANCE * (linear.mean - gels.controls[k]).square().sum(
            -1
        )
        if not_own:
            score[k] = -math.inf
        logs.append(linear.log_evidence)
        scores.append(score)
    chosen = torch.stack(scores).argmax(0)
    return chosen, torch.stack(logs).gather(0, chosen[None])[0]


def refine(
    data: Data,
    at: Response,
    shot: Shot,
    part: ModelBelief,
    iterations: int,
    *,
    close: float = 0.1,
    both_lengths: bool = True,
    floor: Float[Tensor, "data"] | None = None,
) -> Response:
    """Gauss-Newton steps towards the maximum of the posterior density of each datum.

    Args:
        data: ``n`` data.
        at: ``n`` gels to start from.
        shot: designs and how they are observed.
        part: the model.
        iterations: steps of each datum.
        close: distance of the linearised optimum, in posterior standard deviations, at which a
            datum is left alone.
        both_lengths: whether a shorter step is tried beside the whole one; if not, it is tried the
            next time, where the whole one failed.
        floor: data whose linearised evidence falls below this are not refined further; far below
            it, not at all.
    """
    length = torch.ones(len(data), 1, dtype=torch.float64)
    lengths = (1.0, _SHORTER) if both_lengths else (1.0,)
    for iteration in range(iterations):
        here = infer(data, at, shot.plan)
        step = here.mean - at.controls
        active = ((step[:, None] @ here.chol).norm(dim=-1)[:, 0] > close) & (
            length[:, 0] > _SHORTEST
        )
        if floor is not None:
            active &= here.log_evidence > (floor if iteration else floor - _START_BEHIND)
        moving = torch.nonzero(active)[:, 0]
        if len(moving) == 0:
            break
        step = (
            length
            * step
            * (_LONGEST_STEP / step.norm(dim=-1, keepdim=True).clamp_min(_LONGEST_STEP))
        )
        value = log_posterior(here, at)
        better = torch.zeros(len(data), dtype=torch.bool)
        tried = respond(
            shot, part, torch.cat([(at.controls + share * step)[moving] for share in lengths])
        )
        for i in range(len(lengths)):
            moved = tried[i * len(moving) : (i + 1) * len(moving)]
            rows = moving[moved.good]
            moved = moved[moved.good]
            there = log_posterior(infer(data[rows], moved, shot.plan), moved)
            gains = there > value[rows]
            at, value[rows[gains]] = at.replaced(rows[gains], moved[gains]), there[gains]
            better[rows[gains]] = True
        length = torch.where(better[:, None], 1.0, _SHORTER * lengths[-1] * length)
    return at


def log_posterior(linear: Linear, at: Response) -> Float[Tensor, "draws"]:
    """``n`` log densities of each datum and of its gel."""
    return linear.log_likelihood - 0.5 * at.controls.square().sum(-1)
