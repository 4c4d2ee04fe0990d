"""Time transformation that resolves collapses (Sundman), and interpolation of the solution to
requested times.

Collapses shorten the time scale of a bubble a hundredfold, and in a batch they fall at different
moments, so a common step in ``t`` is inefficient for all of them. With ``dt = g(R, U) d tau`` every
member advances by steps of ``tau`` that follow its own time scale, and the whole batch is one
system for the fixed-step Runge-Kutta method of ``torchdiffeq`` (Sundman, Acta Math. 36, 1913).
``t`` becomes a component of the state.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.elementary import Scalar, sqrt, where
from imr_torch.simulate.bubbles import Numbers

_REST = 0.3  # keeps g finite where nothing moves: about the frequency of the slow phase near Rmax
_PRESSURE = 0.5
_FALL = 0.5
_VISCOUS = 0.05  # keeps step * rate below the stability limit 2.8 of RK4 for overdamped bubbles
# resolves memory that fades faster than the bubble moves: shorter steps are no more accurate, only
# slower
_MEMORY = 0.07
# step * rate that such memory may reach where steps are so long that the limit of RK4 rules instead
_STABLE = 2.2


def time_per_tick(
    radius: Scalar,
    velocity: Scalar,
    acceleration: Scalar,
    pressure: Scalar,
    fading: Scalar,
    b: Numbers,
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

    Returns:
        Dimensionless time per unit of ``tau``.
    """
    fall = radius * acceleration
    fading = radius * fading
    viscous = b.damping / radius
    rates = (
        _REST
        + _PRESSURE * (pressure + b.spring)
        + _FALL * where(fall < 0.0, -fall, fall)
        + velocity * velocity
        + _VISCOUS * viscous * viscous
        + fading * fading
    )
    return radius / sqrt(rates)


def memory_share(step: float) -> float:
    """Weight of the gel's memory: steps of this length must stay stable where memory fades fast."""
    return max(_MEMORY, step / _STABLE)


def interpolate(
    nodes: Float[Tensor, "members steps"],
    radius: Float[Tensor, "members steps"],
    velocity: Float[Tensor, "members steps"],
    acceleration: Float[Tensor, "members steps"],
    times: Float[Tensor, "members frames"],
) -> tuple[Float[Tensor, "members frames"], Float[Tensor, "members frames"]]:
    """Radius and velocity at given times by quintic Hermite interpolation between steps.

    Args:
        nodes: time of each step, non-decreasing.
        radius: ``B x n`` tensor at the nodes.
        velocity: ``B x n`` tensor.
        acceleration: ``B x n`` tensor.
        times: before the first node a parabola goes on (a polynomial fitted to a tiny first step
            would blow up the rounding errors there).

    Returns:
        Radius and velocity, each ``B x n_t``. The error is of sixth order in the step.
    """
    right = torch.searchsorted(nodes.detach(), times.contiguous()).clamp(1, nodes.shape[1] - 1)
    left = right - 1

    def ends(values: Tensor) -> tuple[Tensor, Tensor]:
        return values.gather(1, left), values.gather(1, right)

    t0, t1 = ends(nodes)
    h = (t1 - t0).clamp_min(torch.finfo(times.dtype).tiny)
    s = (times - t0) / h
    (r0, r1), (u0, u1), (a0, a1) = ends(radius), ends(velocity), ends(acceleration)
    u0 = u0 * h
    u1 = u1 * h
    a0 = a0 * h * h
    a1 = a1 * h * h
    d = r1 - r0 - u0 - 0.5 * a0
    e = u1 - u0 - a0
    f = a1 - a0
    c3 = 10.0 * d - 4.0 * e + 0.5 * f
    c4 = -15.0 * d + 7.0 * e - f
    c5 = 6.0 * d - 3.0 * e + 0.5 * f
    c3, c4, c5 = (torch.where(s < 0.0, 0.0, c) for c in (c3, c4, c5))
    value = r0 + s * (u0 + s * (0.5 * a0 + s * (c3 + s * (c4 + s * c5))))
    slope = u0 + s * (a0 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))
    return value, slope / h
