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
import torch
from jaxtyping import Float, Int
from scipy.optimize import curve_fit
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.reading.traces import RadiusTrace

PEAK_WINDOWS = (0.85, 0.95)
NEIGHBOUR = 0.75
MAX_EXCESS = 0.04
QUARTIC_FROM = 9
NOISE_RANGE = (0.002, 0.02)
DEFAULT_NOISE = 0.005
PRIOR_WEIGHT = 3.0
REVERSAL = 6.0
LOCAL_REVERSAL = 4.5
"""Of the noise of the frames around: noise that grows with time would make cycles of its own in the tail of a record."""
LOCAL_FRAMES = 25
RINGING_POWER = 2.0 / 3.0
"""Of (smallest x largest radius of a cycle / mean^2), times the mean: the rest radius of a bubble that still rings. Fitted to
1200 simulated bubbles with heat and vapour transport (We 100-1500, R_inf* .08-.45, G .1-30 kPa, mu .003-.2 Pa s)."""
RINGING_SD = 0.2
"""Largest relative standard deviation that the ringing adds: that of this fit."""
MIN_RINGING_SD = 0.10
MIN_PARTIAL_SD = 0.30
NOISY_TAIL = 1.2
"""A tail that scatters by no more than this times the noise of its frames has settled."""
MIN_STATED_SD = 0.01
EDGE_SD = 0.01
START_WINDOWS = (0.8, 0.9)
START_FRAMES = 8
START_REACH = 2.0
EXPOSURE = 0.2
ORDINALS = (
    "first",
    "second",
    "third",
    "fourth",
    "fifth",
    "sixth",
    "seventh",
    "eighth",
    "ninth",
    "tenth",
)


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
        growth_samples: number of frames before the maximum radius.
        frame_noise_m: standard deviation of a frame, estimated from the record.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, find_landmarks
    >>> time = torch.linspace(0.0, 60e-6, 61, dtype=torch.float64)
    >>> landmarks = find_landmarks(RadiusTrace("shot 1", time, 1e-4 * (1.1 + torch.cos(2e5 * time)), "example"))
    >>> [round(float(1e6 * t), 1) for t in landmarks.collapse_times_s], landmarks.phase(20e-6)  # us
    ([15.7, 47.1], 'first rebound')
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
    growth_samples: int
    frame_noise_m: float

    @property
    def boundaries_s(self) -> tuple[float, ...]:
        """Times at which one phase ends and the next begins, in order."""
        return tuple(sorted((self.time_of_max_s, *self.collapse_times_s, *self.rebound_times_s)))

    def phase_index(self, time_s: Float[Tensor, "*batch"]) -> Int[Tensor, "*batch"]:
        """Phase of each time: 0 growth, 1 first collapse, 2 first rebound, 3 second collapse, ...

        Args:
            time_s: tensor of any shape, s, on the time axis of the trace.

        Returns:
            Tensor of the same shape, int64.
        """
        edges = torch.tensor(self.boundaries_s, dtype=time_s.dtype, device=time_s.device)
        return torch.bucketize(time_s, edges, right=True)

    def phase(self, time_s: float) -> str:
        """Phase of a time in s, in words: "growth", "first collapse", "first rebound", ..."""
        return phase_name(int(self.phase_index(torch.tensor(time_s, dtype=torch.float64))))


def phase_name(index: int) -> str:
    """Name of a phase number of :meth:`Landmarks.phase_index`."""
    if index == 0:
        return "growth"
    cycle = (index - 1) // 2
    ordinal = ORDINALS[cycle] if cycle < len(ORDINALS) else f"{cycle + 1}th"
    return f"{ordinal} {'collapse' if index % 2 else 'rebound'}"


def find_landmarks(
    trace: RadiusTrace, *, tail_fraction: float = 0.15, settled_below: float = 0.03
) -> Landmarks:
    """Find the landmarks of a curve.

    Args:
        trace: the curve.
        tail_fraction: share of the last frames whose mean is the rest radius, if the bubble has
            settled.
        settled_below: the bubble has settled if std/mean of these frames is below this, over half a
            cycle or more.

    Returns:
        The landmarks, with a method for the maximum and the rest radius.

    Raises:
        InputDataError: if ``tail_fraction`` or ``settled_below`` is not between 0 and 1.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, find_landmarks
    >>> time = torch.linspace(-5e-6, 60e-6, 66, dtype=torch.float64)
    >>> trace = RadiusTrace("shot 1", time, 1e-4 * (1.1 + torch.cos(2e5 * time)), "example")
    >>> landmarks = find_landmarks(trace)
    >>> round(1e6 * landmarks.max_radius_m, 1), landmarks.max_method  # um
    (210.0, 'peak fit')
    """
    for name, value in (("tail_fraction", tail_fraction), ("settled_below", settled_below)):
        if not 0.0 < value < 1.0:
            raise InputDataError(
                f"find_landmarks: {name} is {value}; expected a number between 0 and 1."
            )
    time = trace.time_s.detach().cpu().numpy()
    radius = trace.radius_m.detach().cpu().numpy()
    noise = _frame_noise(radius)
    peak, method = _peak(trace, time, radius, noise)
    minima, maxima = _extremes(time, radius, noise)
    rest, sd, settled, rest_method = _rest(
        trace, time, radius, (minima, maxima), tail_fraction, settled_below
    )
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
        growth_samples=int((time < peak.time).sum()),
        frame_noise_m=noise,
    )


@dataclass(frozen=True)
class _Extreme:
    """A maximum or minimum: time and value with standard deviations."""

    time: float
    value: float
    time_sd: float
    value_sd: float


def _frame_noise(radius: np.ndarray) -> float:
    """Standard deviation of a frame in m, from third differences (they remove a local parabola)."""
    top = float(radius.max())
    if len(radius) < 12:
        return DEFAULT_NOISE * top
    return float(np.clip(roughness(radius), NOISE_RANGE[0] * top, NOISE_RANGE[1] * top))


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


def _fit_extreme(
    time: np.ndarray, radius: np.ndarray, noise: float, degree: int, sign: int
) -> _Extreme | None:
    """Least-squares polynomial and its vertex; None if the vertex is not inside the frames.

    The residual variance is pooled with ``noise**2`` (weight ``PRIOR_WEIGHT`` frames), because a
    few frames cannot determine it, and enlarged where neighbouring residuals agree (edge detection
    and misfit err smoothly). The value varies as the fit at the vertex does (its derivative there
    is zero); the time as the slope there over the curvature.
    """
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
    variance = (float(residual @ residual) + PRIOR_WEIGHT * noise**2) / (freedom + PRIOR_WEIGHT)
    if len(x) >= QUARTIC_FROM:
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


def _peak(
    trace: RadiusTrace, time: np.ndarray, radius: np.ndarray, noise: float
) -> tuple[_Extreme, str]:
    """Maximum radius: as it is stated, or else found; what is not stated of it is found."""
    found, method = _found_peak(trace, time, radius, noise)
    stated = trace.given.override
    if stated is None or (stated.max_radius_m is None and stated.time_of_max_s is None):
        return found, method
    if stated.max_radius_m is not None:
        found = replace(found, value=stated.max_radius_m, value_sd=stated.max_radius_sd_m or noise)
    if stated.time_of_max_s is not None:
        found = replace(
            found, time=stated.time_of_max_s, time_sd=float(np.median(np.diff(time))) / 2.0
        )
    return found, "as stated"


def _found_peak(
    trace: RadiusTrace, time: np.ndarray, radius: np.ndarray, noise: float
) -> tuple[_Extreme, str]:
    """Maximum radius: a fit where frames stand on both sides of it, else what the laboratory says,
    else a frame.
    """
    k = int(radius.argmax())
    top = float(radius[k])
    given = trace.given
    interior = 0 < k < len(radius) - 1
    found = _fit_peak(time, radius, k, noise) if interior else None
    near = interior and min(radius[k - 1], radius[k + 1]) >= NEIGHBOUR * top
    if found is not None and near and found.value <= (1.0 + MAX_EXCESS) * top:
        return found, "peak fit"
    spacing = float(np.diff(time)[max(k - 1, 0) : k + 1].max())
    stated = given.max_radius_m
    if stated is not None and abs(stated / top - 1.0) > 1e-6:
        at = float(time[k]) if given.time_of_max_s is None else given.time_of_max_s
        sd = (
            max(noise, abs(stated - top))
            if given.max_radius_sd_m is None
            else given.max_radius_sd_m
        )
        return _Extreme(at, stated, spacing / 2.0, sd), "as given"
    from_start = _fit_start(time, radius, k, noise)
    if from_start is not None:
        return from_start, "one-sided fit"
    drop = top - float(radius[k - 1 if k == len(radius) - 1 else k + 1])
    missed = found.value - top if found is not None else min(drop, MIN_RINGING_SD * top)
    return _Extreme(float(time[k]), top, spacing, max(noise, EDGE_SD * top, missed)), "edge"


def _fit_start(time: np.ndarray, radius: np.ndarray, k: int, noise: float) -> _Extreme | None:
    """Maximum of a record that begins near it, by the frames after it; None if they are few or put
    it well before the record.

    The largest of such frames is late, since noise decides between frames about a flat maximum. Of
    an empty cavity under a constant pressure ``R = Rmax (1 - a s^2 - 2/3 a^2 s^4 + O(s^6))`` at
    ``s`` from the maximum (Rayleigh, Phil. Mag. 34, 1917, expanded), which is even and has three
    parameters. What another window changes is added to the standard deviations.
    """
    top = float(radius[k])
    spacing = float(np.diff(time)[max(k - 1, 0) : k + 1].max())
    fits = []
    for level in START_WINDOWS:
        below = np.flatnonzero(radius < level * top)
        stop = int(below[0]) if len(below) else 0
        if stop <= k or stop < START_FRAMES:
            return None
        x = (time[:stop] - time[0]) / spacing
        y = radius[:stop] / top
        guess = (1.0, (1.0 - level) / x[-1] ** 2, 0.0)
        error = np.full(stop, noise / top)
        try:
            best, covariance = curve_fit(_near_maximum, x, y, guess, error, absolute_sigma=True)
        except RuntimeError:  # no minimum was found
            return None
        fits.append((best, np.sqrt(covariance.diagonal())))
    (found, sd), (other, _) = fits
    if not -START_REACH <= found[2] <= (time[k] - time[0]) / spacing + 1.0 or sd[2] > START_REACH:
        return None
    value_sd = math.hypot(sd[0], other[0] - found[0])
    time_sd = math.hypot(sd[2], other[2] - found[2])
    return _Extreme(
        float(time[0] + spacing * found[2]),
        top * float(found[0]),
        spacing * time_sd,
        max(noise, top * value_sd),
    )


def _near_maximum(time: np.ndarray, top: float, bend: float, at: float) -> np.ndarray:
    square = bend * (time - at) ** 2
    return top * (1.0 - square - 2.0 / 3.0 * square**2)


def _fit_peak(time: np.ndarray, radius: np.ndarray, k: int, noise: float) -> _Extreme | None:
    """Fitted maximum near frame ``k``; None if frames on both sides do not bracket it.

    What the choice of window changes, the length of an exposure, and half of what the fit adds to
    the largest frame of a coarse record, are added to the standard deviations: the curve is no
    polynomial.
    """
    top = float(radius[k])
    wide, narrow = (_window(radius, k, radius >= level * top) for level in PEAK_WINDOWS)
    many = min(k - wide.start, wide.stop - 1 - k) >= 3 and wide.stop - wide.start >= QUARTIC_FROM
    found = _fit_extreme(time[wide], radius[wide], noise, 4 if many else 2, +1)
    if found is None or found.value - max(radius[wide.start], radius[wide.stop - 1]) < 3.0 * noise:
        return None
    if not many:
        excess = 0.5 * max(found.value - top, 0.0)
        return replace(found, value_sd=math.hypot(found.value_sd, excess))
    other = (
        _fit_extreme(time[narrow], radius[narrow], noise, 2, +1)
        if narrow.stop - narrow.start >= 5
        else None
    )
    if other is None:
        return found
    exposure = EXPOSURE * float(np.diff(time[wide]).max())
    time_sd = math.hypot(found.time_sd, other.time - found.time, exposure)
    return replace(
        found, value_sd=math.hypot(found.value_sd, other.value - found.value), time_sd=time_sd
    )


def _extremes(
    time: np.ndarray, radius: np.ndarray, noise: float
) -> tuple[list[_Extreme], list[_Extreme]]:
    """Minima and maxima after the main maximum, alternating.

    A reversal smaller than the noise is none.
    """
    minima: list[_Extreme] = []
    maxima: list[_Extreme] = []
    turns = _turning_points(radius, int(radius.argmax()), noise)
    for i, (k, sign) in enumerate(turns):
        low = turns[i - 1][0] if i else int(radius.argmax())
        high = turns[i + 1][0] if i + 1 < len(turns) else len(radius)
        swing = min(abs(radius[low] - radius[k]), np.abs(radius[k:high] - radius[k]).max())
        near = np.abs(radius - radius[k]) <= 0.2 * swing
        near[:low], near[high:] = False, False
        window = _window(radius, k, near)
        frame = _Extreme(
            float(time[k]), float(radius[k]), float(time[k + 1] - time[k - 1]) / 4.0, noise
        )
        found = _fit_extreme(time[window], radius[window], noise, 2, sign)
        sensible = found is not None and abs(found.value - radius[k]) <= max(
            0.3 * swing, 3.0 * noise
        )
        (maxima if sign > 0 else minima).append(found if found is not None and sensible else frame)
    return minima, maxima


def _turning_points(radius: np.ndarray, start: int, noise: float) -> list[tuple[int, int]]:
    """Frames where the curve turns by more than the noise can, each with +1 (maximum) or -1
    (minimum).
    """
    turns: list[tuple[int, int]] = []
    places = np.arange(len(radius)) - LOCAL_FRAMES // 2
    last = max(len(radius) - LOCAL_FRAMES, 0)
    near = [radius[k : k + LOCAL_FRAMES] for k in places.clip(0, last)]
    local = np.array([roughness(some) if len(some) >= LOCAL_FRAMES else noise for some in near])
    threshold = np.maximum(REVERSAL * noise, LOCAL_REVERSAL * local)
    sign = -1
    best = start
    for i in range(start + 1, len(radius)):
        if sign * (radius[i] - radius[best]) > 0.0:
            best = i
        elif sign * (radius[best] - radius[i]) > threshold[i]:
            if best > start:
                turns.append((best, sign))
                sign = -sign
            best = i
    return turns


def _rest(
    trace: RadiusTrace,
    time: np.ndarray,
    radius: np.ndarray,
    extremes: tuple[list[_Extreme], list[_Extreme]],
    tail_fraction: float,
    settled_below: float,
) -> tuple[float | None, float | None, bool, str]:
    """Rest radius, its sd, whether settled, and the method."""
    override = trace.given.override
    if override is not None and override.rest_radius_m is not None:
        sd = override.rest_radius_sd_m or MIN_STATED_SD * override.rest_radius_m
        return override.rest_radius_m, sd, True, "as stated"
    minima, maxima = extremes
    count = max(5, math.ceil(tail_fraction * len(radius)))
    tail = radius[-count:]
    mean = float(tail.mean())
    scatter = float(tail.std(ddof=1)) if count <= len(radius) else math.inf
    came_down = bool(maxima) or mean < 0.6 * float(radius.max())
    turns = sorted([float(time[radius.argmax()]), *(x.time for x in (*minima, *maxima))])
    # A quiet tail shorter than half a cycle may be the flat top of a rebound.
    quiet = float(time[-1]) - min(float(time[-count:][0]), turns[-1])
    long_enough = len(turns) == 1 or quiet >= float(np.median(np.diff(turns)))
    came_to_rest = came_down and long_enough
    drift = 0.5 * abs(float(tail[: count // 2].mean() - tail[count // 2 :].mean()))
    if came_to_rest and scatter < settled_below * mean:
        return mean, math.hypot(scatter, drift), True, "settled tail"
    stated = trace.given.rest_radius_m
    stated_sd = trace.given.rest_radius_sd_m or 0.0
    settled = trace.given.rest_settled
    if (
        stated is not None and settled is not False
    ):  # better than what a bubble shows that still oscillates
        floor = MIN_STATED_SD if settled or stated_sd else MIN_RINGING_SD
        return stated, max(stated_sd, floor * stated), True, "as given"
    if came_to_rest and scatter < NOISY_TAIL * roughness(tail):  # ringing that the noise may hide
        return mean, math.hypot(scatter, drift, MIN_RINGING_SD * mean), True, "settled tail"
    if maxima or (minima and time[-1] - minima[0].time > minima[0].time - turns[0]):
        first, last, method = _last_cycles(time, minima, maxima)
        inside = (time >= first) & (time <= last)
        if inside.sum() >= 3:
            rest, relative_sd = _rest_while_ringing(time[inside], radius[inside])
            floor = MIN_RINGING_SD if method == "last cycles" else MIN_PARTIAL_SD
            return rest, rest * math.hypot(floor, relative_sd), False, method
    if stated is not None:
        return stated, max(stated_sd, MIN_RINGING_SD * stated), False, "as given"
    return None, None, False, "not in record"


def _rest_while_ringing(time: np.ndarray, radius: np.ndarray) -> tuple[float, float]:
    """Rest radius of a bubble that oscillates, from one cycle, and the relative standard deviation
    that this adds.

    The mean radius is no estimate of it: gas resists compression more than expansion, so a bubble
        is mostly larger than at rest
    (its mean radius is half as large again where the first rebounds are all that was recorded).
    """
    mean = float(np.trapezoid(radius, time) / (time[-1] - time[0]))
    low = float(radius.min())
    high = float(radius.max())
    excess = -RINGING_POWER * math.log(low * high / mean**2)
    by_noise = RINGING_POWER * roughness(radius) * math.hypot(1.0 / low, 1.0 / high)
    return mean * math.exp(-excess), math.hypot(min(abs(excess), RINGING_SD), by_noise)


def _last_cycles(
    time: np.ndarray, minima: list[_Extreme], maxima: list[_Extreme]
) -> tuple[float, float, str]:
    """Bounds in s of the last full cycle, or of what follows it where that is longer (ringing below
    the noise).
    """
    pairs = [(a.time, b.time) for kind in (minima, maxima) for a, b in pairwise(kind)]
    end = float(time[-1])
    if not pairs:
        return minima[0].time, end, "first rebound"
    first, last = max(pairs, key=lambda pair: pair[1])
    if end - last > 1.5 * (last - first):
        return last, end, "last cycles"
    return first, last, "last cycles"
