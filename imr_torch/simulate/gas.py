"""Laws of a bubble that holds polytropic gas: scalar functions that both engines use
(:mod:`imr_torch.elementary`).
"""

from imr_torch.elementary import Scalar, power


def compression_of(radius: Scalar, exponent: Scalar) -> Scalar:
    """``P/P(0)`` of polytropic gas."""
    return power(radius, -3.0 * exponent)


def polytropic_pressure(
    radius: Scalar,
    velocity: Scalar,
    left: Scalar,
    lost: Scalar,
    compression: Scalar,
    factor: Scalar,
    trapped: Scalar,
    gas: Scalar,
    exponent: Scalar,
    vapour: Scalar,
) -> tuple[Scalar, Scalar]:
    """Pressure of polytropic gas with vapour at constant pressure beside it, and its rate.

    Args:
        radius: ``R``.
        velocity: ``U``.
        left: share of the gas that is left.
        lost: relative rate at which it is lost.
        compression: see :func:`compression_of`.
        factor: of the vapour pressure, by effects; 1 without.
        trapped: its logarithmic derivative in the compression.
        gas: pressure of the gas at ``R = 1``.
        exponent: polytropic exponent.
        vapour: pressure of the vapour without effects.
    """
    inside = gas * compression * left
    beside = vapour * factor
    stiffness = 3.0 * exponent * velocity / radius
    return inside + beside, -stiffness * (inside + trapped * beside) - inside * lost
