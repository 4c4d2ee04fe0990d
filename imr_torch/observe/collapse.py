"""Collapse times as data: shots of which Rmax, the stretch Rmax/R_inf and the time of the first
collapse are known alone.

A :class:`CollapseTime` is an experiment with one datum of another kind than a radius; it stands in
an :class:`imr_torch.observe.ExperimentBatch` beside curves, so that fits, draws and evidence need
not know. Its likelihood is Gaussian in the time of the first minimum of the simulated radius. Rmax
and R_inf are nuisances of the shot with their errors.

Rheometry from collapse times alone: Zhu et al., Soft Matter (2025), doi 10.1039/D5SM00397K, where the
collapse time is a formula; here the bubble is simulated (:mod:`imr_torch.observe.prediction`).
"""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import root_scalar
from scipy.special import ndtri, stdtrit
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.files import read_table
from imr_torch.float64 import tensor
from imr_torch.observe.nuisance import FLOOR, Nuisance
from imr_torch.reading.load import SHOT_ARRAY, SHOT_COLUMNS, is_shot_file
from imr_torch.reading.matlab import read_matlab
from imr_torch.reading.sidecar import Sidecar
from imr_torch.reading.statement import Statement
from imr_torch.reading.table import read_text
from imr_torch.simulate import check_designs
from imr_torch.units import Surroundings

ShotValues = Float[Tensor, "shots"]
"""A number of each shot."""
RESOLUTION_S = 20e-9
"""Error of a collapse time that a file does not state: what Zhu et al. (2025) give for theirs."""

_SHOTS = read_table("limits")["shots"]
_ERRORS = {
    "collapse_time_sd_s": "collapse_time_sd_s",
    "rmax_sd_m": "max_radius_sd_m",
    "stretch_sd": "stretch_sd",
}


@dataclass(frozen=True)
class CollapseShot:
    """What a laboratory knows of one shot, in SI units.

    Args:
        experiment_id: its name.
        max_radius_m: maximum radius, m.
        stretch: Rmax/R_inf.
        collapse_time_s: from the maximum to the first collapse, s.
        collapse_time_sd_s: its error, s.
        max_radius_sd_m: error of Rmax, m; .3 % when not given.
        stretch_sd: error of the stretch; 1 % when not given.
        source: the file.
        stated: what the file beside states of the medium.

    >>> from imr_torch.observe import CollapseShot
    >>> from imr_torch.units import Surroundings
    >>> shot = CollapseShot("a", 340e-6, 8.0, 30.5e-6).to_experiment(Surroundings(density=998.2))
    >>> round(shot.time, 3), round(shot.design[1], 3)  # in Rmax/U_c, and R_inf*
    (0.904, 0.125)
    """

    experiment_id: str
    max_radius_m: float
    stretch: float
    collapse_time_s: float
    collapse_time_sd_s: float = RESOLUTION_S
    max_radius_sd_m: float | None = None
    stretch_sd: float | None = None
    source: str = "the caller"
    stated: Statement | None = None

    def __post_init__(self) -> None:
        for name, (stated, error, low, high) in _SHOTS.items():
            value = getattr(self, stated)
            sd = getattr(self, error)
            if not low <= value <= high:
                raise InputDataError(
                    f"{self.where}: {name} is {value:g}; expected {low:g} to {high:g}, in SI units."
                )
            if sd is not None and not 0.0 < sd < value:
                raise InputDataError(
                    f"{self.where}: {error} is {sd:g}; expected an error above 0 and below the value "
                    f"itself, {value:g}, in SI units, or leave it out."
                )

    @property
    def where(self) -> str:
        """File and experiment, for messages."""
        return f"{self.source}: experiment '{self.experiment_id}'"

    def to_experiment(self, surroundings: Surroundings) -> "CollapseTime":
        """The shot in dimensionless form."""
        top = self.max_radius_m
        scale = surroundings.time_scale(self.max_radius_m)
        nuisance = Nuisance(
            max_radius=(self.max_radius_sd_m or FLOOR.max_radius * top) / top,
            rest_radius=(self.stretch_sd or FLOOR.rest_radius * self.stretch)
            / self.stretch,
        )
        design = (surroundings.weber(top), 1.0 / self.stretch)
        time = self.collapse_time_s / scale
        if not 0.3 <= time <= 6.0:
            raise InputDataError(
                f"{self.where}: the collapse is at t* = {time:.2g} (an empty cavity: .915); check the "
                "units of rmax_m and collapse_time_s."
            )
        return CollapseTime(
            self.experiment_id, design, time, self.collapse_time_sd_s / scale, nuisance
        )


@dataclass(frozen=True)
class CollapseTime:
    """One shot whose only datum is its first collapse time; an experiment of one frame, whose value
    is a time.

    Args:
        label: name in reports.
        design: (We, R_inf*) as measured.
        time: of the first collapse after the maximum, dimensionless.
        sd: its error, dimensionless.
        nuisance: errors of Rmax and R_inf; that of time zero is 0, as it is part of ``sd``.
        scatter: further error, added in quadrature, as estimated from the shots themselves.

    >>> from imr_torch.observe import CollapseTime
    >>> CollapseTime("a", (240.0, 0.13), 0.91, 0.0006).mean.tolist()
    [0.91]
    """

    has_gaps = False
    exposure = 0.0
    repeats = 1
    noise_factor = 1.0
    noise_factor_sd = 0.0
    weight = 1.0
    motion = None

    label: str
    design: tuple[float, float]
    time: float
    sd: float
    nuisance: Nuisance = Nuisance()
    scatter: float = 0.0

    def __post_init__(self) -> None:
        check_designs(tensor([self.design]))
        if not (
            0.0 < self.time < math.inf
            and 0.0 < self.sd < math.inf
            and 0.0 <= self.scatter < math.inf
        ):
            raise InputDataError(
                f"CollapseTime {self.label!r} has time {self.time:g}, sd {self.sd:g} and scatter "
                f"{self.scatter:g}; expected finite numbers, time and sd above 0."
            )
        if self.nuisance.time_zero:
            raise InputDataError(
                f"CollapseTime {self.label!r}: put the error of time zero into sd, and 0 into its "
                "nuisance."
            )

    @cached_property
    def times(self) -> Float[Tensor, "1"]:
        """A tensor of one number, the measured time."""
        return tensor([self.time])

    @property
    def mean(self) -> Float[Tensor, "1"]:
        """The datum, a tensor of one number."""
        return self.times

    @property
    def radius(self) -> Float[Tensor, "1 1"]:
        """The datum as the one repeat's: ``1 x 1``."""
        return self.times[None]

    @property
    def counts(self) -> Int[Tensor, "1"]:
        """One repeat."""
        return torch.ones(1, dtype=torch.long)

    @property
    def whole_sd(self) -> float:
        """Error of the time with the scatter."""
        return math.hypot(self.sd, self.scatter)

    def at(self, frames: Bool[Tensor, "frames"]) -> "CollapseTime":
        """Itself: it has one datum."""
        return self


def load_collapse_times(*paths: str | Path) -> tuple[CollapseShot, ...]:
    r"""Read shots from tables with the columns ``experiment_id, rmax_m, stretch, collapse_time_s``,
    one row a shot.

    Args:
        paths: CSV files; further columns ``collapse_time_sd_s``, ``rmax_sd_m`` and ``stretch_sd``
            give errors. Or MATLAB files with the array ``pIMR_array`` of Zhu et al. (2025): Rmax
            in m, stretch and collapse time in s, one row a shot. A JSON file of the same name
            beside each may state the medium.

    Raises:
        InputDataError: for no file, a missing column, a cell that is no number, a value that no
            bubble has, or a repeated name.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.observe import load_collapse_times
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "shots.csv"
    ...     _ = path.write_text("experiment_id,rmax_m,stretch,collapse_time_s\na,3.4e-4,8.0,3.05e-5\n")
    ...     load_collapse_times(path)[0].stretch
    8.0
    """
    if not paths:
        raise InputDataError(
            "load_collapse_times was given no file; name one table or more."
        )
    shots: list[CollapseShot] = []
    for path in map(Path, paths):
        if not is_shot_file(path):
            raise InputDataError(
                f"{path}: is no table of collapse times; expected the columns "
                f"{', '.join(SHOT_COLUMNS)}."
            )
        read_shots = _shots_of_array if path.suffix.lower() == ".mat" else _shots_of_table
        shots += read_shots(path, Sidecar(path).stated)
    names = [shot.experiment_id for shot in shots]
    double = next((name for name in names if names.count(name) > 1), None)
    if not shots or double is not None:
        raise InputDataError(
            f"{paths[0]}: "
            + ("holds no shot." if not shots else f"experiment_id '{double}' occurs twice.")
        )
    return tuple(shots)


def _shots_of_array(path: Path, stated: Statement | None) -> list[CollapseShot]:
    """The shots of a MATLAB file."""
    array = read_matlab(path).values[SHOT_ARRAY]
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind != "f":
        raise InputDataError(
            f"{path}: {SHOT_ARRAY} has shape {array.shape}; expected one row a shot of Rmax in m, "
            "stretch and collapse time in s."
        )
    return [
        CollapseShot(f"{path.stem}_{i:03d}", *row, source=str(path), stated=stated)
        for i, row in enumerate(array.tolist(), 1)
    ]


def _shots_of_table(path: Path, stated: Statement | None) -> list[CollapseShot]:
    """The shots of a table of text."""
    table = read_text(path)
    if table.units:
        raise InputDataError(
            f"{table.path}: the row below the header ({', '.join(table.units.values())}) is no "
            "shot; leave it out: values are in SI units."
        )
    for name in table.values:
        if name not in (*SHOT_COLUMNS, *_ERRORS):  # such as a misspelt error
            raise InputDataError(
                f"{table.path}: column {name!r} is none of a table of collapse times; expected "
                f"{', '.join(SHOT_COLUMNS)} and perhaps {', '.join(_ERRORS)}. Rename it, or leave "
                "it out."
            )
    numbers = {
        name: table.vectors(name)[0].tolist()
        for name in table.values
        if name != "experiment_id"
    }
    shots = []
    for i, name in enumerate(table.texts["experiment_id"]):
        if not name:
            raise InputDataError(
                f"{table.path}: experiment_id of shot {i + 1} is empty; give each shot a name."
            )
        errors = {
            field: numbers[column][i]
            for column, field in _ERRORS.items()
            if any(table.texts.get(column, ())[i : i + 1])
        }
        values = (numbers[column][i] for column in SHOT_COLUMNS[1:])
        shots.append(
            CollapseShot(name, *values, **errors, source=str(table.path), stated=stated)
        )
    return shots


def serial_correlation(values: ShotValues, order: ShotValues) -> float:
    """Correlation of each value with the next one in an order, times the root of their number:
    standard normal if independent.

    Args:
        values: residuals.
        order: ``n`` tensor by which they are sorted.

    >>> import torch
    >>> from imr_torch.observe.collapse import serial_correlation
    >>> order = torch.linspace(0.0, 1.0, 64, dtype=torch.float64)
    >>> round(serial_correlation(torch.cos(6.0 * order), order))
    8
    """
    sorted_values = values[order.argsort()]
    product = (sorted_values[1:] * sorted_values[:-1]).sum()
    return float(product / values.square().sum().clamp_min(1e-300)) * math.sqrt(len(values))


def estimate_scatter(missed: ShotValues, variance: ShotValues, fitted: float) -> float:
    """Further error of each time, dimensionless, with which chi-square equals its degrees of
    freedom; 0 if it is below.

    As it is plugged in, it is larger by the ratio of the 95 % quantiles of Student's t (of those
    degrees of freedom) and of the normal distribution: so 90 % intervals that it dominates account
    for how few shots it is estimated from.

    Args:
        missed: measured less predicted time, nuisances at their prior means.
        variance: its variance by the stated errors alone.
        fitted: degrees of freedom that the fit of the gel took.
    """
    free = len(missed) - fitted
    if free < 1.0 or float((missed.square() / variance).sum()) <= free:
        return 0.0
    high = float(missed.square().max().sqrt()) * math.sqrt(len(missed))
    found = root_scalar(
        lambda scatter: float((missed.square() / (variance + scatter**2)).sum()) - free,
        bracket=(0.0, high),
    )
    return found.root * float(stdtrit(free, 0.95) / ndtri(0.95))
