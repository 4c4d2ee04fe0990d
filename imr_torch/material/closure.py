"""Seven generic stress functions of the bubble's state, whose linear combinations approximate any
local stress law.

``lambda - 1``, ``(lambda - 1)^2``, ``lambda^-3 - 1``, ``lambda^-6 - 1``, ``U``, ``U|U|`` and
``(U/R)|U/R|`` with the stretch ``lambda = R/R_inf``. They model no particular material: the gap
test detects with them a missing stress law that is in no library. Coefficients are pressures over
``p_inf``; each does nothing at zero. ``|U|`` is rounded off at small velocities.
"""

from imr_torch.elementary import Scalar, sqrt
from imr_torch.material.stress import SMOOTH, StressTerm


def _signed_square(x: Scalar) -> tuple[Scalar, Scalar]:
    """``x|x|`` and its derivative."""
    size = sqrt(x * x + SMOOTH * SMOOTH)
    return x * size, size + x * x / size


def stretch(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_stretch: Scalar
) -> tuple[Scalar, ...]:
    """``lambda - 1``."""
    return -law_stretch * (radius / rest_radius - 1.0), -law_stretch * velocity / rest_radius, 0.0


def squared_stretch(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_stretch_squared: Scalar
) -> tuple[Scalar, ...]:
    """``(lambda - 1)^2``."""
    strain = radius / rest_radius - 1.0
    return (
        -law_stretch_squared * strain * strain,
        -2.0 * law_stretch_squared * strain * velocity / rest_radius,
        0.0,
    )


def compression(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_compression: Scalar
) -> tuple[Scalar, ...]:
    """``lambda^-3 - 1``."""
    inverse = rest_radius / radius
    cubed = inverse * inverse * inverse
    return -law_compression * (cubed - 1.0), 3.0 * law_compression * cubed * velocity / radius, 0.0


def steep_compression(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_compression_steep: Scalar
) -> tuple[Scalar, ...]:
    """``lambda^-6 - 1``."""
    inverse = rest_radius / radius
    cubed = inverse * inverse * inverse
    sixth = cubed * cubed
    return (
        -law_compression_steep * (sixth - 1.0),
        6.0 * law_compression_steep * sixth * velocity / radius,
        0.0,
    )


def speed(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_velocity: Scalar
) -> tuple[Scalar, ...]:
    """``U``."""
    return -law_velocity * velocity, 0.0, -law_velocity


def squared_speed(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_velocity_squared: Scalar
) -> tuple[Scalar, ...]:
    """``U|U|``."""
    value, slope = _signed_square(velocity)
    return -law_velocity_squared * value, 0.0, -law_velocity_squared * slope


def squared_rate(
    radius: Scalar, velocity: Scalar, rest_radius: Scalar, law_rate_squared: Scalar
) -> tuple[Scalar, ...]:
    """``(U/R)|U/R|``."""
    rate = velocity / radius
    value, slope = _signed_square(rate)
    return (
        -law_rate_squared * value,
        law_rate_squared * slope * rate * rate,
        -law_rate_squared * slope / radius,
    )


CLOSURE = tuple(
    StressTerm(law, switch=coefficient)
    for law, coefficient in (
        (stretch, "law_stretch"),
        (squared_stretch, "law_stretch_squared"),
        (compression, "law_compression"),
        (steep_compression, "law_compression_steep"),
        (speed, "law_velocity"),
        (squared_speed, "law_velocity_squared"),
        (squared_rate, "law_rate_squared"),
    )
)
"""All of them, in the order above."""
