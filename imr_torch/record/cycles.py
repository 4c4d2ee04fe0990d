"""The cycles of a record: wall pressure in growth and collapse, chord, skewness, and the viscosity
and modulus that each looks like.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.files import Document
from imr_torch.observe.landmarks import Landmarks
from imr_torch.observe.plausibility import RAYLEIGH_TIME
from imr_torch.reading.traces import RadiusTrace
from imr_torch.record.balance import Contents, Frames, SmoothCurve, fit_medium, smooth_cycle
from imr_torch.simulate.conditions import saturation_pressure
from imr_torch.units import Surroundings


@dataclass(frozen=True)
class RecordOptions:
    """How a record is read.

    Args:
        lowest: radius, of the maximum of a cycle, down to which its frames are used; the chord and
            the skewness are taken at .5.
        above_rest: the same over R_inf, since nearer to it the contents push back.
        least_frames: of a cycle.
        beyond: frames by which a curve is continued: the level of the chord lies between two.
        cycles: that are described.
        odd: prior probability that a shot stands out in one quantity.
        odd_noisy: the same where its error is more than twice that of the shots in the middle: a bad
            focus makes noise that hides what else it does.
        wide: standard deviation of shots that stand out, over that of the others.
        scatter: of the shots of a set that a prior takes for likely: of the chord, of the skewness,
            and of the viscosity over its median.
        odd_weight: of a shot that stands out, in fits (:meth:`imr_torch.record.Record.weighted`); 1
            lets all shots count alike. Of .02 a shot beside a wall still moved G by 8 %.

    Raises:
        InputDataError: if frames down to .5 are not used.

    >>> from imr_torch.record import RecordOptions
    >>> RecordOptions(cycles=1).lowest
    0.45
    """

    lowest: float = 0.45
    above_rest: float = 1.3
    least_frames: int = 9
    beyond: float = 1.0
    cycles: int = 3
    odd: float = 0.1
    odd_noisy: float = 0.3
    wide: float = 5.0
    scatter: tuple[float, float, float] = (0.01, 0.01, 0.15)
    odd_weight: float = 0.001

    def __post_init__(self) -> None:
        if not 0.1 <= self.lowest <= 0.5:
            raise InputDataError(
                f"RecordOptions.lowest is {self.lowest:g}; expected .1 to .5 of the maximum radius."
            )


ALL_ALIKE = RecordOptions(odd_weight=1.0)
"""Shots that stand out are named, and count as much in fits as the others."""


@dataclass(frozen=True, eq=False)
class Cycle:
    """Growth to one maximum and the collapse from it.

    Args:
        number: 1 is the cycle of the largest radius.
        max_radius_m: R_k, m.
        frames: that were used.
        levels: radii over R_k at which pressures are given, increasing.
        growth: wall pressure over p_inf less 1 at the levels, in growth; NaN where not recorded.
            An empty cavity has -1.
        growth_sd: its standard deviation.
        collapse: the same in collapse.
        collapse_sd: its standard deviation.
        viscosity: Pa s.
        viscosity_sd: Pa s.
        modulus: Pa; negative where the curve is faster than pressure, density and contents allow.
            Without a rest radius that of a large stretch.
        modulus_sd: Pa.
        chord: time above half of R_k over that of a lossless bubble of the same contents; twice the
            time from the maximum where growth was not recorded; NaN where the record does not reach
            so low.
        chord_sd: its standard deviation.
        skewness: middle of the chord at .5 R_k less that at .95 R_k, over the Rayleigh time .915 R_k
            sqrt(rho/p_inf); 0 for a lossless bubble. NaN without growth.
        skewness_sd: its standard deviation.

    >>> import numpy as np
    >>> import torch
    >>> from imr_torch.record import describe_record
    >>> from imr_torch.observe import RadiusTrace, TraceSet
    >>> time = np.linspace(-24e-6, 24e-6, 97)
    >>> trace = RadiusTrace("shot 1", torch.tensor(time), torch.tensor(2e-4 * np.cos(6e4 * time) ** 0.4), "example")
    >>> cycle = describe_record(TraceSet((trace,))).shots[0].cycles[0]
    >>> bool(np.nanmax(abs(cycle.collapse - cycle.growth)) < 0.05), abs(cycle.skewness) < 0.01  # a curve that is even in time
    (True, True)
    """

    number: int
    max_radius_m: float
    frames: int
    levels: np.ndarray
    growth: np.ndarray
    growth_sd: np.ndarray
    collapse: np.ndarray
    collapse_sd: np.ndarray
    viscosity: float
    viscosity_sd: float
    modulus: float
    modulus_sd: float
    chord: float
    chord_sd: float
    skewness: float
    skewness_sd: float

    def to_dict(self) -> Document:
        """JSON-ready but for NaN."""
        arrays = ("levels", "growth", "growth_sd", "collapse", "collapse_sd")
        return vars(self) | {name: getattr(self, name).tolist() for name in arrays}


def describe_cycles(
    trace: RadiusTrace, marks: Landmarks, surroundings: Surroundings, options: RecordOptions
) -> tuple[Cycle, ...]:
    """The cycles of a record that have frames enough, the largest first in time order.

    Args:
        trace: the record, with its growth.
        marks: its landmarks.
        surroundings: the liquid side.
        options: how it is read.
    """
    tops = [(marks.time_of_max_s, marks.max_radius_m)]
    tops += zip(marks.rebound_times_s, marks.rebound_radii_m, strict=True)
    found = [
        _describe_cycle(trace, marks, surroundings, options, number, *top)
        for number, top in enumerate(tops[: options.cycles], start=1)
    ]
    return tuple(cycle for cycle in found if cycle is not None)


def _describe_cycle(
    trace: RadiusTrace,
    marks: Landmarks,
    surroundings: Surroundings,
    options: RecordOptions,
    number: int,
    time: float,
    top: float,
) -> Cycle | None:
    """One cycle about a maximum; None where it has too few frames, or these form no maximum."""
    unit = float(surroundings.time_scale(top))
    rest = (marks.rest_radius_m or 0.0) / top
    floor = max(options.lowest, options.above_rest * rest)
    t = (trace.time_s.numpy() - time) / unit
    y = trace.radius_m.numpy() / top
    kept = (y > floor) & (y < 1.03)
    runs = np.cumsum(np.diff(kept, prepend=False))
    kept &= runs == runs[np.abs(t).argmin()]
    few = options.least_frames // 2  # of one branch
    grew = int((kept & (t < 0.0)).sum()) >= few
    kept &= grew | (t >= 0.0)
    t = t[kept]
    y = y[kept]
    if len(t) < options.least_frames or (t > 0.0).sum() < few or floor > 0.9:
        return None
    known_still = marks.frame_noise_m / top / max(marks.time_of_max_sd_s / unit, 1e-3)
    frames = Frames(t, y, 0.0 if grew else known_still)
    far = surroundings.far_field_pressure
    vapour = saturation_pressure(surroundings.temperature) / far
    sound = surroundings.sound_speed / surroundings.velocity_scale
    contents = Contents(rest, float(surroundings.weber(top)), vapour, sound)
    curve = smooth_cycle(frames, contents, beyond=options.beyond)
    if not 0.9 < curve.y.max() < 1.1:
        return None
    units = np.array([far * unit, far])
    (viscosity, modulus), (viscosity_sd, modulus_sd) = (
        (units * values).tolist() for values in fit_medium(frames, curve, contents)
    )
    levels = np.linspace(np.ceil(50.0 * floor) / 50.0, 0.98, 25)
    growth, growth_sd = _read_pressures(_take_branch(curve, -1), levels)
    collapse, collapse_sd = _read_pressures(_take_branch(curve, 1), levels)
    return Cycle(
        number=number,
        max_radius_m=top * float(curve.y.max()),
        frames=len(t),
        levels=levels,
        growth=growth,
        growth_sd=growth_sd,
        collapse=collapse,
        collapse_sd=collapse_sd,
        viscosity=viscosity,
        viscosity_sd=viscosity_sd,
        modulus=modulus,
        modulus_sd=modulus_sd,
        **_chord_and_skewness(curve, contents),
    )


def _take_branch(curve: SmoothCurve, side: int) -> SmoothCurve:
    """Growth (-1) or collapse (1), from the smallest radius to the maximum."""
    rows = slice(int(curve.y.argmax()), None, side)
    return SmoothCurve(*(values[rows][::-1] for values in curve))


def _read_pressures(
    branch: SmoothCurve, levels: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Wall pressure at levels of one branch, and its error; NaN outside of it."""
    read = partial(np.interp, levels, branch.y, left=np.nan, right=np.nan)
    return read(branch.p), read(branch.p_sd)


def _find_crossing(branch: SmoothCurve, level: float) -> tuple[float, float]:
    """Time at which a branch passes a level of the maximum, and its error; NaN where it does not."""
    read = partial(np.interp, level, branch.y / branch.y[-1], left=np.nan)
    return read(branch.t), read(branch.y_sd) / abs(read(branch.u))


def _chord_and_skewness(curve: SmoothCurve, contents: Contents) -> dict[str, float]:
    """Of :class:`Cycle`, with their errors."""
    top = int(curve.y.argmax())
    ends = np.array(
        [
            [_find_crossing(_take_branch(curve, side), level) for side in (-1, 1)]
            for level in (0.5, 0.95)
        ]
    )
    times = ends[..., 0]
    sds = ends[..., 1]
    skewness = (times[0].mean() - times[1].mean()) / (RAYLEIGH_TIME * curve.y[top])
    skewness_sd = 0.5 * np.sqrt((sds**2).sum()) / RAYLEIGH_TIME
    if np.isnan(times[0, 0]):
        times[0, 0] = 2.0 * curve.t[top] - times[0, 1]
        sds[0, 0] = sds[0, 1]
    lossless = 2.0 * contents.lossless_half_chord(0.5) * curve.y[top]
    chord = (times[0, 1] - times[0, 0]) / lossless
    chord_sd = np.hypot(np.sqrt((sds[0] ** 2).sum()) / lossless, curve.y_sd[top] * chord)
    found = {
        "chord": chord,
        "chord_sd": chord_sd,
        "skewness": skewness,
        "skewness_sd": skewness_sd,
    }
    return {name: float(value) for name, value in found.items()}
