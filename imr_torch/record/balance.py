"""A smooth cycle and its wall pressure, by least squares in which nothing is differentiated.

With ``V = R^(5/2)`` the wall pressure ``rho (R R'' + 3/2 U^2)`` is ``(2/5) rho V'' / sqrt(R)``.
Pressures whose coefficients are unknown, integrated twice, are therefore linear in V, which is
nearly a parabola. Waves are taken out to first order in ``M = U/c`` (Keller and Miksis, J. Acoust.
Soc. Am. 68, 1980), without the rate of the pressure. Lengths are over the maximum radius of the
cycle, pressures over p_inf.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

ISOTHERMAL_TO_ADIABATIC = (1.0, 1.4)
"""Polytropic exponents between which that of the gas lies."""


@dataclass(frozen=True)
class Contents:
    """A bubble of gas and vapour in a liquid without elasticity.

    Args:
        rest: rest radius; 0 where it is not known, and the gas is left out.
        weber: Weber number of the cycle.
        vapour: vapour pressure.
        sound: sound speed of the liquid over the unit of velocity.
        polytropic: exponent of the gas.
    """

    rest: float
    weber: float
    vapour: float
    sound: float
    polytropic: float = sum(ISOTHERMAL_TO_ADIABATIC) / 2.0

    def pressure(self, y: np.ndarray) -> np.ndarray:
        """At radii: of the contents, less surface tension, less that far away."""
        gas = 0.0
        if self.rest > 0.0:
            at_rest = 1.0 + 1.0 / (self.weber * self.rest) - self.vapour
            gas = at_rest * (self.rest / y) ** (3.0 * self.polytropic)
        return gas + self.vapour - 1.0 / (self.weber * y) - 1.0

    def lossless_half_chord(self, level: float) -> float:
        """Time from the maximum to a level without any loss, by the energy integral."""
        s = np.linspace(0.0, np.sqrt(1.0 - level), 400)[1:]
        y = 1.0 - s**2
        work = cumulative_trapezoid(self.pressure(y) * y**2, y, initial=0.0)
        work -= self.pressure(y[:1]) * s[0] ** 2  # up to the first of these radii
        rate = 2.0 * s / np.sqrt(2.0 * work / y**3)
        return float(np.trapezoid(rate, s) + rate[0] * s[0])


class Frames(NamedTuple):
    """Frames of a cycle: times from its maximum, radii, and the weight of U = 0 at time 0.

    The weight is the noise of a frame over the error of time 0; 0 where growth was recorded, which
    says it better.
    """

    t: np.ndarray
    y: np.ndarray
    still: float


class SmoothCurve(NamedTuple):
    """A cycle on a dense grid: time, radius, velocity, wall pressure less that far away; errors."""

    t: np.ndarray
    y: np.ndarray
    u: np.ndarray
    p: np.ndarray
    y_sd: np.ndarray
    p_sd: np.ndarray


class _Fit(NamedTuple):
    """Coefficients of the pressures, and V, its rate and the wall pressure (``3 x dense``)."""

    coefficients: np.ndarray
    variances: np.ndarray
    bic: float
    values: np.ndarray
    value_variances: np.ndarray


def smooth_cycle(
    frames: Frames, contents: Contents, *, beyond: float, rounds: int = 3
) -> SmoothCurve:
    """The curve whose wall pressure is that of the contents, a function of R and U times another.

    The first is one of 1 and 1/R (elasticity at large stretch), the second of 1/R and R (viscosity,
    and a drag that grows with size); all their subsets in this order are averaged by BIC. Without
    growth the velocity is itself a function of the radius, and the second is left out.

    Args:
        frames: of the cycle.
        contents: of the bubble.
        beyond: frames by which the curve is continued where it goes on.
        rounds: of computing the curve with its own radii in the integrals.
    """
    t = frames.t
    more = beyond * float(np.diff(t).max())
    begin = min(t[0], 0.0) if frames.still else t[0] - more
    dense = np.linspace(begin, t[-1] + more, 401)
    volume = np.polynomial.Polynomial.fit(t, frames.y**2.5, 4, w=frames.y**-1.5)(dense)
    y = np.maximum(volume, 0.05) ** 0.4  # beyond the frames it may come down to nothing
    curve = SmoothCurve(dense, y, np.gradient(y, dense), y, y, y)
    for _ in range(rounds):
        of_radius = [np.ones_like(dense), 1.0 / curve.y]
        of_rate = [curve.u / curve.y, curve.u * curve.y]
        fits = [
            _fit_pressures(frames, curve, contents, [*of_radius[:i], *of_rate[:j]])
            for i in (1, 2)
            for j in ((0,) if frames.still else (0, 1, 2))
        ]
        bic = np.array([fit.bic for fit in fits])
        weights = np.exp(0.5 * (bic.min() - bic))
        weights = (weights / weights.sum())[:, None, None]
        values = np.array([fit.values for fit in fits])
        mean = (weights * values).sum(0)
        variances = np.array([fit.value_variances for fit in fits]) + (values - mean) ** 2
        sds = np.sqrt((weights * variances).sum(0))
        y = np.maximum(mean[0], 0.05) ** 0.4
        scale = 0.4 * y**-1.5
        curve = SmoothCurve(dense, y, scale * mean[1], mean[2], scale * sds[0], sds[2])
    return curve


def _fit_pressures(
    frames: Frames, curve: SmoothCurve, contents: Contents, terms: list[np.ndarray]
) -> _Fit:
    """``V'' = 5/2 sqrt(y) (p (1 + 2 M) - M u^2)``, p being that of the contents and unknown times
    ``terms``, integrated twice: linear in these unknowns and in two constants.

    The covariance is enlarged where neighbouring residuals agree.
    """
    dense = curve.t
    mach = curve.u / contents.sound
    root = 2.5 * np.sqrt(curve.y)

    def integrate_once(values: np.ndarray) -> np.ndarray:
        return cumulative_trapezoid(values, dense, axis=0, initial=0.0)

    # V, its rate and the wall pressure: the known column, the unknowns and two constants
    pressures = np.stack([contents.pressure(curve.y), *terms], 1)
    bending = pressures * (root * (1.0 + 2.0 * mach))[:, None]
    bending[:, 0] -= root * mach * curve.u**2
    slopes = integrate_once(bending)
    zeros = np.zeros_like(dense)
    columns = np.stack(
        [
            np.column_stack([integrate_once(slopes), zeros + 1.0, dense - dense[0]]),
            np.column_stack([slopes, zeros, zeros + 1.0]),
            np.column_stack([pressures, zeros, zeros]),
        ]
    )
    weight = frames.y**-1.5  # the noise of V grows as y^1.5
    seen = [weight * np.interp(frames.t, dense, column) for column in columns[0].T]
    still = [frames.still * np.interp(0.0, dense, column) for column in columns[1].T]
    rows = np.vstack([np.stack(seen, 1), still])
    target = np.append(frames.y**2.5 * weight, 0.0) - rows[:, 0]
    basis = rows[:, 1:]
    known, design = columns[..., 0], columns[..., 1:]
    size = np.sqrt((basis**2).sum(0))
    inverse = np.linalg.pinv(basis / size, rcond=1e-9) / size[:, None]
    coefficients = inverse @ target
    left = target - basis @ coefficients
    count, unknown = basis.shape
    square = max(float(left @ left), 1e-20)
    lag = max(float(left[1:] @ left[:-1]) / square, 0.0)
    inflated = square / max(count - unknown, 1) * (1.0 + lag) / (1.0 - lag)
    covariance = inflated * inverse @ inverse.T
    return _Fit(
        coefficients[:-2],
        covariance.diagonal()[:-2],
        count * np.log(square / count) + unknown * np.log(count),
        design @ coefficients + known,
        np.einsum("kij,jl,kil->ki", design, covariance, design),
    )


def fit_medium(
    frames: Frames, curve: SmoothCurve, contents: Contents
) -> tuple[np.ndarray, np.ndarray]:
    """Viscosity over p_inf times the unit of time and modulus over p_inf of a neo-Hookean
    Kelvin-Voigt medium (Gaudron et al., J. Fluid Mech. 766, 2015), and their standard deviations.

    Means over an isothermal and an adiabatic gas, half of whose difference is added to the errors.
    Without a rest radius the modulus is that of a large stretch.
    """
    stretch = curve.y / max(contents.rest, 1e-3)
    terms = [-4.0 * curve.u / curve.y, -(5.0 - 4.0 / stretch - stretch**-4) / 2.0]
    fits = [
        _fit_pressures(frames, curve, replace(contents, polytropic=exponent), terms)
        for exponent in ISOTHERMAL_TO_ADIABATIC
    ]
    values = np.array([fit.coefficients for fit in fits])
    variances = np.array([fit.variances for fit in fits]).max(0)
    return values.mean(0), np.sqrt(variances + 0.25 * np.ptp(values, 0) ** 2)
