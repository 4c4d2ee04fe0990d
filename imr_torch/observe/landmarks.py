"""Landmarks of a curve: maximum radius and its time, collapses, rebounds, rest radius, phases.

Every landmark comes from a local least-squares fit, so it lies between frames and carries a
standard deviation. Where the record does not hold a landmark (growth cut off, no rebound), the
result says so in its method rather than guessing: near a collapse ``R ~ |t - t_c|^(2/5)``
(Rayleigh, Phil. Mag. 34, 1917), which no smooth fit resolves better than a frame.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import curve_fit

from imr_torch.observe.window import turning_points
from imr_torch.reading.traces import Given, RadiusTrace


@dataclass(frozen=True)
class LandmarkRules:
    """How landmarks are found; every default was chosen on simulated and measured curves.

    Args:
        tail: share of the last frames whose mean is the rest radius, if the bubble has settled.
        settled_below: the bubble has settled if std/mean of these frames is below this, over half a
            cycle or more.
        noisy_tail: a tail that scatters by no more than this times the noise of its frames has
            settled too.
        peak_windows: frames above these shares of the largest one are fitted for the maximum; what
            the second window changes is an error.
        neighbour: share of the largest frame that a frame beside it must have.
        largest_excess: of a fitted maximum over the largest frame; beyond, the fit is not used.
        quartic_from: frames from which on a polynomial of degree 4 is fitted.
        exposure: of the time between frames, by which the time of the maximum is blurred.
        noise_range: least and largest noise of a frame, of the largest radius.
        few_frames_noise: noise of the frames of a record too short to show it.
        prior_weight: frames that this noise counts for in the variance of a fit.
        reversal: of the noise of a frame, by which a curve must turn.
        local_reversal: the same of the noise of the frames around: noise that grows with time
            would make cycles of its own in the tail of a record.
        local_frames: frames around.
        start_windows: as ``peak_windows``, for a record that begins near its maximum.
        start_frames: fewest frames for that.
        start_reach: frames before the record that the maximum may lie.
        edge_sd: least relative standard deviation of a maximum that is the largest frame.
        ringing_power: power of (smallest x largest radius of a cycle / mean^2) that is, times the
            mean, the rest radius of a bubble that still rings; fitted to 1200 simulated bubbles
            with heat and vapour transport (We 100-1500, R_inf* .08-.45, G .1-30 kPa, mu .003-.2
            Pa s).
        ringing_sd: largest relative standard deviation that the ringing adds: that of this fit.
        ringing_floor: least relative standard deviation of a rest radius from a ringing bubble.
        partial_floor: the same from less than a cycle.
        stated_floor: the same of a stated rest radius.

    >>> from imr_torch.observe.landmarks import RULES
    >>> RULES.settled_below
    0.03
    """

    tail: float = 0.15
    settled_below: float = 0.03
    noisy_tail: float = 1.2
    peak_windows: tuple[float, float] = (0.85, 0.95)
    neighbour: float = 0.75
    largest_excess: float = 0.04
    quartic_from: int = 9
    exposure: float = 0.2
    noise_range: tuple[float, float] = (0.002, 0.02)
    few_frames_noise: float = 0.005
    prior_weight: float = 3.0
    reversal: float = 6.0
    local_reversal: float = 4.5
    local_frames: int = 25
    start_windows: tuple[float, float] = (0.8, 0.9)
    start_frames: int = 8
    start_reach: float = 2.0
    edge_sd: float = 0.01
    ringing_power: float = 2.0 / 3.0
    ringing_sd: float = 0.2
    ringing_floor: float = 0.10
    partial_floor: float = 0.30
    stated_floor: float = 0.01


RULES = LandmarkRules()
"""The rules of :func:`find_landmarks`."""


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of one curve, in SI units.

    Args:
        max_radius_m: maximum radius in m, with ``max_radius_sd_m``.
        max_radius_sd_m: its standard deviation.
        time_of_max_s: its time in s, with ``time_of_max_sd_s``.
        time_of_max_sd_s: its standard deviation.
        max_method: "peak fit", "as given" (the laboratory's value; the record starts after the
            peak), "one-sided fit" (the record begins near it), "edge" (the largest frame), or "as
            stated" (:class:`imr_torch.observe.Override`).
        rest_radius_m: equilibrium radius in m, or None.
        rest_radius_sd_m: its standard deviation, or None.
        rest_settled: whether the bubble has come to rest within the record (a quiet tail, at least
            half a cycle long).
        rest_method: "settled tail", "last cycles", "first rebound", "as given", "as stated", "not
            in record", or "other curves" (:func:`imr_torch.observe.prepare`).
        collapse_times_s: times of the minima after the maximum radius.
        rebound_times_s: times of the maxima after the first collapse.
        rebound_radii_m: their radii.
        frame_noise_m: standard deviation of a frame, estimated from the record.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, find_landmarks
    >>> time = torch.linspace(0.0, 60e-6, 61, dtype=torch.float64)
    >>> landmarks = find_landmarks(RadiusTrace("shot 1", time, 1e-4 * (1.1 + torch.cos(2e5 * time)), "example"))
    >>> [round(float(1e6 * t), 1) for t in landmarks.collapse_times_s]  # us
    [15.7, 47.1]
    """

    max_radius_m: float
    max_radius_sd_m: float
    time_of_max_s: float
    time_of_max_sd_s: float
    max_method: str
    rest_radius_m: float | None
    rest_radius_sd_m: float | None
    rest_settled: bool
    rest_method: str
    collapse_times_s: tuple[float, ...]
    rebound_times_s: tuple[float, ...]
    rebound_radii_m: tuple[float, ...]
    frame_noise_m: float


def find_landmarks(trace: RadiusTrace) -> Landmarks:
    """Find the landmarks of a curve.

    Args:
        trace: the curve.

    Returns:
        The landmarks, with a method for the maximum and the rest radius.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, find_landmarks
    >>> time = torch.linspace(-5e-6, 60e-6, 66, dtype=torch.float64)
    >>> trace = RadiusTrace("shot 1", time, 1e-4 * (1.1 + torch.cos(2e5 * time)), "example")
    >>> landmarks = find_landmarks(trace)
    >>> round(1e6 * landmarks.max_radius_m, 1), landmarks.max_method  # um
    (210.0, 'peak fit')
    """
    curve = _Curve.of(trace)
    peak, method = _peak(curve)
    minima, maxima = _extremes(curve)
    rest, sd, settled, rest_method = _rest(curve, minima, maxima)
    return Landmarks(
        max_radius_m=peak.value,
        max_radius_sd_m=peak.value_sd,
        time_of_max_s=peak.time,
        time_of_max_sd_s=peak.time_sd,
        max_method=method,
        rest_radius_m=rest,
        rest_radius_sd_m=sd,
        rest_settled=settled,
        rest_method=rest_method,
        collapse_times_s=tuple(x.time for x in minima),
        rebound_times_s=tuple(x.time for x in maxima),
        rebound_radii_m=tuple(x.value for x in maxima),
        frame_noise_m=curve.noise,
    )


@dataclass(frozen=True)
class _Curve:
    """A record as arrays, with the frame and radius of its maximum and the noise of a frame in m."""

    time: np.ndarray
    radius: np.ndarray
    given: Given
    noise: float
    k: int
    top: float

    @classmethod
    def of(cls, trace: RadiusTrace) -> "_Curve":
        radius = trace.radius_m.numpy()
        k = int(radius.argmax())
        top = float(radius[k])
        noise = RULES.few_frames_noise * top
        if len(radius) >= 12:
            low, high = RULES.noise_range
            noise = float(np.clip(roughness(radius), low * top, high * top))
        return cls(trace.time_s.numpy(), radius, trace.given, noise, k, top)

    @property
    def spacing(self) -> float:
        """Longest time between the largest frame and one beside it, s."""
        return float(np.diff(self.time)[max(self.k - 1, 0) : self.k + 1].max())


@dataclass(frozen=True)
class _Extreme:
    """A maximum or minimum: time and value with standard deviations."""

    time: float
    value: float
    time_sd: float
    value_sd: float


def roughness(radius: np.ndarray) -> float:
    """Standard deviation of a frame by the median third difference, which a local parabola does not
    change.

    >>> import numpy as np
    >>> from imr_torch.observe.landmarks import roughness
    >>> round(roughness(np.random.default_rng(0).normal(1.0, 0.02, 500)), 2)
    0.02
    """
    if len(radius) < 6:
        return 0.0
    return 1.4826 * float(np.median(np.abs(np.diff(radius, 3)))) / math.sqrt(20.0)


def _window(radius: np.ndarray, k: int, keep: np.ndarray) -> slice:
    """The run of frames round ``k`` in which ``keep`` holds.

    Always with the neighbours of ``k``.
    """
    low = k
    high = k + 1
    while low > 0 and (keep[low - 1] or low == k):
        low -= 1
    while high < len(radius) and (keep[high] or high == k + 1):
        high += 1
    return slice(low, high)


def _fit_extreme(curve: _Curve, window: slice, degree: int, sign: int) -> _Extreme | None:
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
    roots = np.roots(slope)
    inside = roots[(np.abs(roots.imag) < 1e-9) & (np.abs(roots.real) <= 1.0)].real
    vertices = [float(r) for r in inside if sign * np.polyval(np.polyder(slope), r) < 0.0]
    if not vertices:
        return None
    vertex = max(vertices, key=lambda r: sign * float(np.polyval(coefficients, r)))
    residual = radius - basis @ coefficients
    freedom = len(x) - degree - 1
    weight = RULES.prior_weight
    variance = (float(residual @ residual) + weight * curve.noise**2) / (freedom + weight)
    if len(x) >= RULES.quartic_from:
        lag = float(residual[1:] @ residual[:-1]) / max(float(residual @ residual), 1e-300)
        variance *= (1.0 + max(lag, 0.0)) / (1.0 - max(lag, 0.0))
    covariance = variance * np.linalg.pinv(basis.T @ basis)
    at_value = np.vander(np.array([vertex]), degree + 1)[0]
    at_slope = np.array([n * vertex ** (n - 1) if n else 0.0 for n in range(degree, -1, -1)])
    value_sd = math.sqrt(at_value @ covariance @ at_value)
    curvature = abs(float(np.polyval(np.polyder(slope), vertex)))
    time_sd = min(math.sqrt(at_slope @ covariance @ at_slope) / curvature, 2.0) * span
    return _Extreme(
        centre + vertex * span, float(np.polyval(coefficients, vertex)), time_sd, value_sd
    )


def _peak(curve: _Curve) -> tuple[_Extreme, str]:
    """Maximum radius: as it is stated, or else found; what is not stated of it is found."""
    found, method = _found_peak(curve)
    stated = curve.given.override
    if stated is None or (stated.max_radius_m is None and stated.time_of_max_s is None):
        return found, method
    if stated.max_radius_m is not None:
        sd = stated.max_radius_sd_m or curve.noise
        found = replace(found, value=stated.max_radius_m, value_sd=sd)
    if stated.time_of_max_s is not None:
        sd = float(np.median(np.diff(curve.time))) / 2.0
        found = replace(found, time=stated.time_of_max_s, time_sd=sd)
    return found, "as stated"


def _found_peak(curve: _Curve) -> tuple[_Extreme, str]:
    """Maximum radius: a fit where frames stand on both sides of it, else what the laboratory says,
    else a frame.
    """
    radius = curve.radius
    k = curve.k
    top = curve.top
    interior = 0 < k < len(radius) - 1
    found = _fit_peak(curve) if interior else None
    near = interior and min(radius[k - 1], radius[k + 1]) >= RULES.neighbour * top
    if found is not None and near and found.value <= (1.0 + RULES.largest_excess) * top:
        return found, "peak fit"
    at = float(curve.time[k])
    stated = curve.given.max_radius_m
    if stated is not None and abs(stated / top - 1.0) > 1e-6:
        if curve.given.time_of_max_s is not None:
            at = curve.given.time_of_max_s
        sd = curve.given.max_radius_sd_m
        sd = max(curve.noise, abs(stated - top)) if sd is None else sd
        return _Extreme(at, stated, curve.spacing / 2.0, sd), "as given"
    from_start = _fit_start(curve)
    if from_start is not None:
        return from_start, "one-sided fit"
    drop = top - float(radius[k - 1 if k == len(radius) - 1 else k + 1])
    missed = found.value - top if found is not None else min(drop, RULES.ringing_floor * top)
    sd = max(curve.noise, RULES.edge_sd * top, missed)
    return _Extreme(at, top, curve.spacing, sd), "edge"


def _fit_start(curve: _Curve) -> _Extreme | None:
    """Maximum of a record that begins near it, by the frames after it; None if they are few or put
    it well before the record.

    The largest of such frames is late, since noise decides between frames about a flat maximum. Of
    an empty cavity under a constant pressure ``R = Rmax (1 - a s^2 - 2/3 a^2 s^4 + O(s^6))`` at
    ``s`` from the maximum (Rayleigh, Phil. Mag. 34, 1917, expanded), which is even and has three
    parameters. What another window changes is added to the standard deviations.
    """
    top = curve.top
    near = curve.time[curve.radius > RULES.start_windows[0] * top]
    spacing = max(curve.spacing, float(np.ptp(near)) / 40.0)  # of dense frames, several
    fits = []
    for level in RULES.start_windows:
        below = np.flatnonzero(curve.radius < level * top)
        stop = int(below[0]) if len(below) else 0
        if stop <= curve.k or stop < RULES.start_frames:
            return None
        x = (curve.time[:stop] - curve.time[0]) / spacing
        y = curve.radius[:stop] / top
        guess = (1.0, (1.0 - level) / x[-1] ** 2, 0.0)
        error = np.full(stop, curve.noise / top)
        try:
            best, covariance = curve_fit(_near_maximum, x, y, guess, error, absolute_sigma=True)
        except RuntimeError:  # no minimum was found
            return None
        fits.append((best, np.sqrt(covariance.diagonal())))
    (found, sd), (other, _) = fits
    latest = (curve.time[curve.k] - curve.time[0]) / spacing + 1.0
    if not -RULES.start_reach <= found[2] <= latest or sd[2] > RULES.start_reach:
        return None
    value_sd = math.hypot(sd[0], other[0] - found[0])
    time_sd = math.hypot(sd[2], other[2] - found[2])
    return _Extreme(
        float(curve.time[0] + spacing * found[2]),
        top * float(found[0]),
        spacing * time_sd,
        max(curve.noise, top * value_sd),
    )


def _near_maximum(time: np.ndarray, top: float, bend: float, at: float) -> np.ndarray:
    square = bend * (time - at) ** 2
    return top * (1.0 - square - 2.0 / 3.0 * square**2)


def _fit_peak(curve: _Curve) -> _Extreme | None:
    """Fitted maximum near the largest frame; None if frames on both sides do not bracket it.

    What the choice of window changes, the length of an exposure, and half of what the fit adds to
    the largest frame of a coarse record, are added to the standard deviations: the curve is no
    polynomial.
    """
    radius = curve.radius
    k = curve.k
    wide, narrow = (_window(radius, k, radius >= level * curve.top) for level in RULES.peak_windows)
    enough = wide.stop - wide.start >= RULES.quartic_from
    many = enough and min(k - wide.start, wide.stop - 1 - k) >= 3
    found = _fit_extreme(curve, wide, 4 if many else 2, +1)
    ends = max(radius[wide.start], radius[wide.stop - 1])
    if found is None or found.value - ends < 3.0 * curve.noise:
        return None
    if not many:
        excess = 0.5 * max(found.value - curve.top, 0.0)
        return replace(found, value_sd=math.hypot(found.value_sd, excess))
    other = _fit_extreme(curve, narrow, 2, +1) if narrow.stop - narrow.start >= 5 else None
    if other is None:
        return found
    exposure = RULES.exposure * float(np.diff(curve.time[wide]).max())
    return replace(
        found,
        value_sd=math.hypot(found.value_sd, other.value - found.value),
        time_sd=math.hypot(found.time_sd, other.time - found.time, exposure),
    )


def _extremes(curve: _Curve) -> tuple[list[_Extreme], list[_Extreme]]:
    """Minima and maxima after the main maximum, alternating.

    A reversal smaller than the noise is none.
    """
    time = curve.time
    radius = curve.radius
    noise = curve.noise
    minima: list[_Extreme] = []
    maxima: list[_Extreme] = []
    turns = turning_points(radius.tolist(), _reversals(curve).tolist(), curve.k)
    places = [curve.k, *(k for k, _ in turns), len(radius)]
    for low, (k, sign), high in zip(places, turns, places[2:], strict=False):
        swing = min(abs(radius[low] - radius[k]), np.abs(radius[k:high] - radius[k]).max())
        near = np.abs(radius - radius[k]) <= 0.2 * swing
        near[:low], near[high:] = False, False
        found = _fit_extreme(curve, _window(radius, k, near), 2, sign)
        farthest = max(0.3 * swing, 3.0 * noise)
        if found is None or abs(found.value - radius[k]) > farthest:
            apart = float(time[k + 1] - time[k - 1])
            found = _Extreme(float(time[k]), float(radius[k]), apart / 4.0, noise)
        (maxima if sign > 0 else minima).append(found)
    return minima, maxima


def _reversals(curve: _Curve) -> np.ndarray:
    """By how much the curve must turn at each frame to turn by more than its noise can."""
    radius = curve.radius
    count = RULES.local_frames
    starts = (np.arange(len(radius)) - count // 2).clip(0, max(len(radius) - count, 0))
    local = np.full(len(radius), curve.noise)
    if len(radius) >= count:
        local = np.array([roughness(radius[start : start + count]) for start in starts])
    return np.maximum(RULES.reversal * curve.noise, RULES.local_reversal * local)


def _rest(
    curve: _Curve, minima: list[_Extreme], maxima: list[_Extreme]
) -> tuple[float | None, float | None, bool, str]:
    """Rest radius, its sd, whether settled, and the method."""
    given = curve.given
    time = curve.time
    radius = curve.radius
    if given.override is not None and given.override.rest_radius_m is not None:
        stated = given.override.rest_radius_m
        sd = given.override.rest_radius_sd_m or RULES.stated_floor * stated
        return stated, sd, True, "as stated"
    count = max(5, math.ceil(RULES.tail * len(radius)))
    tail = radius[-count:]
    mean = float(tail.mean())
    scatter = float(tail.std(ddof=1)) if count <= len(radius) else math.inf
    came_down = bool(maxima) or mean < 0.6 * curve.top
    turns = sorted([float(time[curve.k]), *(x.time for x in (*minima, *maxima))])
    # A quiet tail shorter than half a cycle may be the flat top of a rebound.
    quiet = float(time[-1]) - min(float(time[-count:][0]), turns[-1])
    came_to_rest = came_down and (len(turns) == 1 or quiet >= float(np.median(np.diff(turns))))
    drift = 0.5 * abs(float(tail[: count // 2].mean() - tail[count // 2 :].mean()))
    if came_to_rest and scatter < RULES.settled_below * mean:
        return mean, math.hypot(scatter, drift), True, "settled tail"
    stated = given.rest_radius_m
    stated_sd = given.rest_radius_sd_m or 0.0
    if stated is not None and given.rest_settled is not False:  # better than what ringing shows
        sure = given.rest_settled or stated_sd
        floor = RULES.stated_floor if sure else RULES.ringing_floor
        return stated, max(stated_sd, floor * stated), True, "as given"
    if came_to_rest and scatter < RULES.noisy_tail * roughness(tail):  # noise may hide ringing
        sd = math.hypot(scatter, drift, RULES.ringing_floor * mean)
        return mean, sd, True, "settled tail"
    if maxima or (minima and time[-1] - minima[0].time > minima[0].time - turns[0]):
        first, last, method = _last_cycles(curve, minima, maxima)
        inside = (time >= first) & (time <= last)
        if inside.sum() >= 3:
            rest, relative_sd = _rest_while_ringing(curve, inside)
            whole = method == "last cycles"
            floor = RULES.ringing_floor if whole else RULES.partial_floor
            return rest, rest * math.hypot(floor, relative_sd), False, method
    if stated is not None:
        return stated, max(stated_sd, RULES.ringing_floor * stated), False, "as given"
    return None, None, False, "not in record"


def _rest_while_ringing(curve: _Curve, inside: np.ndarray) -> tuple[float, float]:
    """Rest radius of a bubble that oscillates, from one cycle, and the relative standard deviation
    that this adds.

    The mean radius is no estimate of it: gas resists compression more than expansion, so a bubble
    is mostly larger than at rest (its mean radius is half as large again where the first rebounds
    are all that was recorded).
    """
    time = curve.time[inside]
    radius = curve.radius[inside]
    power = RULES.ringing_power
    mean = float(np.trapezoid(radius, time) / (time[-1] - time[0]))
    low = float(radius.min())
    high = float(radius.max())
    excess = -power * math.log(low * high / mean**2)
    by_noise = power * roughness(radius) * math.hypot(1.0 / low, 1.0 / high)
    added = min(abs(excess), RULES.ringing_sd)
    return mean * math.exp(-excess), math.hypot(added, by_noise)


def _last_cycles(
    curve: _Curve, minima: list[_Extreme], maxima: list[_Extreme]
) -> tuple[float, float, str]:
    """Bounds in s of the last full cycle, or of what follows it where that is longer (ringing below
    the noise).
    """
    pairs = [(a.time, b.time) for kind in (minima, maxima) for a, b in pairwise(kind)]
    end = float(curve.time[-1])
    if not pairs:
        return minima[0].time, end, "first rebound"
    first, last = max(pairs, key=lambda pair: pair[1])
    if end - last > 1.5 * (last - first):
        return last, end, "last cycles"
    return first, last, "last cycles"
