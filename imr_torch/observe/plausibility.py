"""Whether a curve can be one of an inertial bubble at all: most that cannot are in other units than
was said.

In units of Rmax and of ``Rmax sqrt(rho / p)`` all such curves are alike: an empty cavity in water
collapses at t* = 0.915 (Rayleigh, Phil. Mag. 34, 1917). A gel adds 5 G/2 at the maximum radius to
the pressure that drives the collapse, which brings this down to 0.55 at 70 kPa, a modulus that 95 %
of the default prior lie below; viscous liquids bring it up to some 1.3. Values that no bubble has
are refused; unusual ones are reported, since a diameter taken for a radius looks like a stiff gel.
"""

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import NamedTuple

import torch

from imr_torch.errors import InputDataError
from imr_torch.files import read_table
from imr_torch.observe.experiments import Experiment
from imr_torch.observe.extremes import RULES, collapse_time, frame_roughness
from imr_torch.observe.landmarks import Landmarks
from imr_torch.reading.traces import RadiusTrace
from imr_torch.units import Surroundings

RAYLEIGH_TIME = 0.915
"""Dimensionless collapse time of an empty cavity."""


class Range(NamedTuple):
    """Values that are possible, and those that are usual, smallest and largest each; what is said of one."""

    possible: Sequence[float]
    usual: Sequence[float]
    text: str = ""


_TABLE = read_table("limits")
LIMITS = SimpleNamespace(**_TABLE)
"""Limits of :func:`check_experiment` and :func:`check_maximum` (``data/limits.toml``)."""
RANGES = {name: Range(**row) for name, row in _TABLE["ranges"].items()}
"""The same of quantities of which some values are possible, and fewer usual."""


def check_experiment(
    experiment: Experiment,
    where: str,
    *,
    first: float | None = None,
    cut: bool = False,
    remedy: str = "",
) -> tuple[str, ...]:
    """Refuse an experiment that cannot be one of a bubble, and say what is unusual about one that
    can.

    Args:
        experiment: from its maximum radius on.
        where: file and name, for messages.
        first: t* of its first collapse, infinite where there is none; that of :func:`collapse_time`
            when not given.
        cut: whether the record begins after its maximum, which brings collapses forward.
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
    if at > max(
        LIMITS.latest_maximum, LIMITS.frames_to_maximum * float(times.diff()[:1].sum())
    ):
        raise InputDataError(
            f"{where}: the largest frame is at t* = {at:.2f}; expected time zero at the maximum "
            f"radius, within {LIMITS.latest_maximum}.{advice}"
        )
    weber, rest = experiment.design
    found = {"weber": weber, "rest_radius": rest, "largest_radius": largest}
    found |= {"first_collapse": first} if first < math.inf else {}
    cautions = []
    for name, value in found.items():
        limits = RANGES[name]
        low, high = limits.usual
        if name == "first_collapse" and cut:
            low = LIMITS.collapse_after_cut
        what = f"{where}: {limits.text.format(value)}"
        if not limits.possible[0] <= value <= limits.possible[1]:
            raise InputDataError(
                f"{what}; possible is {limits.possible[0]:g} to {limits.possible[1]:g}.{advice}"
            )
        if not low <= value <= high:
            cautions.append(f"{what}; usual is {low:g} to {high:g}.{advice}")
    if first == math.inf and not LIMITS.duration[0] <= last <= LIMITS.duration[1]:
        text = f"{where}: the record lasts t* = {last:.3g} and holds no collapse."
        if last < LIMITS.duration[0]:
            raise InputDataError(f"{text} Expected at least {LIMITS.duration[0]}.{advice}")
        cautions.append(f"{text} Only overdamped bubbles do not rebound.{advice}")
    scatter = frame_roughness(radius.numpy()) / max(
        float(radius.amax() - radius.amin()), 1e-300
    )
    if len(radius) >= LIMITS.fewest_frames and scatter > RANGES["scatter"].usual[1]:
        what = (
            f"{where}: neighbouring frames scatter by {100.0 * scatter:.0f} % of the range of all "
            "radii, as noise alone does"
        )
        if scatter > RANGES["scatter"].possible[1]:
            raise InputDataError(f"{what}; check which column holds the radii.")
        cautions.append(
            f"{what}; usual is less than {100.0 * RANGES['scatter'].usual[1]:.0f} %."
        )
    return tuple(cautions)


def _check_stated(
    trace: RadiusTrace, landmarks: Landmarks, surroundings: Surroundings
) -> None:
    """Refuse standard deviations and a time of the maximum, stated by the laboratory, that cannot
    be meant.
    """
    where = trace.where
    given = trace.given
    top = landmarks.max_radius_m
    for name, sd, largest in (
        ("Rmax_sd_m", given.max_radius_sd_m, 0.5 * top),
        ("Rinf_sd_m", given.rest_radius_sd_m, top),
    ):
        if sd is not None and sd > largest:
            raise InputDataError(
                f"{where}: {name} is {1e6 * sd:.4g} um, and Rmax {1e6 * top:.4g} um; expected a "
                f"standard deviation in metres, {1e6 * largest:.4g} um at most."
            )
    apart = float(trace.time_s.diff().median())
    if given.exposure_s is not None and given.exposure_s > LIMITS.longest_exposure * apart:
        raise InputDataError(
            f"{where}: exposure_s is {1e6 * given.exposure_s:.4g} us, and frames are "
            f"{1e6 * apart:.4g} us apart; expected the exposure of one frame in seconds, no longer "
            "than that. Leave it out if it is not known."
        )
    if landmarks.time_of_max_s >= trace.time_s[-2]:
        raise InputDataError(
            f"{where}: t_Rmax_s is {1e6 * landmarks.time_of_max_s:.4g} us, and the record ends at "
            f"{1e6 * trace.time_s[-1]:.4g} us. Give it in seconds on the time axis of the file."
        )
    overridden = given.override is not None and given.override.time_of_max_s is not None
    stated = None if overridden else given.time_of_max_s
    scale = float(surroundings.time_scale(top))
    if (
        stated is not None
        and abs(stated - landmarks.time_of_max_s) > LIMITS.latest_maximum * scale
    ):
        raise InputDataError(
            f"{where}: t_Rmax_s is {1e6 * stated:.4g} us, and the maximum radius of the frames is "
            f"at {1e6 * landmarks.time_of_max_s:.4g} us. Give it in seconds on the time axis of "
            "the file, or leave it out."
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
    where = trace.where
    time = trace.time_s
    radius = trace.radius_m
    k = int(radius.argmax())
    top = float(radius[k])
    if k == len(radius) - 1:
        raise InputDataError(
            f"{where}: the largest radius, {1e6 * top:.4g} um, is that of the last frame, so the "
            "record holds no collapse. Check the units of the times, and that radius and time are "
            "not exchanged."
        )
    if float(radius.amax() - radius.amin()) < LIMITS.least_change * top:
        raise InputDataError(
            f"{where}: the radius stays within {100.0 * LIMITS.least_change:g} % of {1e6 * top:.4g} "
            "um; expected a bubble that collapses. Check which column holds the radii."
        )
    _check_stated(trace, landmarks, surroundings)
    stated = trace.given.max_radius_m
    dense = 0 < k < len(radius) - 1 and float(
        time[k + 1] - time[k]
    ) < LIMITS.dense * surroundings.time_scale(top)
    if dense and max(float(radius[k - 1]), float(radius[k + 1])) < RULES.neighbour * top:
        raise InputDataError(
            f"{where}: frame {k} (counted from 0, {1e6 * float(time[k]):.4g} us) has the largest "
            f"radius, {1e6 * top:.4g} um, between frames of {1e6 * float(radius[k - 1]):.4g} and "
            f"{1e6 * float(radius[k + 1]):.4g} um. No bubble does that: set the frame to NaN."
        )
    if stated is None:
        return ()
    seen = top if landmarks.max_method == "as given" else landmarks.max_radius_m
    ratio = stated / seen
    text = (
        f"{where}: the stated maximum radius is {1e6 * stated:.4g} um, and the largest of the "
        f"frames {1e6 * seen:.4g} um. Check Rmax_m (metres, a radius) and the units of the radii."
    )
    low, high = RANGES["stated_over_seen"].possible
    if not low <= ratio <= high:
        raise InputDataError(text)
    low, high = RANGES["stated_over_seen"].usual
    return () if low <= ratio <= high else (text,)
