"""Frames and their neighbours: how much a curve bends between them, and single frames that an error
of the camera has spoilt.

A frame is compared with the cubic through its two neighbours on either side, which takes out what a
smooth curve does between frames.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.observe import Experiment, ExperimentBatch


def bends(batch: ExperimentBatch, radius: Tensor) -> Tensor:
    """How far a frame lies off the cubic through two neighbours on either side, the largest of
    three frames: ``E x T``.
    """
    largest = torch.zeros_like(radius)
    for row, (times, curve, mask) in enumerate(
        zip(batch.times, radius, batch.mask, strict=True)
    ):
        count = int(mask.sum())
        if count < 5:
            continue
        t = times[:count].unfold(0, 5, 1)
        r = curve[:count].unfold(0, 5, 1)
        off = (lagrange_weights(t) * r).sum(1).abs()
        padded = torch.cat((off[:1].expand(3), off, off[-1:].expand(3)))
        largest[row, :count] = padded.unfold(0, 3, 1).amax(1)
    return largest


def lagrange_weights(times: Float[Tensor, "windows 5"]) -> Float[Tensor, "windows 5"]:
    """Weights of the frames of each window: 1 for the centre, minus Lagrange's basis at its time
    for the neighbours.
    """
    others = times[:, [0, 1, 3, 4]]
    ratios = (times[:, 2, None, None] - others[:, None]) / (
        others[:, :, None] - others[:, None]
    )
    ratios.diagonal(dim1=1, dim2=2).fill_(1.0)
    left, right = (-ratios.prod(2)).split(2, 1)
    return torch.cat((left, torch.ones_like(times[:, :1]), right), 1)


def without_spoilt_frames(
    near: Neighbourhood,
    *,
    spike: float = 6.5 * 1.482602,
    around: int = 15,
    most: float = 0.05,
    fewest: int = 12,
) -> ExperimentBatch:
    """The batch of a fitted point without frames that single errors of the camera have spoilt; the
    same where there are none, and where designs are repeated, which says what is usual.

    A frame is left out where the residual stands off the cubic through its neighbours by more than
    6.5 standard deviations of what is usual (in R* about that time, and over the law of the batch
    in the whole curve), by more than the fitted curve bends there, and farther than any other
    frame; then the next one is looked for.

    Args:
        near: a fitted point.
        spike: times the median distance of a frame from its neighbours, beyond which it is spoilt:
            6.5 standard deviations of a Gaussian.
        around: frames on either side that say what is usual.
        most: share of the frames of a curve that may be spoilt.
        fewest: frames that a curve needs to be asked.
    """
    batch = near.posterior.batch
    if any(e.repeats > 1 for e in batch.curves):
        return batch
    # a spoilt frame is a bend too
    law = replace(batch, noise=replace(batch.noise, jitter=0.0)).sd(near.centre)
    bent = bends(batch, near.centre)
    kept = batch.mask.clone()
    for row in range(len(kept)):
        for _ in range(max(1, int(most * float(batch.mask[row].sum())))):
            frames = torch.nonzero(kept[row])[:, 0]
            if len(frames) < fewest:
                break
            residual = (batch.mean - near.centre)[row, frames].unfold(0, 5, 1)
            weights = lagrange_weights(batch.times[row, frames].unfold(0, 5, 1))
            off = (weights * residual).sum(1).abs()
            over_law = off / (weights * law[row, frames].unfold(0, 5, 1)).norm(dim=1)
            own = torch.minimum(
                off / _running_median(off, around),
                over_law / over_law.median().clamp_min(1e-300),
            )
            own = torch.where(off > bent[row, frames][2:-2], own, 0.0)
            worst = int(own.argmax())
            if float(own[worst]) < spike:
                break
            kept[row, frames[worst + 2]] = False
    if (kept == batch.mask).all():
        return batch
    rows = zip(batch.experiments, kept, strict=True)
    return replace(batch, experiments=tuple(e.at(row[: len(e.times)]) for e, row in rows))


def frames_left_out(
    before: Sequence[Experiment], after: Sequence[Experiment]
) -> dict[str, list[int]]:
    """Label of a curve -> numbers of the frames that it has lost, from 0; of curves that lost some."""
    lost = {
        old.label: torch.nonzero(~torch.isin(old.times, new.times))[:, 0].tolist()
        for old, new in zip(before, after, strict=True)
    }
    return {label: frames for label, frames in lost.items() if frames}


def _running_median(values: Tensor, around: int) -> Tensor:
    """Median of ``around`` values on either side, as many as there are, without those that a spike
    at the value itself moves; never zero.
    """
    padded = torch.nn.functional.pad(values, (around, around), value=math.nan)
    windows = padded.unfold(0, 2 * around + 1, 1).clone()
    windows[:, around - 2 : around + 3] = math.nan
    return windows.nanmedian(1).values.clamp_min(1e-300)
