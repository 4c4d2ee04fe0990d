"""Far-field driving: a pressure ``p_ac(t)`` on top of ``p_inf``, in SI at the border.

A driving is a function of the laboratory's time in seconds, zero at the maximum radius. The solver
also needs its first and second derivative, because ``dp_far/dt`` acts in compressible radial
equations and is differentiated once more by an implicit step.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.elementary import Law, Scalar, cos, exp, find, sin, where
from imr_torch.errors import InputDataError

_TURN = 2.0 * math.pi


class Driving(Protocol):
    """Anything that gives ``p_ac`` (Pa) and its first two time derivatives (Pa/s, Pa/s^2) at times
    in seconds.

    The compiled engine takes a :class:`LawDriving`; any other one is evaluated on tensors.

    >>> import torch
    >>> from imr_torch.simulate import Driving, SineDriving
    >>> driving: Driving = SineDriving(amplitude=1e4, frequency=50e3)
    >>> [round(float(x)) for x in driving(torch.tensor(0.0, dtype=torch.float64))][:2]  # Pa and Pa/s
    [0, 3141592654]
    """

    def __call__(
        self, time: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """``time`` of any shape; three tensors of that shape."""
        ...


def sine(
    time: Scalar, values: Scalar, knots: Scalar, cubics: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """``a sin(2 pi f t + phase)`` of ``values`` amplitude, frequency and phase."""
    rate = _TURN * values[1]
    angle = rate * time + values[2]
    value = values[0] * sin(angle)
    return value, values[0] * rate * cos(angle), -rate * rate * value


def gaussian(
    time: Scalar, values: Scalar, knots: Scalar, cubics: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """``a exp(-((t - centre)/width)^2)`` of ``values`` amplitude, centre and width."""
    x = (time - values[1]) / values[2]
    value = values[0] * exp(-x * x)
    return (
        value,
        -2.0 * x / values[2] * value,
        (4.0 * x * x - 2.0) / (values[2] * values[2]) * value,
    )


def spline(
    time: Scalar, values: Scalar, knots: Scalar, cubics: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """A cubic a piece (``cubics``, ``4 x n-1``, highest power first) between ``n`` knots, constant
    outside.
    """
    early = time < knots[0]
    late = time > knots[-1]
    held = where(early, knots[0], where(late, knots[-1], time))
    piece = find(knots, held)
    s = held - knots[piece]
    a = cubics[0, piece]
    b = cubics[1, piece]
    c = cubics[2, piece]
    d = cubics[3, piece]
    rate = (3.0 * a * s + 2.0 * b) * s + c
    bend = 6.0 * a * s + 2.0 * b
    outside = early | late
    return ((a * s + b) * s + c) * s + d, where(outside, 0.0, rate), where(outside, 0.0, bend)


class LawDriving:
    """A driving that is a law of scalars (:mod:`imr_torch.elementary`): ``law(time, values, knots,
    cubics)``.

    Attributes:
        law: gives ``p_ac`` and its first two derivatives, SI.
        knots: of a table, one interval where it needs none.
        cubics: its coefficients, zeros where it needs none.

    >>> from imr_torch.simulate import GaussianPulse, LawDriving
    >>> pulse = GaussianPulse(-2e4, 30e-6, 5e-6)
    >>> isinstance(pulse, LawDriving), pulse.values
    (True, (-20000.0, 3e-05, 5e-06))
    """

    law: ClassVar[Law]
    knots: Float[Tensor, "knots"] = torch.tensor([0.0, 1.0], dtype=torch.float64)
    cubics: Float[Tensor, "4 pieces"] = torch.zeros(4, 1, dtype=torch.float64)

    @property
    def values(self) -> tuple[float, ...]:
        """The numbers of the law, ``values`` of its arguments; none by default."""
        return ()

    def __call__(
        self, time: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """See :class:`Driving`."""
        return type(self).law(time, self.values, self.knots.to(time), self.cubics.to(time))


DRIVING_LAWS = (sine, gaussian, spline)
"""The laws that every compiled engine knows."""


def _check(kind: object, positive: str = "", finite: str = "") -> None:
    for name in (*positive.split(), *finite.split()):
        value = getattr(kind, name)
        if not math.isfinite(value) or (name in positive.split() and value <= 0.0):
            expected = "a positive finite number" if name in positive.split() else "finite"
            raise InputDataError(
                f"{type(kind).__name__}.{name} is {value}; it must be {expected}, in SI units."
            )


@dataclass(frozen=True)
class SineDriving(LawDriving):
    """``p_ac = amplitude sin(2 pi frequency t + phase)``.

    Args:
        amplitude: Pa.
        frequency: Hz.
        phase: radians.

    >>> from imr_torch.simulate import Conditions, PolytropicSimulator, SineDriving
    >>> driven = PolytropicSimulator(Conditions(driving=SineDriving(amplitude=1e4, frequency=50e3)))
    >>> driven.conditions.driving.frequency
    50000.0
    """

    amplitude: float
    frequency: float
    phase: float = 0.0

    def __post_init__(self) -> None:
        _check(self, positive="frequency", finite="amplitude phase")

    law = staticmethod(sine)

    @property
    def values(self) -> tuple[float, ...]:
        """See :func:`sine`."""
        return self.amplitude, self.frequency, self.phase


@dataclass(frozen=True)
class GaussianPulse(LawDriving):
    """``p_ac = amplitude exp(-((t - centre)/width)^2)``.

    Args:
        amplitude: Pa; negative for a pulse of tension.
        centre: s.
        width: s.

    >>> import torch
    >>> from imr_torch.simulate import GaussianPulse
    >>> pulse = GaussianPulse(amplitude=-2e4, centre=30e-6, width=5e-6)
    >>> [round(x) for x in pulse(torch.tensor([0.0, 30e-6]).double())[0].tolist()]  # Pa
    [0, -20000]
    """

    amplitude: float
    centre: float
    width: float

    def __post_init__(self) -> None:
        _check(self, positive="width", finite="amplitude centre")

    law = staticmethod(gaussian)

    @property
    def values(self) -> tuple[float, ...]:
        """See :func:`gaussian`."""
        return self.amplitude, self.centre, self.width


@dataclass(frozen=True)
class TabulatedDriving(LawDriving):
    """A measured pressure, interpolated by a cubic spline; constant before its first and after its
    last sample.

    Args:
        times: s, increasing, at least three; the spline ends with zero slope, so that it joins the
            constants smoothly.
        pressures: Pa, as many.

    >>> import torch
    >>> from imr_torch.simulate import TabulatedDriving
    >>> measured = TabulatedDriving(times=(0.0, 10e-6, 20e-6), pressures=(0.0, 1e4, 0.0))
    >>> round(float(measured(torch.tensor(10e-6).double())[0]))  # Pa
    10000
    """

    times: tuple[float, ...]
    pressures: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.times) != len(self.pressures) or len(self.times) < 3:
            raise InputDataError(
                f"TabulatedDriving has {len(self.times)} times and {len(self.pressures)} "
                "pressures; expected as many of each, "
                "at least three."
            )
        if not all(math.isfinite(x) for x in (*self.times, *self.pressures)):
            raise InputDataError(
                "TabulatedDriving holds a value that is not finite; leave such samples out."
            )
        if any(b <= a for a, b in zip(self.times[:-1], self.times[1:], strict=True)):
            raise InputDataError(
                "TabulatedDriving.times must increase; sort them and drop repeated ones."
            )

    @cached_property
    def _pieces(self) -> tuple[Tensor, Tensor]:
        """Times, and the coefficients of each interval's cubic, highest power first: ``4 x n-1``."""
        from scipy.interpolate import CubicSpline  # only for those who tabulate

        spline = CubicSpline(self.times, self.pressures, bc_type="clamped")
        with torch.inference_mode(False):  # they outlive the solve that asks for them first
            return torch.as_tensor(spline.x), torch.as_tensor(spline.c)

    law = staticmethod(spline)

    @property
    def knots(self) -> Float[Tensor, "knots"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Times of the samples, s."""
        return self._pieces[0]

    @property
    def cubics(self) -> Float[Tensor, "4 pieces"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The pieces of the spline."""
        return self._pieces[1]
