"""From curves in SI units to the dimensionless, windowed experiments that are fitted, with what was
found on the way.
"""

import math
from dataclasses import dataclass, replace
from statistics import fmean, pstdev

import torch

from imr_torch.errors import InputDataError, about_experiment
from imr_torch.html import render
from imr_torch.observe.convert import to_experiment
from imr_torch.observe.experiments import Experiment
from imr_torch.observe.landmarks import Landmarks, find_landmarks
from imr_torch.observe.nuisance import FLOOR
from imr_torch.observe.plausibility import (
    RANGES,
    RAYLEIGH_TIME,
    check_experiment,
    check_maximum,
)
from imr_torch.reading.traces import MIN_SAMPLES, RadiusTrace, TraceSet
from imr_torch.units import Surroundings


@dataclass(frozen=True)
class Prepared:
    """Curves as they will be fitted.

    Args:
        experiments: dimensionless, from the maximum radius to the end of the window, one a curve.
        landmarks: landmarks of each curve, by experiment id.
        frames: of each curve: how many it has, how many of these before its maximum, and how many
            after the window.
        first_collapses: their dimensionless times; infinite where a record holds none.
        assumed: whether the rest radius is the caller's, not the record's.
        cautions: what is unusual about them, a sentence each.
        traces: the records, dense ones without the frames that were thinned out.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, TraceSet, prepare
    >>> time = torch.linspace(-2e-6, 60e-6, 63, dtype=torch.float64)
    >>> trace = RadiusTrace("shot 1", time, 200e-6 * (0.55 + 0.45 * torch.cos(1.6e5 * time)), "gel.csv")
    >>> print(prepare(TraceSet((trace,)), rest_radius=(0.2, 0.02), collapses=1).report()[:131])
    Curves as they are fitted (an empty cavity collapses at t* = 0.915):
      shot 1: Rmax 199.9 um (peak fit), R_inf/Rmax 0.200 (assumed)
    """

    experiments: tuple[Experiment, ...]
    landmarks: dict[str, Landmarks]
    frames: dict[str, tuple[int, int, int]]
    first_collapses: dict[str, float]
    assumed: bool
    cautions: tuple[str, ...]
    traces: TraceSet

    def report(self, *, frames: bool = True) -> str:
        """A line a curve: Rmax, R_inf*, We, how each was found, and how many ``frames`` will be
        fitted; then the cautions.
        """
        text = render(
            "prepared.txt", found=self, frames=frames, cavity=RAYLEIGH_TIME, never=math.inf
        )
        return text.rstrip("\n")


def prepare(
    traces: TraceSet,
    surroundings: Surroundings = Surroundings(),
    *,
    collapses: int = 2,
    rest_radius: tuple[float, float] | None = None,
    growth: float | None = None,
    most_frames: int = 1000,
) -> Prepared:
    """Dimensionless experiments of a set of traces, cut after ``collapses`` collapses or at the
    stated end of a window.

    A dense record is thinned evenly, after its landmarks were read off all its frames.

    Args:
        traces: the curves.
        surroundings: the liquid side, for the scales; water at 1 atm by default.
        collapses: collapses that the window holds.
        rest_radius: assumed R_inf/Rmax and its standard deviation, for records that do not hold it.
        growth: R/Rmax above which frames before the maximum are kept too; none when not given.
        most_frames: of one record; no frame is left out that would leave a gap of t* = 0.02.

    Raises:
        InputDataError: for a curve that no bubble has (:mod:`imr_torch.observe.plausibility`), a
            record without R_inf, or with too few frames in the window.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, TraceSet, prepare
    >>> time = torch.linspace(-2e-6, 60e-6, 63, dtype=torch.float64)
    >>> trace = RadiusTrace("shot 1", time, 200e-6 * (0.55 + 0.45 * torch.cos(1.6e5 * time)), "gel.csv")
    >>> prepared = prepare(TraceSet((trace,)), rest_radius=(0.2, 0.02), collapses=1)
    >>> prepared.frames["shot 1"], round(prepared.first_collapses["shot 1"], 2)
    ((63, 2, 40), 0.98)
    """
    if collapses < 1:
        raise InputDataError(
            f"collapses is {collapses}; the fitted window needs at least 1."
        )
    if rest_radius is not None and not (
        0.0 < rest_radius[0] < 1.0 and 0.0 <= rest_radius[1] < math.inf
    ):
        raise InputDataError(
            f"rest_radius is {rest_radius[0]:g}:{rest_radius[1]:g}; expected R_inf/Rmax between 0 "
            "and 1 and a standard deviation >= 0, for example 0.2:0.1."
        )
    landmarks = {trace.experiment_id: find_landmarks(trace) for trace in traces}
    cautions = [] if rest_radius else _borrow_rest_radii(landmarks)
    experiments = []
    frames = {}
    firsts = {}
    kept = []
    for record in traces:
        name = record.experiment_id
        marks = landmarks[name]
        with about_experiment(name):
            cautions += check_maximum(record, marks, surroundings)
            trace = _thin_dense_record(
                record, surroundings.time_scale(marks.max_radius_m), most_frames
            )
            kept.append(trace)
            if len(trace) < len(record):
                cautions.append(
                    f"{len(trace)} of the {len(record)} frames of '{name}' are used, evenly spread: "
                    "so many more would change little."
                )
            whole = to_experiment(
                trace, marks, surroundings, rest_radius=rest_radius, growth=growth
            )
            first = _first_collapse(whole, marks, surroundings)
            cut = marks.max_method == "edge"
            remedy = "and that the record begins at its maximum radius" if cut else ""
            cautions += check_experiment(
                whole, trace.where, first=first, cut=cut, remedy=remedy
            )
            window = _cut_window(trace, whole, marks, surroundings, collapses)
        experiments.append(window)
        frames[name] = (
            len(trace),
            len(trace) - len(whole.times),
            len(whole.times) - len(window.times),
        )
        firsts[name] = first
    cautions += render(
        "prepared_cautions.txt",
        experiments=experiments,
        traces=traces,
        landmarks=landmarks,
        rest=rest_radius is None,
        floor=FLOOR.max_radius,
        own=("as given", "as stated"),
    ).splitlines()
    return Prepared(
        tuple(experiments),
        landmarks,
        frames,
        firsts,
        rest_radius is not None,
        tuple(cautions),
        replace(traces, traces=tuple(kept)),
    )


def _thin_dense_record(trace: RadiusTrace, time_scale: float, most: int) -> RadiusTrace:
    """Every n-th frame of a record of more than ``most`` frames, none further apart than .02
    in t*.
    """
    spacing = float(trace.time_s.diff().median()) / time_scale
    stride = min(-(-len(trace) // most), int(0.02 / spacing))
    if stride < 2:
        return trace
    frames = {
        name: x[::stride] for name, x in vars(trace).items() if isinstance(x, torch.Tensor)
    }
    return replace(trace, **frames)


def _first_collapse(
    whole: Experiment, marks: Landmarks, surroundings: Surroundings
) -> float:
    """:func:`_collapse_frame` of the first.

    Of a bubble that has come down long before it, a late minimum is noise and none.
    """
    first = _collapse_frame(whole, marks, surroundings, 1)
    radius = whole.radius[0]
    latest = RANGES["first_collapse"].possible[1]
    low = (radius < 0.5 * (radius.max() + radius.min())) & (whole.times > 0.0)
    came_down = whole.times[low.double().argmax()]
    return math.inf if first > latest >= 2.0 * float(came_down) else first


def _borrow_rest_radii(landmarks: dict[str, Landmarks]) -> list[str]:
    """Gives curves whose record does not hold R_inf that of the others, over Rmax and with an error
    of .4 of it or more, and says so.
    """
    ratios = [
        m.rest_radius_m / m.max_radius_m
        for m in landmarks.values()
        if m.rest_radius_m is not None
    ]
    lacking = [name for name, marks in landmarks.items() if marks.rest_radius_m is None]
    if not ratios or not lacking:
        return []
    value = fmean(ratios)
    sd = max(0.4 * value, pstdev(ratios))
    for name in lacking:
        top = landmarks[name].max_radius_m
        landmarks[name] = replace(
            landmarks[name],
            rest_radius_m=value * top,
            rest_radius_sd_m=sd * top,
            rest_method="other curves",
        )
    names = ", ".join(f"'{name}'" for name in lacking)
    return [
        f"The record of {names} holds no rebound and no R_inf is stated, so R_inf/Rmax is taken to "
        f"be about that of the other curves, {value:.2f} +- {sd:.2f}. State it if it is known."
    ]


def _collapse_frame(
    whole: Experiment, marks: Landmarks, surroundings: Surroundings, number: int
) -> float:
    """Dimensionless time of the lowest frame of a collapse (1 is the first).

    Infinite where the record does not hold it.
    """
    if len(marks.collapse_times_s) < number:
        return math.inf
    at = marks.dimensionless_time(marks.collapse_times_s[number - 1], surroundings)
    near = (whole.times - at).abs().argsort()[:2]
    return float(whole.times[near[whole.radius[0, near].argmin()]])


def _cut_window(
    trace: RadiusTrace,
    whole: Experiment,
    marks: Landmarks,
    surroundings: Surroundings,
    collapses: int,
) -> Experiment:
    """The frames that are fitted: up to the stated end of the window, else up to a collapse."""
    override = trace.given.override
    last = f"collapse {collapses}"
    end = _collapse_frame(whole, marks, surroundings, collapses)
    remedy = "Raise the number of collapses, or leave it out."
    if override is not None and override.window_end_s is not None:
        end = marks.dimensionless_time(override.window_end_s, surroundings)
        last = f"the stated end of the window at {1e6 * override.window_end_s:.4g} us"
        remedy = (
            "State a later window_end_s, on the time axis of the file, or leave it out."
        )
    if (count := int((whole.times <= end).sum())) < MIN_SAMPLES:
        raise InputDataError(
            f"{trace.where} has {count} frames between its maximum and {last}; at least "
            f"{MIN_SAMPLES} are needed. {remedy}"
        )
    return whole.until(end)
