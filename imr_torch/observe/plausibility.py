"""Whether a curve can be one of an inertial bubble at all: most that cannot are in other units than
was said.

In units of Rmax and of ``Rmax sqrt(rho / p)`` all such curves are alike: an empty cavity in water
collapses at t* = 0.915 (Rayleigh, Phil. Mag. 34, 1917); stiff gels bring this down to some 0.4,
viscous liquids up to some 1.3. Values that no bubble has are refused; unusual ones are reported,
since a diameter taken for a radius looks like a stiff gel.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.observe.experiments import Experiment
from imr_torch.observe.landmarks import LandmarkOptions, Landmarks, roughness
from imr_torch.observe.window import collapse_time
from imr_torch.reading.traces import RadiusTrace
from imr_torch.units import Surroundings

RAYLEIGH_TIME = 0.915
"""Dimensionless collapse time of an empty cavity."""


@dataclass(frozen=True)
class Range:
    """Values that are possible, and those that are usual.

    Args:
        possible: smallest and largest value; others are refused.
        usual: smallest and largest value; others are reported.
    """

    possible: tuple[float, float]
    usual: tuple[float, float]


WEBER = Range((1.0, 1e5), (20.0, 3000.0))
REST_RADIUS = Range((0.02, 0.95), (0.07, 0.65))
FIRST_COLLAPSE = Range((0.25, 3.0), (0.7, 1.4))
LARGEST_RADIUS = Range((0.7, 1.1), (0.85, 1.05))
SCATTER = Range((0.0, 0.25), (0.0, 0.15))
STATED_OVER_SEEN = Range((0.75, 1.35), (0.95, 1.1))
_LONGEST_EXPOSURE = 1.05  # of the time between frames
_LEAST_CHANGE = 0.01  # of the largest radius
_LATEST_MAXIMUM = 0.45  # t* of the largest frame
_FRAMES = 2.5  # by which the maximum may lie before the first frame of a record that begins near it
_SHORTEST, _LONGEST = 0.1, 3.0  # t* that a record without a collapse may last
_MANY = 12  # frames, from which on their scatter is looked at
_DENSE = 0.15  # t* between frames, within which no bubble falls by a quarter from its maximum


def check_experiment(
    experiment: Experiment, where: str, *, first: float | None = None, remedy: str = ""
) -> tuple[str, ...]:
    """Refuse an experiment that cannot be one of a bubble, and say what is unusual about one that
    can.

    Args:
        experiment: from its maximum radius on.
        where: file and name, for messages.
        first: t* of its first collapse, infinite where there is none; that of :func:`collapse_time`
            when not given.
        remedy: what else may be wrong than the units of radius and time.

    Returns:
        Cautions, a sentence each.

    Raises:
        InputDataError: for a Weber number, a rest radius, a largest radius, its time, or a first
            collapse that no bubble has, and for frames that scatter like noise.

    >>> import torch
    >>> from imr_torch.observe import Experiment, check_experiment
    >>> times = torch.linspace(0.0, 2.0, 41, dtype=torch.float64)
    >>> radius = (0.6 + 0.4 * torch.cos(7.0 * times))[None]
    >>> check_experiment(Experiment("shot 1", (400.0, 0.22), times, radius), "gel.csv")[0][:43]
    'gel.csv: the first collapse is at t* = 0.45'
    """
    advice = f" Check the units of radius and time{', ' + remedy if remedy else ''}."
    times = experiment.times
    radius = torch.nanmean(experiment.radius, 0)
    largest = float(radius.max())
    at = float(times[int(radius.argmax())])
    first = collapse_time(times, radius, 1) if first is None else first
    last = float(times[-1])
    if at > max(_LATEST_MAXIMUM, _FRAMES * float(times.diff()[:1].sum())):
        raise InputDataError(
            f"{where}: the largest frame is at t* = {at:.2f}; expected time zero at the maximum "
            "radius, within "
            f"{_LATEST_MAXIMUM}.{advice}"
        )
    found = [
        (WEBER, experiment.design[0], "We is {:.4g}"),
        (REST_RADIUS, experiment.design[1], "R_inf/Rmax is {:.4g}"),
        (LARGEST_RADIUS, largest, "the largest frame has R/Rmax = {:.3g}"),
    ]
    if first < math.inf:
        cavity = f"that of an empty cavity in water at {RAYLEIGH_TIME}, in stiff gels from 0.4 on"
        found.append((FIRST_COLLAPSE, first, f"the first collapse is at t* = {{:.3g}} ({cavity})"))
    cautions = []
    for limits, value, text in found:
        what = f"{where}: {text.format(value)}"
        if not limits.possible[0] <= value <= limits.possible[1]:
            raise InputDataError(
                f"{what}; possible is {limits.possible[0]:g} to {limits.possible[1]:g}.{advice}"
            )
        if not limits.usual[0] <= value <= limits.usual[1]:
            cautions.append(f"{what}; usual is {limits.usual[0]:g} to {limits.usual[1]:g}.{advice}")
    if first == math.inf and not _SHORTEST <= last <= _LONGEST:
        text = f"{where}: the record lasts t* = {last:.3g} and holds no collapse."
        if last < _SHORTEST:
            raise InputDataError(f"{text} Expected at least {_SHORTEST}.{advice}")
        cautions.append(f"{text} Only overdamped bubbles do not rebound.{advice}")
    scatter = roughness(radius.numpy()) / max(float(radius.amax() - radius.amin()), 1e-300)
    if len(radius) >= _MANY and scatter > SCATTER.usual[1]:
        what = (
            f"{where}: neighbouring frames scatter by {100.0 * scatter:.0f} % of the range of all "
            "radii, as noise alone does"
        )
        if scatter > SCATTER.possible[1]:
            raise InputDataError(f"{what}; check which column holds the radii.")
        cautions.append(f"{what}; usual is less than {100.0 * SCATTER.usual[1]:.0f} %.")
    return tuple(cautions)


def _check_rise(where: str, radius: Tensor, largest: int) -> None:
    """Refuse a record that ends at its maximum, or whose radius stays the same."""
    if largest == len(radius) - 1:
        raise InputDataError(
            f"{where}: the largest radius, {1e6 * float(radius[largest]):.4g} um, is that of the "
            "last frame, so the record "
            "holds no collapse. Check the units of the times, and that radius and time are not "
            "exchanged."
        )
    if float(radius.amax() - radius.amin()) < _LEAST_CHANGE * float(radius[largest]):
        raise InputDataError(
            f"{where}: the radius stays within {100.0 * _LEAST_CHANGE:g} % of "
            f"{1e6 * float(radius[largest]):.4g} um; expected "
            "a bubble that collapses. Check which column holds the radii."
        )


def _check_stated(
    where: str, trace: RadiusTrace, landmarks: Landmarks, surroundings: Surroundings
) -> None:
    """Refuse standard deviations and a time of the maximum, stated by the laboratory, that cannot
    be meant.
    """
    given = trace.given
    top = landmarks.max_radius_m
    for name, sd, largest in (
        ("Rmax_sd_m", given.max_radius_sd_m, 0.5 * top),
        ("Rinf_sd_m", given.rest_radius_sd_m, top),
    ):
        if sd is not None and sd > largest:
            raise InputDataError(
                f"{where}: {name} is {1e6 * sd:.4g} um, and Rmax {1e6 * top:.4g} um; expected a "
                "standard deviation in metres, "
                f"{1e6 * largest:.4g} um at most."
            )
    apart = float(trace.time_s.diff().median())
    if given.exposure_s is not None and given.exposure_s > _LONGEST_EXPOSURE * apart:
        raise InputDataError(
            f"{where}: exposure_s is {1e6 * given.exposure_s:.4g} us, and frames are "
            f"{1e6 * apart:.4g} us apart; expected the "
            "exposure of one frame in seconds, no longer than that. Leave it out if it is not "
            "known."
        )
    overridden = given.override is not None and given.override.time_of_max_s is not None
    stated = None if overridden else given.time_of_max_s
    scale = float(surroundings.time_scale(top))
    if stated is not None and abs(stated - landmarks.time_of_max_s) > _LATEST_MAXIMUM * scale:
        raise InputDataError(
            f"{where}: t_Rmax_s is {1e6 * stated:.4g} us, and the maximum radius of the frames is "
            "at "
            f"{1e6 * landmarks.time_of_max_s:.4g} us. Give it in seconds on the time axis of the "
            "file, or leave it out."
        )


def check_maximum(
    trace: RadiusTrace, landmarks: Landmarks, surroundings: Surroundings
) -> tuple[str, ...]:
    """Refuse a maximum that is a single frame beside others far smaller, or far from what the
    laboratory states.

    Args:
        trace: the curve.
        landmarks: its landmarks.
        surroundings: the liquid side, for the time scale.

    Returns:
        Cautions, a sentence each.

    Raises:
        InputDataError: naming the frame, or both radii.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, check_maximum, find_landmarks
    >>> from imr_torch.units import Surroundings
    >>> time = torch.linspace(0.0, 60e-6, 61, dtype=torch.float64)
    >>> trace = RadiusTrace("shot 1", time, 200e-6 * (0.55 + 0.45 * torch.cos(2e5 * time)), "example")
    >>> check_maximum(trace, find_landmarks(trace), Surroundings())
    ()
    """
    where = f"{trace.source}: experiment '{trace.experiment_id}'"
    time = trace.time_s
    radius = trace.radius_m
    k = int(radius.argmax())
    _check_rise(where, radius, k)
    _check_stated(where, trace, landmarks, surroundings)
    top = float(radius[k])
    stated = trace.given.max_radius_m
    dense = 0 < k < len(radius) - 1 and float(
        time[k + 1] - time[k]
    ) < _DENSE * surroundings.time_scale(top)
    if dense and max(float(radius[k - 1]), float(radius[k + 1])) < LandmarkOptions.neighbour * top:
        raise InputDataError(
            f"{where}: frame {k} (counted from 0, {1e6 * float(time[k]):.4g} us) has the largest "
            f"radius, {1e6 * top:.4g} um, "
            f"between frames of {1e6 * float(radius[k - 1]):.4g} and "
            f"{1e6 * float(radius[k + 1]):.4g} um. No bubble does that: "
            "set the frame to NaN."
        )
    if stated is None:
        return ()
    seen = top if landmarks.max_method == "as given" else landmarks.max_radius_m
    ratio = stated / seen
    text = (
        f"{where}: the stated maximum radius is {1e6 * stated:.4g} um, and the largest of the "
        f"frames {1e6 * seen:.4g} um. "
        "Check Rmax_m (metres, a radius) and the units of the radii."
    )
    low, high = STATED_OVER_SEEN.possible
    if not low <= ratio <= high:
        raise InputDataError(text)
    low, high = STATED_OVER_SEEN.usual
    return () if low <= ratio <= high else (text,)
