"""A blunt view of experiments, in which a search does not meet the false minima next to collapses.

At a collapse R(t) has a cusp, so a frame next to it sees the same radius before the collapse and after. A model whose collapse
lies on the wrong side of such a frame has a minimum of its own there, a hundredth of the prior's width from the right one
and tens of nats above it. Without those frames it has none.
"""

import math

import torch
from torch import Tensor

from imr_torch.observe import ExperimentBatch, collapse_time


class Blunt:
    """Experiments without the frames at collapses and next to them.

    Args:
        batch: all frames.

    Attributes:
        batch: the frames that are kept.
        of_use: whether any is left out.
    """

    def __init__(self, batch: ExperimentBatch) -> None:
        kept = [away_from_collapses(e.times, e.mean) for e in batch.experiments]
        self.batch = ExperimentBatch(tuple(e.at(k) for e, k in zip(batch.experiments, kept, strict=True)), batch.noise)
        self.of_use = not all(bool(k.all()) for k in kept)
        self._frames = torch.nn.utils.rnn.pad_sequence([torch.nonzero(k)[:, 0] for k in kept], batch_first=True)

    def seen(self, prediction: Tensor) -> Tensor:
        """Predictions ``... x E x T`` of all frames at those that are kept."""
        seen = prediction.gather(-1, self._frames.expand(*prediction.shape[:-1], -1))
        return torch.where(self.batch.mask, seen, 0.0)


def away_from_collapses(times: Tensor, radius: Tensor) -> Tensor:
    """Frames that are neither a minimum nor next to one (the record may end at one); all, if those are less than half."""
    times = torch.cat((times, times[-1:] + 1.0))
    radius = torch.cat((radius, radius.amax(0, keepdim=True)))
    keep, number = torch.ones_like(times, dtype=torch.bool), 1
    while (at := collapse_time(times, radius, number)) < math.inf:
        frame = int(torch.nonzero(times == at))
        keep[max(1, frame - 1) : frame + 2] = False
        number += 1
    keep = keep[:-1]
    return keep if 2 * int(keep.sum()) >= len(keep) else torch.ones_like(keep)
