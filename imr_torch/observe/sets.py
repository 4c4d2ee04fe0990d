"""Sets of designs x repeats x frames as one ``.npz`` file: ``time_s``, ``radius_m``, ``we``,
``rinf_star``.
"""

from pathlib import Path

import torch

from imr_torch.errors import InputDataError
from imr_torch.observe.experiments import Experiment
from imr_torch.observe.nuisance import FLOOR, Nuisance
from imr_torch.observe.plausibility import check_experiment
from imr_torch.reading.readers import read_arrays
from imr_torch.units import Surroundings

_SHAPES = {"time_s": 2, "radius_m": 3, "we": 1, "rinf_star": 1}


def load_set(
    path: str | Path, *, nuisance: Nuisance = FLOOR, surroundings: Surroundings | None = None
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
    ('design 0', 2)
    """
    outer = surroundings or Surroundings()
    arrays = read_arrays(path, _SHAPES)
    if arrays["we"].ndim != 1 or not len(arrays["we"]):
        raise InputDataError(
            f"{path}: we has shape {arrays['we'].shape}; expected a Weber number a design, of one "
            "at least."
        )
    for name, dimensions in _SHAPES.items():
        if arrays[name].ndim != dimensions or arrays[name].shape[0] != arrays["we"].shape[0]:
            raise InputDataError(
                f"{path}: {name} has shape {arrays[name].shape}; expected {dimensions} dimensions, "
                f"the first of {arrays['we'].shape[0]} designs."
            )
    if arrays["radius_m"].shape[2] != arrays["time_s"].shape[1]:
        raise InputDataError(
            f"{path}: radius_m has {arrays['radius_m'].shape[2]} frames, time_s "
            f"{arrays['time_s'].shape[1]}."
        )
    experiments = []
    for i, (weber, rest) in enumerate(zip(arrays["we"], arrays["rinf_star"], strict=True)):
        where = f"{path}: design {i}"
        size = outer.max_radius(float(weber))
        radius = torch.as_tensor(arrays["radius_m"][i]) / size
        times = torch.as_tensor(arrays["time_s"][i]) / outer.time_scale(size)
        seen = torch.isfinite(radius).any(0) & torch.isfinite(times)
        if int(seen.sum()) < 2:
            raise InputDataError(
                f"{where} has {int(seen.sum())} frames with a finite time and radius; at least 2 are "
                "needed."
            )
        radius = radius[:, seen]
        radius = radius[torch.isfinite(radius).any(1)]
        design = (float(weber), float(rest))
        try:
            found = Experiment(f"design {i}", design, times[seen], radius, nuisance)
        except InputDataError as error:
            raise InputDataError(f"{where}: {error}") from None
        _check_units(where, found, size, outer.time_scale(size))
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
