"""A generic closure: seven stresses that depend on the state of the bubble, to whose span any local law of a gel is close.

``lambda - 1``, ``(lambda - 1)^2``, ``lambda^-3 - 1``, ``lambda^-6 - 1``, ``U``, ``U|U|`` and ``(U/R)|U/R|`` with the stretch
``lambda = R/R_inf``. They are no model of anything: a gap test asks with them whether a law that nobody has named is missing.
Coefficients are pressures over ``p_inf``; each does nothing at zero. ``|U|`` is rounded off at small velocities.
"""

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from imr_torch.material.stress import Stress

_SMOOTH = 0.02  # velocity below which |U| is rounded off


class _Law:
    """``S = -c s(R, U)`` with ``s`` and its slopes from :meth:`state`."""

    names: ClassVar[tuple[str, ...]]
    switch: ClassVar[str]
    analytic: ClassVar[bool] = True

    def __init_subclass__(cls, *, coefficient: str) -> None:
        cls.names, cls.switch = (coefficient,), coefficient

    def state(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The stress per unit of the coefficient, and its derivatives in ``R`` and in ``U``."""
        raise NotImplementedError

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        value, by_radius, by_velocity = self.state(radius, velocity, rest_radius)
        scale = -theta[self.switch]
        return Stress(scale * value, scale * by_radius * velocity, scale * by_velocity)


def _power(order: int, radius: Tensor, rest_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """``lambda^order - 1``."""
    value = (radius / rest_radius) ** order
    return value - 1.0, order * value / radius, torch.zeros_like(value)


def _signed_square(x: Tensor) -> tuple[Tensor, Tensor]:
    """``x|x|`` and its derivative."""
    size = torch.sqrt(x * x + _SMOOTH**2)
    return x * size, size + x * x / size


class StretchLaw(_Law, coefficient="law_stretch"):
    """``lambda - 1``."""

    def state(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # noqa: D102
        return _power(1, radius, rest_radius)


class SquaredStretchLaw(_Law, coefficient="law_stretch_squared"):
    """``(lambda - 1)^2``."""

    def state(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # noqa: D102
        strain = radius / rest_radius - 1.0
        return strain * strain, 2.0 * strain / rest_radius, torch.zeros_like(strain)


class CompressionLaw(_Law, coefficient="law_compression"):
    """``lambda^-3 - 1``."""

    def state(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # noqa: D102
        return _power(-3, radius, rest_radius)


class SteepCompressionLaw(_Law, coefficient="law_compression_steep"):
    """``lambda^-6 - 1``."""

    def state(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # noqa: D102
        return _power(-6, radius, rest_radius)


class VelocityLaw(_Law, coefficient="law_velocity"):
    """``U``."""

    def state(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # noqa: D102
        return velocity, torch.zeros_like(velocity), torch.ones_like(velocity)


class SquaredVelocityLaw(_Law, coefficient="law_velocity_squared"):
    """``U|U|``."""

    def state(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # noqa: D102
        value, slope = _signed_square(velocity)
        return value, torch.zeros_like(value), slope


class SquaredRateLaw(_Law, coefficient="law_rate_squared"):
    """``(U/R)|U/R|``."""

    def state(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # noqa: D102
        rate = velocity / radius
        value, slope = _signed_square(rate)
        return value, -slope * rate / radius, slope / radius


CLOSURE = (
    StretchLaw(),
    SquaredStretchLaw(),
    CompressionLaw(),
    SteepCompressionLaw(),
    VelocityLaw(),
    SquaredVelocityLaw(),
    SquaredRateLaw(),
)
"""All of them, in the order above."""
