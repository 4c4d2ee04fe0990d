"""The posterior without the frames next to collapses, which make local minima; searches begin with
it.

At a collapse R(t) has a cusp, so a frame next to it sees the same radius before the collapse and
after. A model whose collapse lies on the wrong side of such a frame has a local minimum there, a
hundredth of the prior's width from the right one and tens of nats above it. Without those frames it
has none. Searches mask them at first, and use all frames near a minimum.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.assimilate.posterior import Posterior
from imr_torch.observe import collapse_time


def without_collapses(posterior: Posterior) -> Posterior:
    """The posterior of all frames but those next to collapses."""
    batch = posterior.batch
    kept = tuple(e.at(away_from_collapses(e.times, e.mean)) for e in batch.experiments)
    return replace(posterior, batch=replace(batch, experiments=kept))


def away_from_collapses(
    times: Float[Tensor, "*#batch frames"], radius: Float[Tensor, "*#batch frames"]
) -> Bool[Tensor, "*#batch frames"]:
    """Frames that are neither a minimum nor next to one (the record may end at one).

    All, if those are less than half.
    """
    times = torch.cat((times, times[-1:] + 1.0))
    radius = torch.cat((radius, radius.amax(0, keepdim=True)))
    keep = torch.ones_like(times, dtype=torch.bool)
    number = 1
    while (at := collapse_time(times, radius, number)) < math.inf:
        frame = int(torch.nonzero(times == at))
        keep[max(1, frame - 1) : frame + 2] = False
        number += 1
    keep = keep[:-1]
    return keep if 2 * int(keep.sum()) >= len(keep) else torch.ones_like(keep)
