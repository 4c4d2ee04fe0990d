"""Phases of a bubble's life, and those in which the residuals show less noise than the noise law
says.

A published law of the noise may say several times too much in one phase, late in the tail of a
viscous bubble above all. Where squared residuals less that noise are summed over all phases, such a
phase cancels a misfit elsewhere. So noise counts, in each phase, as no more than the residuals
leave room for.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from scipy.interpolate import make_interp_spline
from scipy.special import chdtri
from torch import Tensor

from imr_torch.float64 import tensor
from imr_torch.observe import collapse_time
from imr_torch.observe.plausibility import RAYLEIGH_TIME
from imr_torch.types import ExperimentFrames, FrameMask

PHASES = ("start", "first collapse", "first rebound", "second collapse", "later")
"""Phases of an event, in order."""

PHASE_ENDS = (0.3, 1.25, 1.75, 2.25)
"""Reading of the phase clock at which each but the last ends: what a collapse did is seen in the
rise after it."""


def phase_clock(
    times: ExperimentFrames,
    prediction: ExperimentFrames,
    mask: FrameMask,
) -> ExperimentFrames:
    """How far the event has come at each frame: 0 at the start, 1 at the first collapse, 1.5 at the
    rebound's top, 2 ...

    Args:
        times: ``E x T`` tensor, dimensionless.
        prediction: ``E x T`` tensor, R/Rmax of the fitted model, whose landmarks are used.
        mask: ``E x T`` boolean tensor, frames that exist.

    Returns:
        ``E x T`` tensor; linear in time between landmarks and, after the second collapse, by the
        length of the first cycle.
    """
    return torch.stack(
        [_read_clock(t, r, m) for t, r, m in zip(times, prediction, mask, strict=True)]
    )


def _read_clock(times: Tensor, radius: Tensor, mask: Tensor) -> Tensor:
    t = times[mask]
    r = radius[mask]
    first, second = (collapse_time(t, r, number) for number in (1, 2))
    first = RAYLEIGH_TIME if math.isinf(first) else first
    later = (t > first) & (t < second)
    top = float(t[later][r[later].argmax()]) if later.any() else 2.0 * first
    second = 2.0 * top - first if math.isinf(second) else second
    knots = (0.0, first, top, second, second + (second - first))
    # extrapolates the last piece
    clock = make_interp_spline(knots, (0.0, 1.0, 1.5, 2.0, 3.0), k=1)
    return torch.from_numpy(clock(times.numpy()))


def phase_name(clock: float) -> str:
    """The phase at a reading of the phase clock."""
    return PHASES[sum(clock > end + 1e-9 for end in PHASE_ENDS)]


def phase_numbers(
    times: ExperimentFrames,
    radius: ExperimentFrames,
    mask: FrameMask,
) -> Int[Tensor, "experiments frames"]:
    """Number of the phase of each frame in ``PHASES``: ``E x T`` integer tensor; arguments as of
    :func:`phase_clock`.
    """
    ends = tensor(PHASE_ENDS) + 1e-9
    return torch.searchsorted(ends, phase_clock(times, radius, mask).contiguous())


def noise_shares(
    squares: Sequence[Float[Tensor, "*frames"]],
    phase: Int[Tensor, "*frames"],
    *,
    quiet: float = 1e-3,
) -> Float[Tensor, "*frames"]:
    """How much of the law's variance counts in each frame, 1 or less: what residuals leave room for
    in its phase.

    It is less than 1 only where the sum of squares of a phase has a chance below ``quiet`` under
    the law, under the hypothesis that leaves least there; it is then the mean square.

    Args:
        squares: of each hypothesis, squared residuals in units of the law's variance, independent
            between frames; tensors of one shape.
        phase: of each frame, same shape; frames of number -1 do not count.
        quiet: chance of so small a sum of squares under the law, below which it says too much.

    Returns:
        Tensor of that shape.

    >>> import torch
    >>> from imr_torch.goodness.phases import noise_shares
    >>> phase = torch.tensor([0] * 50 + [1] * 50)
    >>> squares = torch.cat((torch.full((50,), 4.0), torch.full((50,), 0.1)))  # too little scatter in the second phase
    >>> [round(share, 3) for share in noise_shares([squares], phase)[[0, 50]].tolist()]
    [1.0, 0.1]
    """
    shares = torch.ones_like(squares[0])
    for number in phase[phase >= 0].unique().tolist():
        inside = phase == number
        count = int(inside.sum())
        least = min(float(own[inside].sum()) for own in squares)
        if least < float(chdtri(count, 1.0 - quiet)):
            shares[inside] = least / count
    return shares
