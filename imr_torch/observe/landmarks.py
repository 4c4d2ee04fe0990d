"""Landmarks of a curve: maximum radius and its time, collapses, rebounds, rest radius, phases.

Every landmark comes from a local least-squares fit (:mod:`~imr_torch.observe.extremes`). Where the
record does not hold a landmark (growth cut off, no rebound), the result says so in its method rather
than guessing.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import curve_fit

from imr_torch.observe.extremes import (
    RULES,
    Curve,
    Extreme,
    find_extremes,
    fit_extreme,
    frame_roughness,
    grow_window,
)
from imr_torch.reading.traces import RadiusTrace
from imr_torch.units import Number, Surroundings


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
        rest_method: "settled tail" (the bubble has come to rest within the record: a quiet tail, at
            least half a cycle long), "last cycles", "first rebound", "as given", "as stated", "not in
            record", or "other curves" (:func:`imr_torch.observe.prepare`).
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
    rest_method: str
    collapse_times_s: tuple[float, ...]
    rebound_times_s: tuple[float, ...]
    rebound_radii_m: tuple[float, ...]
    frame_noise_m: float

    def dimensionless_time(self, time_s: Number, surroundings: Surroundings) -> Number:
        """Times on the time axis of the trace, s (numbers or a tensor), as t*: 0 at the maximum
        radius.
        """
        return (time_s - self.time_of_max_s) / surroundings.time_scale(self.max_radius_m)


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
    curve = Curve.of(trace)
    peak, method = _find_peak(curve)
    minima, maxima = find_extremes(curve)
    rest, sd, rest_method = _find_rest(curve, minima, maxima)
    return Landmarks(
        max_radius_m=peak.value,
        max_radius_sd_m=peak.value_sd,
        time_of_max_s=peak.time,
        time_of_max_sd_s=peak.time_sd,
        max_method=method,
        rest_radius_m=rest,
        rest_radius_sd_m=sd,
        rest_method=rest_method,
        collapse_times_s=tuple(x.time for x in minima),
        rebound_times_s=tuple(x.time for x in maxima),
        rebound_radii_m=tuple(x.value for x in maxima),
        frame_noise_m=curve.noise,
    )


def _find_peak(curve: Curve) -> tuple[Extreme, str]:
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


def _found_peak(curve: Curve) -> tuple[Extreme, str]:
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
    given = curve.given
    stated = given.max_radius_m
    if stated is not None and abs(stated / top - 1.0) > 1e-6:
        at = at if given.time_of_max_s is None else given.time_of_max_s
        sd = given.max_radius_sd_m
        sd = max(curve.noise, abs(stated - top)) if sd is None else sd
        return Extreme(at, stated, curve.spacing / 2.0, sd), "as given"
    if (from_start := _fit_start(curve)) is not None:
        return from_start, "one-sided fit"
    drop = top - float(radius[k - 1 if k == len(radius) - 1 else k + 1])
    missed = (
        found.value - top if found is not None else min(drop, RULES.ringing_floor * top)
    )
    sd = max(curve.noise, RULES.edge_sd * top, missed)
    return Extreme(at, top, curve.spacing, sd), "edge"


def _fit_start(curve: Curve) -> Extreme | None:
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
            best, covariance = curve_fit(
                _near_maximum, x, y, guess, error, absolute_sigma=True
            )
        except RuntimeError:  # no minimum was found
            return None
        fits.append((best, np.sqrt(covariance.diagonal())))
    (found, sd), (other, _) = fits
    latest = (curve.time[curve.k] - curve.time[0]) / spacing + 1.0
    if not -RULES.start_reach <= found[2] <= latest or sd[2] > RULES.start_reach:
        return None
    value_sd = math.hypot(sd[0], other[0] - found[0])
    time_sd = math.hypot(sd[2], other[2] - found[2])
    return Extreme(
        float(curve.time[0] + spacing * found[2]),
        top * float(found[0]),
        spacing * time_sd,
        max(curve.noise, top * value_sd),
    )


def _near_maximum(time: np.ndarray, top: float, bend: float, at: float) -> np.ndarray:
    square = bend * (time - at) ** 2
    return top * (1.0 - square - 2.0 / 3.0 * square**2)


def _fit_peak(curve: Curve) -> Extreme | None:
    """Fitted maximum near the largest frame; None if frames on both sides do not bracket it.

    What the choice of window changes, the length of an exposure, and half of what the fit adds to
    the largest frame of a coarse record, are added to the standard deviations: the curve is no
    polynomial.
    """
    radius = curve.radius
    k = curve.k
    wide, narrow = (
        grow_window(k, radius >= level * curve.top) for level in RULES.peak_windows
    )
    enough = wide.stop - wide.start >= RULES.quartic_from
    many = enough and min(k - wide.start, wide.stop - 1 - k) >= 3
    found = fit_extreme(curve, wide, 4 if many else 2, +1)
    ends = max(radius[wide.start], radius[wide.stop - 1])
    if found is None or found.value - ends < 3.0 * curve.noise:
        return None
    if not many:
        excess = 0.5 * max(found.value - curve.top, 0.0)
        return replace(found, value_sd=math.hypot(found.value_sd, excess))
    other = fit_extreme(curve, narrow, 2, +1) if narrow.stop - narrow.start >= 5 else None
    if other is None:
        return found
    exposure = RULES.exposure * float(np.diff(curve.time[wide]).max())
    return replace(
        found,
        value_sd=math.hypot(found.value_sd, other.value - found.value),
        time_sd=math.hypot(found.time_sd, other.time - found.time, exposure),
    )


def _find_rest(
    curve: Curve, minima: list[Extreme], maxima: list[Extreme]
) -> tuple[float | None, float | None, str]:
    """Rest radius, its sd, and the method."""
    given = curve.given
    time = curve.time
    radius = curve.radius
    if given.override is not None and given.override.rest_radius_m is not None:
        stated = given.override.rest_radius_m
        sd = given.override.rest_radius_sd_m or RULES.stated_floor * stated
        return stated, sd, "as stated"
    count = max(5, math.ceil(RULES.tail * len(radius)))
    tail = radius[-count:]
    mean = float(tail.mean())
    scatter = float(tail.std(ddof=1)) if count <= len(radius) else math.inf
    came_down = bool(maxima) or mean < 0.6 * curve.top
    turns = sorted([float(time[curve.k]), *(x.time for x in (*minima, *maxima))])
    # A quiet tail shorter than half a cycle may be the flat top of a rebound.
    quiet = float(time[-1]) - min(float(time[-count:][0]), turns[-1])
    came_to_rest = came_down and (
        len(turns) == 1 or quiet >= float(np.median(np.diff(turns)))
    )
    drift = 0.5 * abs(float(tail[: count // 2].mean() - tail[count // 2 :].mean()))
    if came_to_rest and scatter < RULES.settled_below * mean:
        return mean, math.hypot(scatter, drift), "settled tail"
    stated = given.rest_radius_m
    stated_sd = given.rest_radius_sd_m or 0.0
    if (
        stated is not None and given.rest_settled is not False
    ):  # better than what ringing shows
        sure = given.rest_settled or stated_sd
        floor = RULES.stated_floor if sure else RULES.ringing_floor
        return stated, max(stated_sd, floor * stated), "as given"
    # noise may hide ringing
    if came_to_rest and scatter < RULES.noisy_tail * frame_roughness(tail):
        sd = math.hypot(scatter, drift, RULES.ringing_floor * mean)
        return mean, sd, "settled tail"
    if maxima or (minima and time[-1] - minima[0].time > minima[0].time - turns[0]):
        first, last, method = _last_cycles(curve, minima, maxima)
        inside = (time >= first) & (time <= last)
        if inside.sum() >= 3:
            rest, relative_sd = _rest_while_ringing(curve, inside)
            whole = method == "last cycles"
            floor = RULES.ringing_floor if whole else RULES.partial_floor
            return rest, rest * math.hypot(floor, relative_sd), method
    if stated is not None:
        return stated, max(stated_sd, RULES.ringing_floor * stated), "as given"
    return None, None, "not in record"


def _rest_while_ringing(curve: Curve, inside: np.ndarray) -> tuple[float, float]:
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
    rough = frame_roughness(radius)
    # noise may take a frame next to a collapse to nothing
    low = max(float(radius.min()), 3.0 * rough)
    high = float(radius.max())
    excess = -power * math.log(low * high / mean**2)
    by_noise = power * rough * math.hypot(1.0 / low, 1.0 / high)
    added = min(abs(excess), RULES.ringing_sd)
    return mean * math.exp(-excess), math.hypot(added, by_noise)


def _last_cycles(
    curve: Curve, minima: list[Extreme], maxima: list[Extreme]
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
