"""Time transformation that resolves collapses (Sundman), and interpolation of the solution to
requested times.

Collapses shorten the time scale of a bubble a hundredfold, and in a batch they fall at different
moments, so a common step in ``t`` is inefficient for all of them. With ``dt = g(R, U) d tau`` every
member advances by steps of ``tau`` that follow its own time scale, and the whole batch is one
system for the fixed-step Runge-Kutta method of ``torchdiffeq`` (Sundman, Acta Math. 36, 1913).
``t`` becomes a component of the state.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.elementary import Scalar, sqrt, where
from imr_torch.simulate.bubbles import Numbers
from imr_torch.types import BubbleFrames


def time_per_tick(
    radius: Scalar,
    velocity: Scalar,
    acceleration: Scalar,
    pressure: Scalar,
    fading: Scalar,
    b: Numbers,
    resting: float = 0.3,
    springing: float = 0.5,
    falling: float = 0.5,
    viscosity: float = 0.05,
) -> Scalar:
    """``g = dt/d tau``: the shortest of the bubble's own time scales, blended smoothly; a law of
    scalars.

    Args:
        radius: wall radius.
        velocity: wall velocity ``U``; gives ``R/|U|``.
        acceleration: ``dU/dt``; gives the fall time ``sqrt(R/|U'|)``.
        pressure: bubble pressure over ``p_inf``; gives ``R/sqrt(p)`` with the gel's, the period of
            the gas spring.
        fading: rate of the fastest memory of the gel times :func:`memory_share`; 0 without memory.
        b: numbers of the bubble; the gel's damping gives the viscous time ``R^2 Re/4``.
        resting: keeps ``g`` finite where nothing moves: about the frequency of the slow phase near
            Rmax.
        springing: weight of the gas spring.
        falling: weight of the fall time.
        viscosity: weight of the viscous time; keeps step times rate below the stability limit 2.8
            of RK4 for overdamped bubbles.

    Returns:
        Dimensionless time per unit of ``tau``.
    """
    fall = radius * acceleration
    fading = radius * fading
    viscous = b.damping / radius
    rates = (
        resting
        + springing * (pressure + b.spring)
        + falling * where(fall < 0.0, -fall, fall)
        + velocity * velocity
        + viscosity * viscous * viscous
        + fading * fading
    )
    return radius / sqrt(rates)


def memory_share(step: float, least: float = 0.07, stable: float = 2.2) -> float:
    """Weight of the gel's memory: steps of this length must stay stable where memory fades fast.

    Args:
        step: of stretched time.
        least: resolves memory that fades faster than the bubble moves: shorter steps are no more
            accurate, only slower.
        stable: step times rate that such memory may reach where steps are so long that the limit of
            RK4 rules instead.
    """
    return max(least, step / stable)


def hermite_quintic(
    share: Scalar,
    step: Scalar,
    radius: tuple[Scalar, Scalar],
    velocity: tuple[Scalar, Scalar],
    acceleration: tuple[Scalar, Scalar],
) -> tuple[Scalar, Scalar]:
    """Radius and velocity within a step, by quintic Hermite interpolation; a law of scalars.

    Args:
        share: of the step that has passed; before the step (negative) a parabola goes on, since a
            polynomial fitted to a tiny first step would blow up the rounding errors there.
        step: its length.
        radius: at its beginning and end; ``velocity`` and ``acceleration`` likewise.
        velocity: see ``radius``.
        acceleration: see ``radius``.
    """
    r0 = radius[0]
    u0 = velocity[0] * step
    u1 = velocity[1] * step
    a0 = acceleration[0] * step * step
    a1 = acceleration[1] * step * step
    d = radius[1] - r0 - u0 - 0.5 * a0
    e = u1 - u0 - a0
    f = a1 - a0
    early = share < 0.0
    c3 = where(early, 0.0, 10.0 * d - 4.0 * e + 0.5 * f)
    c4 = where(early, 0.0, -15.0 * d + 7.0 * e - f)
    c5 = where(early, 0.0, 6.0 * d - 3.0 * e + 0.5 * f)
    value = r0 + share * (
        u0 + share * (0.5 * a0 + share * (c3 + share * (c4 + share * c5)))
    )
    slope = u0 + share * (a0 + share * (3.0 * c3 + share * (4.0 * c4 + share * 5.0 * c5)))
    return value, slope / step


def hermite_cubic(
    share: Scalar, step: Scalar, values: tuple[Scalar, Scalar], rates: tuple[Scalar, Scalar]
) -> Scalar:
    """A number within a step, by cubic Hermite interpolation, linear before it; arguments as of
    :func:`hermite_quintic`.
    """
    rise = values[1] - values[0]
    r0 = rates[0] * step
    r1 = rates[1] * step
    early = share < 0.0
    bend = where(early, 0.0, 3.0 * rise - 2.0 * r0 - r1)
    twist = where(early, 0.0, r0 + r1 - 2.0 * rise)
    return values[0] + share * (r0 + share * (bend + share * twist))


def bracket_times(
    nodes: Float[Tensor, "members steps"], times: BubbleFrames
) -> tuple[Int[Tensor, "members frames"], BubbleFrames, Tensor]:
    """The step that holds each time.

    Args:
        nodes: time of each step, non-decreasing.
        times: of the output; those before the first node count to the first step.

    Returns:
        Number of the node at its end, its length, and the share of it that has passed.
    """
    first = (nodes <= nodes[:, :1]).sum(1, keepdim=True)  # the first node after the start
    end = (
        torch.searchsorted(nodes, times.contiguous())
        .maximum(first)
        .clamp(1, nodes.shape[1] - 1)
    )
    before = nodes.gather(1, end - 1)
    step = (nodes.gather(1, end) - before).clamp_min(torch.finfo(times.dtype).tiny)
    return end, step, (times - before) / step


def ends_of(
    values: Float[Tensor, "members steps"], end: Int[Tensor, "members frames"]
) -> tuple[BubbleFrames, BubbleFrames]:
    """Values at the nodes before and after each time; ``end`` as :func:`bracket_times` gives it."""
    return values.gather(1, end - 1), values.gather(1, end)
