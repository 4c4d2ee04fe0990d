"""Far-field driving: a pressure ``p_ac(t)`` on top of ``p_inf``, in SI at the border.

A driving is a function of the laboratory's time in seconds, zero at the maximum radius. The solver also needs its first and
second derivative, because ``dp_far/dt`` acts in compressible radial equations and is differentiated once more by an
implicit step.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from imr_torch.errors import InputDataError


class Driving(Protocol):
    """Anything that gives ``p_ac`` (Pa) and its first two time derivatives (Pa/s, Pa/s^2) at times in seconds."""

    def __call__(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``time`` of any shape; three tensors of that shape."""
        ...


def _check(kind: object, positive: str = "", finite: str = "") -> None:
    for name in (*positive.split(), *finite.split()):
        value = getattr(kind, name)
        if not math.isfinite(value) or (name in positive.split() and value <= 0.0):
            expected = "a positive finite number" if name in positive.split() else "finite"
            raise InputDataError(f"{type(kind).__name__}.{name} is {value}; it must be {expected}, in SI units.")


@dataclass(frozen=True)
class SineDriving:
    """``p_ac = amplitude sin(2 pi frequency t + phase)``.

    Args:
        amplitude: Pa.
        frequency: Hz.
        phase: radians.
    """

    amplitude: float
    frequency: float
    phase: float = 0.0

    def __post_init__(self) -> None:
        _check(self, positive="frequency", finite="amplitude phase")

    def __call__(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See :class:`Driving`."""
        rate = 2.0 * math.pi * self.frequency
        angle = rate * time + self.phase
        value = self.amplitude * torch.sin(angle)
        return value, self.amplitude * rate * torch.cos(angle), -(rate**2) * value


@dataclass(frozen=True)
class GaussianPulse:
    """``p_ac = amplitude exp(-((t - centre)/width)^2)``.

    Args:
        amplitude: Pa; negative for a pulse of tension.
        centre: s.
        width: s.
    """

    amplitude: float
    centre: float
    width: float

    def __post_init__(self) -> None:
        _check(self, positive="width", finite="amplitude centre")

    def __call__(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See :class:`Driving`."""
        x = (time - self.centre) / self.width
        value = self.amplitude * torch.exp(-x * x)
        return value, -2.0 * x / self.width * value, (4.0 * x * x - 2.0) / self.width**2 * value


@dataclass(frozen=True)
class TabulatedDriving:
    """A measured pressure, interpolated by a cubic spline; constant before its first and after its last sample.

    Args:
        times: s, increasing, at least three; the spline ends with zero slope, so that it joins the constants smoothly.
        pressures: Pa, as many.
    """

    times: tuple[float, ...]
    pressures: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.times) != len(self.pressures) or len(self.times) < 3:
            raise InputDataError(
                f"TabulatedDriving has {len(self.times)} times and {len(self.pressures)} pressures; expected as many of each, "
                "at least three."
            )
        if not all(math.isfinite(x) for x in (*self.times, *self.pressures)):
            raise InputDataError("TabulatedDriving holds a value that is not finite; leave such samples out.")
        if any(b <= a for a, b in zip(self.times[:-1], self.times[1:], strict=True)):
            raise InputDataError("TabulatedDriving.times must increase; sort them and drop repeated ones.")

    @cached_property
    def _pieces(self) -> tuple[Tensor, Tensor]:
        """Times, and the coefficients of each interval's cubic, highest power first: ``4 x n-1``."""
        from scipy.interpolate import CubicSpline  # only for those who tabulate

        spline = CubicSpline(self.times, self.pressures, bc_type="clamped")
        with torch.inference_mode(False):  # they outlive the solve that asks for them first
            return torch.as_tensor(spline.x), torch.as_tensor(spline.c)

    def __call__(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See :class:`Driving`."""
        knots, cubics = (x.to(time) for x in self._pieces)
        inside = (time >= knots[0]) & (time <= knots[-1])
        held = time.clamp(knots[0], knots[-1])
        piece = torch.searchsorted(knots, held.detach().contiguous(), right=True).sub(1).clamp(0, len(knots) - 2)
        s = held - knots[piece]
        a, b, c, d = cubics[:, piece].unbind(0)
        rate, bend = (3.0 * a * s + 2.0 * b) * s + c, 6.0 * a * s + 2.0 * b
        return ((a * s + b) * s + c) * s + d, torch.where(inside, rate, 0.0), torch.where(inside, bend, 0.0)
