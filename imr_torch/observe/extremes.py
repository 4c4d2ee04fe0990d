"""Extremes of a curve: its turning points, each fitted between frames, and its collapse times.

An extreme comes from a local least-squares fit, so it lies between frames and carries a standard
deviation. Near a collapse ``R ~ |t - t_c|^(2/5)`` (Rayleigh, Phil. Mag. 34, 1917), which no smooth fit
resolves better than a frame.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from imr_torch.files import read_table
from imr_torch.reading.traces import Given, RadiusTrace
from imr_torch.types import FrameValues

RULES = SimpleNamespace(**read_table("landmarks"))
"""How landmarks are found (``data/landmarks.toml``)."""


def frame_roughness(radius: np.ndarray) -> float:
    """Standard deviation of a frame by the median third difference, which a local parabola does not
    change.

    >>> import numpy as np
    >>> from imr_torch.observe.extremes import frame_roughness
    >>> round(frame_roughness(np.random.default_rng(0).normal(1.0, 0.02, 500)), 2)
    0.02
    """
    if len(radius) < 6:
        return 0.0
    return 1.4826 * float(np.median(np.abs(np.diff(radius, 3)))) / math.sqrt(20.0)


@dataclass(frozen=True)
class Curve:
    """A record as arrays, with the frame and radius of its maximum and the noise of a frame in m."""

    time: np.ndarray
    radius: np.ndarray
    given: Given
    noise: float
    k: int
    top: float

    @classmethod
    def of(cls, trace: RadiusTrace) -> "Curve":
        """The arrays of a trace."""
        radius = trace.radius_m.numpy()
        k = int(radius.argmax())
        top = float(radius[k])
        noise = RULES.few_frames_noise * top
        if len(radius) >= 12:
            low, high = RULES.noise_range
            noise = float(np.clip(frame_roughness(radius), low * top, high * top))
        return cls(trace.time_s.numpy(), radius, trace.given, noise, k, top)

    @property
    def spacing(self) -> float:
        """Longest time between the largest frame and one beside it, s."""
        return float(np.diff(self.time)[max(self.k - 1, 0) : self.k + 1].max())


@dataclass(frozen=True)
class Extreme:
    """A maximum or minimum: time and value with standard deviations."""

    time: float
    value: float
    time_sd: float
    value_sd: float


def turning_points(
    values: Sequence[float], thresholds: Sequence[float], start: int = 0
) -> list[tuple[int, int]]:
    """Places where a curve turns by more than a threshold, each with +1 (maximum) or -1 (minimum).

    Args:
        values: the curve, at a maximum at ``start``.
        thresholds: by how much it must have turned at each place.
        start: place from which on it is followed.

    >>> from imr_torch.observe.extremes import turning_points
    >>> turning_points([9.0, 2.0, 1.0, 1.5, 6.0, 5.8, 2.0], [1.0] * 7)
    [(2, -1), (4, 1)]
    """
    turns: list[tuple[int, int]] = []
    sign = -1
    best = start
    for i in range(start + 1, len(values)):
        if sign * (values[i] - values[best]) > 0.0:
            best = i
        elif sign * (values[best] - values[i]) > thresholds[i]:
            if best > start:
                turns.append((best, sign))
                sign = -sign
            best = i
    return turns


def collapse_time(times: FrameValues, radius: FrameValues, number: int) -> float:
    """Time of collapse ``number`` (1 is the first) of a curve whose maximum is at time zero; infinity
    when not reached.

    A minimum counts when the curve climbs from it by a tenth of its range, so frame noise makes
    none.

    Args:
        times: ``n_t`` tensor.
        radius: any unit.
        number: which collapse.

    >>> import torch
    >>> from imr_torch.observe import collapse_time
    >>> times = torch.linspace(0.0, 12.0, 121, dtype=torch.float64)
    >>> [round(collapse_time(times, 1.1 + torch.cos(times), number), 1) for number in (1, 2, 3)]
    [3.1, 9.4, inf]
    """
    depth = 0.1 * float(radius.amax() - radius.amin())
    turns = turning_points(radius.tolist(), [depth] * len(radius), int((times < 0.0).sum()))
    minima = [k for k, sign in turns if sign < 0]
    return float(times[minima[number - 1]]) if len(minima) >= number else math.inf


def find_extremes(curve: Curve) -> tuple[list[Extreme], list[Extreme]]:
    """Minima and maxima after the main maximum, alternating.

    A reversal smaller than the noise is none.
    """
    time = curve.time
    radius = curve.radius
    noise = curve.noise
    minima: list[Extreme] = []
    maxima: list[Extreme] = []
    turns = turning_points(radius.tolist(), _least_reversals(curve).tolist(), curve.k)
    places = [curve.k, *(k for k, _ in turns), len(radius)]
    for low, (k, sign), high in zip(places, turns, places[2:], strict=False):
        swing = min(abs(radius[low] - radius[k]), np.abs(radius[k:high] - radius[k]).max())
        near = np.abs(radius - radius[k]) <= 0.2 * swing
        near[:low], near[high:] = False, False
        found = fit_extreme(curve, grow_window(k, near), 2, sign)
        farthest = max(0.3 * swing, 3.0 * noise)
        if found is None or abs(found.value - radius[k]) > farthest:
            apart = float(time[k + 1] - time[k - 1])
            found = Extreme(float(time[k]), float(radius[k]), apart / 4.0, noise)
        (maxima if sign > 0 else minima).append(found)
    return minima, maxima


def _least_reversals(curve: Curve) -> np.ndarray:
    """By how much the curve must turn at each frame to turn by more than its noise can."""
    radius = curve.radius
    count = RULES.local_frames
    starts = (np.arange(len(radius)) - count // 2).clip(0, max(len(radius) - count, 0))
    local = np.full(len(radius), curve.noise)
    if len(radius) >= count:
        local = np.array(
            [frame_roughness(radius[start : start + count]) for start in starts]
        )
    return np.maximum(RULES.reversal * curve.noise, RULES.local_reversal * local)


def grow_window(k: int, keep: np.ndarray) -> slice:
    """The run of frames round ``k`` in which ``keep`` holds.

    Always with the neighbours of ``k``.
    """
    left_out = np.flatnonzero(~keep)
    low = left_out[left_out < k - 1].max(initial=-1) + 1
    high = left_out[left_out > k + 1].min(initial=len(keep))
    return slice(int(low), int(high))


def fit_extreme(curve: Curve, window: slice, degree: int, sign: int) -> Extreme | None:
    """Least-squares polynomial and its vertex; None if the vertex is not inside the frames.

    The residual variance is pooled with ``noise**2`` (as ``prior_weight`` frames), because a few
    frames cannot determine it, and enlarged where neighbouring residuals agree (edge detection
    and misfit err smoothly). The value varies as the fit at the vertex does (its derivative there
    is zero); the time as the slope there over the curvature.
    """
    time = curve.time[window]
    radius = curve.radius[window]
    centre = 0.5 * (time[0] + time[-1])
    span = 0.5 * (time[-1] - time[0])
    x = (time - centre) / span
    basis = np.vander(x, degree + 1)
    coefficients, *_ = np.linalg.lstsq(basis, radius, rcond=None)
    slope = np.polyder(coefficients)
    bend = np.polyder(slope)
    roots = np.roots(slope)
    inside = roots[(np.abs(roots.imag) < 1e-9) & (np.abs(roots.real) <= 1.0)].real
    vertices = [float(r) for r in inside if sign * np.polyval(bend, r) < 0.0]
    if not vertices:
        return None
    vertex = max(vertices, key=lambda r: sign * float(np.polyval(coefficients, r)))
    residual = radius - basis @ coefficients
    square = float(residual @ residual)
    weight = RULES.prior_weight
    variance = (square + weight * curve.noise**2) / (len(x) - degree - 1 + weight)
    if len(x) >= RULES.quartic_from:
        lag = max(float(residual[1:] @ residual[:-1]) / max(square, 1e-300), 0.0)
        variance *= (1.0 + lag) / (1.0 - lag)
    covariance = variance * np.linalg.pinv(basis.T @ basis)
    powers = np.vander([vertex], degree + 1)[0]
    slopes = np.append(powers[1:] * np.arange(degree, 0, -1), 0.0)
    value_sd, slope_sd = (math.sqrt(v @ covariance @ v) for v in (powers, slopes))
    time_sd = min(slope_sd / abs(float(np.polyval(bend, vertex))), 2.0) * span
    value = float(np.polyval(coefficients, vertex))
    return Extreme(centre + vertex * span, value, time_sd, value_sd)
