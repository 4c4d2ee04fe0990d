"""The acceleration of the wall with its exact derivatives: Keller-Miksis driven by a pressure and its rate.

``(1 - U/c) R U' + 3/2 (1 - U/(3c)) U^2 = (1 + U/c + (R/c) d/dt) P`` with ``P = p_b - 1/(We R) + S - 1`` (Keller &
Miksis, J. Acoust. Soc. Am. 68, 1980; Estrada et al. 2018, eq. 4); ``q = dp_b/dt`` is given. The part of ``dS/dt``
that holds ``U'`` is taken to the left.
"""

from dataclasses import dataclass

from torch import Tensor

from imr_torch.material import Stress, stress_integral, stress_slopes
from imr_torch.simulate.bubbles import Bubbles


@dataclass(frozen=True)
class WallSlope:
    """Partial derivatives of ``U'``, each a ``B`` tensor: in ``R``, ``U``, ``p_b`` and ``q = dp_b/dt``."""

    radius: Tensor
    velocity: Tensor
    pressure: Tensor
    pressure_rate: Tensor


def acceleration(bubbles: Bubbles, radius: Tensor, velocity: Tensor, pressure: Tensor, pressure_rate: Tensor) -> Tensor:
    """``U'``; all arguments are ``B`` tensors, dimensionless."""
    stress = stress_integral(bubbles.terms, radius, velocity, bubbles["rest_radius"], bubbles.theta)
    force, inertia, _ = _balance(bubbles, stress, radius, velocity, pressure, pressure_rate)
    return force / inertia


def acceleration_slope(
    bubbles: Bubbles, radius: Tensor, velocity: Tensor, pressure: Tensor, pressure_rate: Tensor
) -> tuple[Tensor, WallSlope]:
    """``U'`` and its derivatives; arguments as in :func:`acceleration`."""
    gel = (bubbles.terms, radius, velocity, bubbles["rest_radius"], bubbles.theta)
    stress, slopes = stress_integral(*gel), stress_slopes(*gel)
    by_radius, by_velocity = slopes.radius, slopes.velocity
    force, inertia, load = _balance(bubbles, stress, radius, velocity, pressure, pressure_rate)
    slowness = 1.0 / bubbles.constants.sound_speed
    mach, delay = velocity * slowness, radius * slowness
    tension = 1.0 / (bubbles["weber"] * radius)
    tension_rate = tension * velocity / radius
    force_radius = (
        (1.0 + mach) * (tension / radius + by_radius.value)
        + slowness * (pressure_rate - tension_rate + stress.rate)
        + delay * by_radius.rate
    )
    force_velocity = (
        load * slowness
        + (1.0 + mach) * by_velocity.value
        + delay * (tension / radius + by_velocity.rate)
        - (3.0 - 1.5 * mach) * velocity
    )
    inertia_radius, inertia_velocity = 1.0 - mach, -delay
    if bubbles.constants.stress_acceleration:
        inertia_radius = inertia_radius - slowness * stress.acceleration - delay * by_radius.acceleration
        inertia_velocity = inertia_velocity - delay * by_velocity.acceleration
    rate = force / inertia
    return rate, WallSlope(
        (force_radius - rate * inertia_radius) / inertia,
        (force_velocity - rate * inertia_velocity) / inertia,
        (1.0 + mach) / inertia,
        delay / inertia,
    )


def _balance(
    bubbles: Bubbles, stress: Stress, radius: Tensor, velocity: Tensor, pressure: Tensor, pressure_rate: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Force and inertia of Keller-Miksis (``U'`` is their ratio), and the load ``P``."""
    slowness = 1.0 / bubbles.constants.sound_speed
    mach, delay = velocity * slowness, radius * slowness
    tension = 1.0 / (bubbles["weber"] * radius)
    load = pressure + (bubbles.constants.constant_vapour - 1.0) - tension + stress.value
    load_rate = pressure_rate + tension * velocity / radius + stress.rate
    force = (1.0 + mach) * load + delay * load_rate - (1.5 - 0.5 * mach) * velocity * velocity
    inertia = (1.0 - mach) * radius
    if bubbles.constants.stress_acceleration:
        inertia = inertia - delay * stress.acceleration
    return force, inertia, load
