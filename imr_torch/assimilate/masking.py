"""The posterior without the frames next to collapses, which make local minima; searches begin with
it.

At a collapse R(t) has a cusp, so a frame next to it sees the same radius before the collapse and
after. A model whose collapse lies on the wrong side of such a frame has a local minimum there, a
hundredth of the prior's width from the right one and tens of nats above it. Without those frames it
has none. Searches mask them at first, and use all frames near a minimum.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from imr_torch.assimilate.posterior import Neighbourhood, Posterior
from imr_torch.observe import collapse_time


@dataclass(frozen=True)
class Masked:
    """A posterior at the frames that are not next to a collapse.

    Args:
        posterior: of these frames.
        frames: which of all frames they are.
        useful: whether any frame is left out.
    """

    posterior: Posterior
    frames: Int[Tensor, "experiments kept"]
    useful: bool

    @classmethod
    def of(cls, posterior: Posterior) -> "Masked":
        """The posterior of all frames, without those next to collapses."""
        batch = posterior.batch
        kept = [away_from_collapses(e.times, e.mean) for e in batch.experiments]
        fewer = replace(
            batch, experiments=tuple(e.at(k) for e, k in zip(batch.experiments, kept, strict=True))
        )
        frames = torch.nn.utils.rnn.pad_sequence(
            [torch.nonzero(k)[:, 0] for k in kept], batch_first=True
        )
        return cls(replace(posterior, batch=fewer), frames, not all(bool(k.all()) for k in kept))

    def seen(
        self, prediction: Float[Tensor, "*batch experiments frames"]
    ) -> Float[Tensor, "*batch experiments kept"]:
        """Predictions ``batch_shape x E x T`` of all frames at those that are kept."""
        kept = prediction.gather(-1, self.frames.expand(*prediction.shape[:-1], -1))
        return torch.where(self.posterior.batch.mask, kept, 0.0)

    def neighbourhood(self, whole: Neighbourhood) -> Neighbourhood:
        """Simulated neighbours of the posterior of all frames, reduced to the frames that are kept."""
        return replace(whole, posterior=self.posterior, prediction=self.seen(whole.prediction))


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
