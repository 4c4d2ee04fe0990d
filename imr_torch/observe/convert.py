"""Conversion of a trace in SI units to a dimensionless experiment: Rmax, time zero and R_inf taken
from its landmarks.

What the landmarks do not know exactly becomes the experiment's nuisances, with floors for what no
fit sees (pixel size, edge detection): 0.3 % of Rmax, 0.004 in t*, 1 % of R_inf.
"""

import math

from imr_torch.errors import InputDataError
from imr_torch.observe.experiments import Experiment
from imr_torch.observe.landmarks import Landmarks
from imr_torch.observe.nuisance import FLOOR, Nuisance
from imr_torch.reading.traces import RadiusTrace
from imr_torch.units import Surroundings


def to_experiment(
    trace: RadiusTrace,
    landmarks: Landmarks,
    surroundings: Surroundings,
    *,
    rest_radius: tuple[float, float] | None = None,
    widest: float = 0.5,
) -> Experiment:
    """Make a trace dimensionless, from its maximum radius on.

    Args:
        trace: the curve.
        landmarks: its landmarks.
        surroundings: the liquid side, for the scales.
        rest_radius: assumed R_inf/Rmax and its standard deviation, in place of what the record
            says.
        widest: largest standard deviation of a nuisance, beyond which a normal law means nothing.

    Returns:
        The experiment, one repeat, all frames from the maximum on.

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
    value, sd, remedy = _rest(trace, landmarks, rest_radius)
    if not 0.0 < value < 1.0:
        raise InputDataError(
            f"{trace.where}: R_inf/Rmax is {value:.3f} (R_inf {1e6 * value * top:.1f} um, Rmax "
            f"{1e6 * top:.1f} um); expected a rest radius below the maximum radius. {remedy}"
        )
    scale = surroundings.time_scale(top)
    times = (trace.time_s - landmarks.time_of_max_s) / scale
    kept = times >= 0.0
    nuisance = Nuisance(
        max_radius=min(math.hypot(landmarks.max_radius_sd_m / top, FLOOR.max_radius), widest),
        time_zero=min(math.hypot(landmarks.time_of_max_sd_s / scale, FLOOR.time_zero), widest),
        rest_radius=min(math.hypot(sd / value, FLOOR.rest_radius), widest),
    )
    design = (surroundings.weber(top), value)
    exposure = 0.0 if trace.given.exposure_s is None else trace.given.exposure_s / float(scale)
    return Experiment(
        trace.experiment_id,
        design,
        times[kept],
        trace.radius_m[kept][None] / top,
        nuisance,
        exposure,
    )


def _rest(
    trace: RadiusTrace, landmarks: Landmarks, assumed: tuple[float, float] | None
) -> tuple[float, float, str]:
    """R_inf/Rmax, its standard deviation, and what to do if it is impossible."""
    if assumed is not None:
        return *assumed, "Give another assumed rest radius."
    if landmarks.rest_radius_m is None or landmarks.rest_radius_sd_m is None:
        raise InputDataError(
            f"{trace.where} has no rebound and no given "
            "R_inf, so the rest radius cannot be measured from it. Give it: rest_radius=(value, "
            "sd) of R_inf/Rmax (on the command line --rest-radius 0.2:0.1), or Rinf_m in the JSON "
            "beside the file, or leave the experiment out."
        )
    top = landmarks.max_radius_m
    return (
        landmarks.rest_radius_m / top,
        landmarks.rest_radius_sd_m / top,
        "Give the rest radius with rest_radius=(value, sd).",
    )
