"""Far-field driving: a measured pressure ``p_ac(t)`` on top of ``p_inf``, in SI at the border.

A driving is a function of the laboratory's time in seconds, zero at the maximum radius. The solver
also needs its first and second derivative, because ``dp_far/dt`` acts in compressible radial
equations and is differentiated once more by an implicit step. A field that rings on and a pulse
that arrives, with parameters to infer, are effects (:mod:`imr_torch.simulate.effects`).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.elementary import Scalar, find, where
from imr_torch.errors import InputDataError
from imr_torch.types import Values


def evaluate_spline(
    time: Scalar, knots: Scalar, cubics: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """A cubic a piece (``cubics``, ``4 x n-1``, highest power first) between ``n`` knots, constant
    outside; with its first two derivatives.
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
    return (
        ((a * s + b) * s + c) * s + d,
        where(outside, 0.0, rate),
        where(outside, 0.0, bend),
    )


@dataclass(frozen=True)
class TabulatedDriving:
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
    def pieces(self) -> tuple[Float[Tensor, "knots"], Float[Tensor, "4 pieces"]]:
        """Times, s, and the coefficients of each interval's cubic, highest power first."""
        from scipy.interpolate import CubicSpline  # only for those who tabulate

        table = CubicSpline(self.times, self.pressures, bc_type="clamped")
        with torch.inference_mode(False):  # they outlive the solve that asks for them first
            return torch.as_tensor(table.x), torch.as_tensor(table.c)

    def __call__(self, time: Values) -> tuple[Values, Values, Values]:
        """``p_ac`` (Pa) and its first two time derivatives (Pa/s, Pa/s^2) at times in seconds."""
        knots, cubics = self.pieces
        return evaluate_spline(time, knots.to(time), cubics.to(time))
