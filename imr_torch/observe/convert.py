"""Conversion of a trace in SI units to a dimensionless experiment: Rmax, time zero and R_inf taken
from its landmarks.

What the landmarks do not know exactly becomes the experiment's nuisances, with floors for what no
fit sees (pixel size, edge detection): 0.3 % of Rmax, 0.004 in t*, 1 % of R_inf. Which frames of a
record were fitted, and why the others were not, is said by :func:`find_frame_use`.

Sets of designs x repeats x frames, one ``.npz`` file, are made dimensionless by the Weber numbers that
are in it.
"""

import math
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import torch

from imr_torch.errors import InputDataError
from imr_torch.files import Document
from imr_torch.html import render
from imr_torch.observe.experiments import Experiment
from imr_torch.observe.landmarks import Landmarks
from imr_torch.observe.nuisance import FLOOR, Nuisance
from imr_torch.observe.plausibility import check_experiment
from imr_torch.reading.content import read_arrays
from imr_torch.reading.traces import RadiusTrace
from imr_torch.units import Surroundings

_SHAPES = {"time_s": 2, "radius_m": 3, "we": 1, "rinf_star": 1}


def to_experiment(
    trace: RadiusTrace,
    landmarks: Landmarks,
    surroundings: Surroundings,
    *,
    rest_radius: tuple[float, float] | None = None,
    growth: float | None = None,
    widest: float = 0.5,
) -> Experiment:
    """Make a trace dimensionless, from its maximum radius on, or from its growth.

    Args:
        trace: the curve.
        landmarks: its landmarks.
        surroundings: the liquid side, for the scales.
        rest_radius: assumed R_inf/Rmax and its standard deviation, in place of what the record
            says.
        growth: R/Rmax above which frames before the maximum are kept too; none when not given.
        widest: largest standard deviation of a nuisance, beyond which a normal law means nothing.

    Returns:
        The experiment, one repeat.

    Raises:
        InputDataError: if R_inf is neither in the record nor given, or not below Rmax.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, find_landmarks, to_experiment
    >>> from imr_torch.units import Surroundings
    >>> time = torch.linspace(0.0, 60e-6, 61, dtype=torch.float64)
    >>> trace = RadiusTrace("shot 1", time, 200e-6 * (0.55 + 0.45 * torch.cos(2e5 * time)), "example")
    >>> experiment = to_experiment(trace, find_landmarks(trace), Surroundings(), rest_radius=(0.2, 0.02))
    >>> round(experiment.design[0], 1), experiment.design[1]  # We and R_inf*
    (180.9, 0.2)
    """
    top = landmarks.max_radius_m
    if rest_radius is None:
        if landmarks.rest_radius_m is None or landmarks.rest_radius_sd_m is None:
            raise InputDataError(
                f"{trace.where} has no rebound and no given "
                "R_inf, so the rest radius cannot be measured from it. Give it: rest_radius=(value, "
                "sd) of R_inf/Rmax (on the command line --rest-radius 0.2:0.1), or Rinf_m in the "
                "JSON beside the file."
            )
        value = landmarks.rest_radius_m / top
        sd = landmarks.rest_radius_sd_m / top
    else:
        value, sd = rest_radius
    if not 0.0 < value < 1.0:
        remedy = (
            "Give another assumed rest radius."
            if rest_radius
            else "Give the rest radius with rest_radius=(value, sd)."
        )
        raise InputDataError(
            f"{trace.where}: R_inf/Rmax is {value:.3f} (R_inf {1e6 * value * top:.1f} um, Rmax "
            f"{1e6 * top:.1f} um); expected a rest radius below the maximum radius. {remedy}"
        )
    scale = surroundings.time_scale(top)
    times = landmarks.dimensionless_time(trace.time_s, surroundings)
    kept = times >= 0.0
    if growth is not None:
        below = times[~kept & (trace.radius_m < growth * top)]
        kept = times > (below[-1] if len(below) else -torch.inf)
    errors = {
        "max_radius": landmarks.max_radius_sd_m / top,
        "time_zero": landmarks.time_of_max_sd_s / scale,
        "rest_radius": sd / value,
    }
    nuisance = Nuisance(
        **{
            name: min(math.hypot(error, getattr(FLOOR, name)), widest)
            for name, error in errors.items()
        }
    )
    design = (surroundings.weber(top), value)
    exposure = (trace.given.exposure_s or 0.0) / scale
    return Experiment(
        trace.experiment_id,
        design,
        times[kept],
        trace.radius_m[kept][None] / top,
        nuisance,
        exposure,
    )


@dataclass(frozen=True)
class Unused:
    """Frames side by side that were not fitted.

    Args:
        first: number of the first, counted from 0.
        last: number of the last.
        start_s: time of the first, s, on the time axis of the record.
        end_s: time of the last, s.
        reason: why.
    """

    first: int
    last: int
    start_s: float
    end_s: float
    reason: str


@dataclass(frozen=True)
class FrameUse:
    """The frames of one record that were fitted and those that were not.

    Args:
        experiment_id: the record.
        t_star: dimensionless time of every frame, 0 at the maximum radius.
        fitted: whether each frame was fitted.
        unused: the frames that were not, in order.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, find_landmarks, to_experiment
    >>> from imr_torch.observe.convert import find_frame_use
    >>> from imr_torch.units import Surroundings
    >>> time = torch.linspace(-2.5e-6, 60.5e-6, 64, dtype=torch.float64)
    >>> radius = 200e-6 * (0.55 + 0.45 * torch.exp(-1e4 * time) * torch.cos(2e5 * time))
    >>> trace = RadiusTrace("shot 1", time, radius, "example")
    >>> marks = find_landmarks(trace)
    >>> experiment = to_experiment(trace, marks, Surroundings(), rest_radius=(0.2, 0.02)).until(2.0)
    >>> for line in find_frame_use(trace, marks, experiment, Surroundings(), collapses=1).lines():
    ...     print(line)
    shot 1: 41 of 64 frames fitted
      frames 0 to 2 (-2.5 to -0.5 us): before the maximum radius
      frames 44 to 63 (41.5 to 60.5 us): after collapse 1, where the fitted window ends
    """

    experiment_id: str
    t_star: tuple[float, ...]
    fitted: tuple[bool, ...]
    unused: tuple[Unused, ...]

    def lines(self) -> list[str]:
        """The frames in words: how many were fitted, then every stretch that was not."""
        return render("frames.txt", use=self).splitlines()

    def to_dict(self) -> Document:
        """JSON-ready values."""
        return {
            "recorded": len(self.fitted),
            "fitted": sum(self.fitted),
            "not_fitted": [vars(stretch) for stretch in self.unused],
        }


def find_frame_use(
    trace: RadiusTrace,
    landmarks: Landmarks,
    experiment: Experiment,
    surroundings: Surroundings,
    *,
    collapses: int,
) -> FrameUse:
    """Compare a record with the experiment that was made of it.

    Args:
        trace: the record.
        landmarks: its landmarks.
        experiment: what was fitted of it.
        surroundings: the liquid side, for the time scale.
        collapses: collapses in the fitted window.
    """
    times = landmarks.dimensionless_time(trace.time_s, surroundings)
    fitted = (
        torch.isclose(times[:, None], experiment.times, rtol=0.0, atol=1e-9).any(1).tolist()
    )
    first = min(0.0, float(experiment.times[0]))
    last = float(experiment.times[-1])

    def reason(frame: int) -> str:
        if fitted[frame]:
            return ""
        if times[frame] < first:
            return "before the maximum radius"
        if times[frame] > last:
            return f"after collapse {collapses}, where the fitted window ends"
        return "far off their neighbours"

    unused = []
    for why, group in groupby(range(len(fitted)), reason):
        frames = list(group)
        start, end = (float(trace.time_s[frame]) for frame in (frames[0], frames[-1]))
        unused += [Unused(frames[0], frames[-1], start, end, why)] if why else []
    return FrameUse(
        trace.experiment_id, tuple(times.tolist()), tuple(fitted), tuple(unused)
    )


def load_set(
    path: str | Path,
    *,
    nuisance: Nuisance = FLOOR,
    surroundings: Surroundings = Surroundings(),
) -> list[Experiment]:
    """Experiments of a set, one a design.

    Args:
        path: ``.npz`` with ``time_s`` (designs x frames, s), ``radius_m`` (designs x repeats x
            frames, m; NaN for a missing frame), ``we`` and ``rinf_star`` (designs, as measured).
        nuisance: how well the design and the clock of each experiment are known.
        surroundings: the liquid side; water at 1 atm by default.

    Raises:
        InputDataError: for a file that is no set, a missing array, shapes that do not fit, a radius
            or a duration that no bubble of its design has, or a design without a finite frame.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy
    >>> from imr_torch.observe import load_set
    >>> times = numpy.linspace(0.0, 40e-6, 5)
    >>> arrays = {"time_s": times[None], "radius_m": numpy.full((1, 2, 5), 2e-4), "we": [180.9], "rinf_star": [0.2]}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     numpy.savez(Path(folder) / "gel.npz", **arrays)
    ...     (experiment,) = load_set(Path(folder) / "gel.npz")
    >>> experiment.label, experiment.repeats
    ('design 1', 2)
    """
    arrays = read_arrays(path, _SHAPES)
    all_times, all_radii, webers, rests = arrays.values()
    if webers.ndim != 1 or not len(webers):
        raise InputDataError(
            f"{path}: we has shape {webers.shape}; expected a Weber number a design, of one at least."
        )
    for name, dimensions in _SHAPES.items():
        array = arrays[name]
        if array.ndim != dimensions or len(array) != len(webers):
            raise InputDataError(
                f"{path}: {name} has shape {array.shape}; expected {dimensions} dimensions, the "
                f"first of {len(webers)} designs."
            )
    if all_radii.shape[2] != all_times.shape[1]:
        raise InputDataError(
            f"{path}: radius_m has {all_radii.shape[2]} frames, time_s {all_times.shape[1]}."
        )
    experiments = []
    for i, (weber, rest) in enumerate(zip(webers.tolist(), rests.tolist(), strict=True)):
        label = f"design {i + 1}"
        where = f"{path}: {label}"
        size = surroundings.max_radius(weber)
        radius = torch.as_tensor(all_radii[i]) / size
        times = torch.as_tensor(all_times[i]) / surroundings.time_scale(size)
        seen = radius.isfinite().any(0) & times.isfinite()
        if int(seen.sum()) < 2:
            raise InputDataError(
                f"{where} has {int(seen.sum())} frames with a finite time and radius; at least 2 are "
                "needed."
            )
        radius = radius[:, seen]
        radius = radius[radius.isfinite().any(1)]
        try:
            found = Experiment(label, (weber, rest), times[seen], radius, nuisance)
        except InputDataError as error:
            raise InputDataError(f"{where}: {error}") from None
        _check_units(where, found, size, surroundings.time_scale(size))
        remedy = "the Weber numbers, and that time zero is the maximum"
        check_experiment(found, where, remedy=remedy)
        experiments.append(found)
    return experiments


def _check_units(
    where: str,
    experiment: Experiment,
    size: float,
    unit: float,
    *,
    radii: tuple[float, float] = (-0.2, 2.0),
    durations: tuple[float, float] = (0.1, 1e3),
) -> None:
    """Refuse radii (over Rmax) and times (t*) that no bubble has: most are in another unit than
    ``size`` (m) and ``unit`` (s) say; noise alone makes a collapsed bubble's radius negative.
    """
    radius = experiment.radius
    last = float(experiment.times[-1])
    wrong = radius[(radius < radii[0]) | (radius > radii[1])]
    if len(wrong):
        raise InputDataError(
            f"{where}: radius_m holds {float(wrong[0]) * size:g}; expected metres, from about 0 to "
            f"not far above Rmax, {size:.3g} m by its we. Mark missing frames by NaN."
        )
    shortest, longest = durations
    if not shortest <= last <= longest:
        raise InputDataError(
            f"{where}: time_s ends at {last * unit:g}; expected seconds from the maximum radius "
            f"on, {shortest * unit:.2g} to {longest * unit:.2g} of them."
        )
