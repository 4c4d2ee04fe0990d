"""Collapse times as data: shots of which Rmax, the stretch Rmax/R_inf and the time of the first
collapse are known alone.

A :class:`CollapseTime` is an experiment with one datum of another kind than a radius; it stands in
an :class:`imr_torch.observe.ExperimentBatch` beside curves, so that fits, draws and evidence need
not know. Its likelihood is Gaussian in the time of the first minimum of the simulated radius. Rmax
and R_inf are nuisances of the shot with their errors.

The minimum is where the wall's velocity changes sign, by a cubic through radius and velocity at
both ends of an interval of the output; in two passes the intervals shrink to 1e-6 of the collapse
time. Of many shots, the time is a smooth function of two numbers, (ln We, R_inf*): it is simulated at
the Chebyshev nodes of their range and interpolated, so that the cost of a gel does not grow with the
number of shots. Rheometry from collapse times alone: Zhu et al., Soft Matter (2025), doi 10.1039/D5SM00397K,
where the collapse time is a formula; here the bubble is simulated.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import root_scalar
from scipy.special import ndtri, stdtrit
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.observe.distortion import Distortion
from imr_torch.observe.nuisance import FLOOR, SMALLEST, Nuisance, displaced
from imr_torch.reading.content import Content
from imr_torch.reading.matlab import read_matlab
from imr_torch.reading.readers import SHOT_ARRAY, SHOT_COLUMNS, is_shot_file
from imr_torch.reading.sidecar import Sidecar
from imr_torch.reading.statement import Statement
from imr_torch.reading.table import read_text
from imr_torch.simulate import Simulator, check_designs
from imr_torch.types import BroadcastValues, Frames
from imr_torch.units import Surroundings

RESOLUTION_S = 20e-9
"""Error of a collapse time that a file does not state: what Zhu et al. (2025) give for theirs."""

_ERRORS = {
    "collapse_time_sd_s": "collapse_time_sd_s",
    "rmax_sd_m": "max_radius_sd_m",
    "stretch_sd": "stretch_sd",
}
_GRID = torch.cat(
    [
        torch.linspace(a, b, n + 1, dtype=torch.float64)[:-1]
        for a, b, n in ((0.0, 0.7, 40), (0.7, 1.3, 1200), (1.3, 2.5, 600))
    ]
)  # output times over the measured collapse time: the minimum is found to 3e-5
_USUAL = 1240  # of these times, up to 1.3
_CLOSE = 1e-3 * torch.sinh(torch.linspace(-6.0, 6.0, 201, dtype=torch.float64)) / math.sinh(6.0)
"""Output times about that, 3e-7 apart at their middle: the time is as smooth in the gel as the solver's output."""
_NODES = (4, 3)
"""Nodes along ln We and R_inf*; of a gel that collapses freely, times are right to 5e-5."""
_STEPS = (0.05, 0.01)  # to which the range of (ln We, R_inf*) is rounded, so that nodes stay
_RANGES = {"rmax_m": (1e-6, 1e-2), "stretch": (1.2, 100.0), "collapse_time_s": (1e-8, 1e-2)}


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
        values = (self.max_radius_m, self.stretch, self.collapse_time_s)
        for (name, (low, high)), value in zip(_RANGES.items(), values, strict=True):
            if not low <= value <= high:
                raise InputDataError(
                    f"{self.source}: experiment '{self.experiment_id}': {name} is {value:g}; "
                    f"expected {low:g} to {high:g}, in SI units."
                )
        for name, value, of in (
            ("collapse_time_sd_s", self.collapse_time_sd_s, self.collapse_time_s),
            ("max_radius_sd_m", self.max_radius_sd_m, self.max_radius_m),
            ("stretch_sd", self.stretch_sd, self.stretch),
        ):
            if value is not None and not 0.0 < value < of:
                raise InputDataError(
                    f"{self.source}: experiment '{self.experiment_id}': {name} is {value:g}; "
                    f"expected an error above 0 and below the value itself, {of:g}, in SI units, "
                    "or leave it out."
                )

    def to_experiment(self, surroundings: Surroundings) -> "CollapseTime":
        """The shot in dimensionless form."""
        top = self.max_radius_m
        scale = surroundings.time_scale(self.max_radius_m)
        nuisance = Nuisance(
            max_radius=(self.max_radius_sd_m or FLOOR.max_radius * top) / top,
            rest_radius=(self.stretch_sd or FLOOR.rest_radius * self.stretch) / self.stretch,
        )
        design = (surroundings.weber(top), 1.0 / self.stretch)
        time = self.collapse_time_s / scale
        if not 0.3 <= time <= 6.0:
            raise InputDataError(
                f"{self.source}: experiment '{self.experiment_id}': the collapse is at t* = "
                f"{time:.2g} (an empty "
                "cavity: .915); check the units of rmax_m and collapse_time_s."
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

    kind: ClassVar[str] = "collapse"
    has_gaps: ClassVar[bool] = False
    exposure: ClassVar[float] = 0.0
    repeats: ClassVar[int] = 1

    label: str
    design: tuple[float, float]
    time: float
    sd: float
    nuisance: Nuisance = field(default_factory=Nuisance)
    scatter: float = 0.0

    def __post_init__(self) -> None:
        check_designs(torch.tensor([self.design], dtype=torch.float64))
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
        return torch.tensor([self.time], dtype=torch.float64)

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

    def until(self, last: float) -> "CollapseTime":
        """Itself: no window applies."""
        return self


def first_minimum(
    times: Float[Tensor, "*#batch frames"],
    radius: Float[Tensor, "*#batch frames"],
    velocity: Float[Tensor, "*#batch frames"],
) -> BroadcastValues:
    """Time of the first minimum of curves, where the velocity changes sign; NaN for a curve without
    one.

    Args:
        times: increasing.
        radius: ``... x n`` tensor.
        velocity: ``... x n`` tensor.

    >>> import torch
    >>> from imr_torch.observe.collapse import first_minimum
    >>> times = torch.linspace(0.0, 9.0, 46, dtype=torch.float64)
    >>> round(float(first_minimum(times, 1.1 + torch.cos(times), -torch.sin(times))), 3)
    3.142
    """
    turns = (velocity[..., :-1] < 0.0) & (velocity[..., 1:] >= 0.0)
    left = (
        (turns.cumsum(-1) == 0).sum(-1, keepdim=True).clamp_max(turns.shape[-1] - 1)
    )  # intervals before the first
    shape = turns.shape[:-1]

    def ends(values: Tensor) -> tuple[Tensor, Tensor]:
        whole = values.expand(*shape, values.shape[-1])
        return whole.gather(-1, left)[..., 0], whole.gather(-1, left + 1)[..., 0]

    (t0, t1), (r0, r1), (u0, u1) = ends(times), ends(radius), ends(velocity)
    h = t1 - t0
    rise = r1 - r0
    u0 = u0 * h
    u1 = u1 * h
    a = 3.0 * (u0 + u1 - 2.0 * rise)
    b = 2.0 * (3.0 * rise - 2.0 * u0 - u1)
    share = -2.0 * u0 / (b + (b * b - 4.0 * a * u0).clamp_min(0.0).sqrt())
    return torch.where(turns.any(-1), t0 + h * share.clamp(0.0, 1.0), torch.nan)


def simulate_bubbles(
    simulator: Simulator,
    parameters: Float[Tensor, "*#batch parameters"],
    designs: Float[Tensor, "*#batch experiments 2"],
    times: Frames,
    *,
    bundled: bool = False,
) -> tuple[Frames, Frames]:
    """Radius and velocity of each gel in each experiment, dimensionless.

    Args:
        simulator: makes the bubbles.
        parameters: SI.
        designs: true ones.
        times: true ones.
        bundled: as for :func:`imr_torch.observe.predict`.
    """
    if not bundled:
        solution = simulator(parameters[..., None, :], designs, times)
        return solution.radius, solution.velocity
    # experiments are bundles of their own, so members move to the last batch dimension
    inputs = (x if x.ndim > 2 else x[None] for x in (parameters[..., None, :], designs, times))
    solution = simulator.bundle(*(x.transpose(-3, -2) for x in inputs))
    return solution.radius.transpose(-3, -2), solution.velocity.transpose(-3, -2)


def predict_collapse(
    simulator: Simulator,
    parameters: Float[Tensor, "*#batch parameters"],
    designs: Float[Tensor, "experiments 2"],
    measured: Float[Tensor, "experiments"],
    shifts: Float[Tensor, "*#batch experiments 3"] | None = None,
    *,
    bundled: bool = False,
) -> Float[Tensor, "*#batch experiments"]:
    """Collapse times that would be measured of each gel in each shot: ``batch_shape x E``,
    dimensionless; NaN without one.

    Args:
        simulator: makes the bubbles.
        parameters: SI.
        designs: measured.
        measured: measured times; a collapse is looked for up to two and a half times as late.
        shifts: nuisances in physical size.
        bundled: as for :func:`imr_torch.observe.predict`.
    """
    times = measured[:, None] * _GRID.to(measured)
    distortion = Distortion.of(parameters)
    if distortion is not None:
        errors = distortion.shifts_of(
            designs, simulator.conditions.surroundings.max_radius(designs[:, 0])
        )[0]
        shifts = errors if shifts is None else shifts + errors
    shifts = torch.zeros(*designs.shape[:-1], 3).to(designs) if shifts is None else shifts
    lost = ~((1.0 + shifts[..., 0] >= SMALLEST) & torch.isfinite(shifts).all(-1))
    shifts = torch.where(lost[..., None], 0.0, shifts)
    designs, scale = displaced(designs, times, shifts)[::2]
    rate = torch.ones_like(scale[..., 0])
    if distortion is not None:
        designs = distortion.placed(designs, times)[0]
        rate = torch.exp(distortion.clock)

    several = designs.shape[-2] > math.prod(_NODES)
    solve = _interpolated_collapses if several else _simulated_collapses
    found = solve(simulator, parameters, designs, measured, bundled)
    return torch.where(lost, torch.nan, found / rate * scale[..., 0] - shifts[..., 1])


def _simulated_collapses(
    simulator: Simulator, parameters: Tensor, designs: Tensor, about: Tensor, bundled: bool
) -> Tensor:
    """Collapse times ``... x E`` of true designs, looked for about ``E`` times."""

    def solved(times: Tensor) -> Tensor:
        bubbles = simulate_bubbles(simulator, parameters, designs, times, bundled=bundled)
        return first_minimum(times, *bubbles)

    times = about[:, None] * _GRID.to(about)
    found = solved(times[..., :_USUAL])
    if bool(torch.isnan(found).any()):
        found = solved(times)
    lost = torch.isnan(found)
    near = torch.where(lost, about, found)[..., None] + _CLOSE * about[:, None]
    return torch.where(lost, torch.nan, solved(near))


def _interpolated_collapses(
    simulator: Simulator, parameters: Tensor, designs: Tensor, about: Tensor, bundled: bool
) -> Tensor:
    """The same, interpolated between designs where every gel collapses at all nodes or at none."""
    places = torch.stack((designs[..., 0].log(), designs[..., 1]), -1)
    steps = torch.tensor(_STEPS, dtype=torch.float64)
    low = torch.floor(places.reshape(-1, 2).amin(0) / steps) * steps
    half = 0.5 * (torch.ceil(places.reshape(-1, 2).amax(0) / steps) * steps - low)
    unit = torch.cartesian_prod(
        *(torch.cos(torch.pi * (torch.arange(n).double() + 0.5) / n) for n in _NODES)
    )
    nodes = low + half * (1.0 + unit)
    nodes[:, 0] = nodes[:, 0].exp()
    gels, rows = _distinct_gels(parameters, bundled)
    middle = about.mean().expand(len(nodes))
    times = _simulated_collapses(simulator, gels, nodes, middle, bundled)[..., rows, :]
    lost = times.isnan()
    if bool((lost.any(-1) & ~lost.all(-1)).any()):
        return _simulated_collapses(simulator, parameters, designs, about, bundled)
    weights = _powers((places - low) / half - 1.0) @ torch.linalg.inv(_powers(unit))
    return (weights * times[..., None, :]).sum(-1)


def _powers(places: Tensor) -> Tensor:
    """Monomials ``... x 12`` of places in the unit square, as many as there are nodes."""
    first, second = (places[..., i, None] ** torch.arange(n) for i, n in enumerate(_NODES))
    return (first[..., None] * second[..., None, :]).flatten(-2)


def _distinct_gels(parameters: Tensor, bundled: bool) -> tuple[Tensor, Tensor]:
    """Gels to be simulated, and which of them each member has: members of a bundle of which only
    the design is moved share the bubbles of the leader, draws of one gel each other's.
    """
    if not bundled:
        gels, rows = torch.unique(
            parameters.reshape(-1, parameters.shape[-1]), dim=0, return_inverse=True
        )
        return gels, rows.reshape(parameters.shape[:-1])
    moved = (parameters != parameters[..., :1, :]).any(-1)
    moved = moved.reshape(-1, moved.shape[-1]).any(0)
    moved[0] = True
    return parameters[..., moved, :], torch.where(moved, moved.cumsum(0) - 1, 0)


def load_collapse_times(*paths: str | Path) -> tuple[CollapseShot, ...]:
    r"""Read shots from tables with the columns ``experiment_id, rmax_m, stretch, collapse_time_s``,
    one row a shot.

    Args:
        paths: CSV files; further columns ``collapse_time_sd_s``, ``rmax_sd_m`` and ``stretch_sd``
            give errors. Or MATLAB files with the array ``pIMR_array`` of Zhu et al. (2025): Rmax
            in m, stretch and collapse time in s, one row a shot. A JSON file of the same name
            beside each may state the medium.

    Raises:
        InputDataError: for a missing column, a cell that is no number, a value that no bubble has,
            or a repeated name.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.observe import load_collapse_times
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "shots.csv"
    ...     _ = path.write_text("experiment_id,rmax_m,stretch,collapse_time_s\na,3.4e-4,8.0,3.05e-5\n")
    ...     load_collapse_times(path)[0].stretch
    8.0
    """
    shots: list[CollapseShot] = []
    for path in map(Path, paths):
        if not is_shot_file(path):
            raise InputDataError(
                f"{path}: is no table of collapse times; expected the columns "
                f"{', '.join(SHOT_COLUMNS)}."
            )
        stated = Sidecar(path).stated
        if path.suffix.lower() == ".mat":
            shots += _shots_of_array(path, stated)
            continue
        shots += _shots_of_table(read_text(path)[0], stated)
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
    array = read_matlab(path)[0].values[SHOT_ARRAY]
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind != "f":
        raise InputDataError(
            f"{path}: {SHOT_ARRAY} has shape {array.shape}; expected one row a shot of Rmax in m, "
            "stretch and collapse time in s."
        )
    return [
        CollapseShot(f"{path.stem}_{i:03d}", *row, source=str(path), stated=stated)
        for i, row in enumerate(array.tolist(), 1)
    ]


def _shots_of_table(table: Content, stated: Statement | None) -> list[CollapseShot]:
    """The shots of a table of text."""
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
        name: table.vectors(name)[0].tolist() for name in table.values if name != "experiment_id"
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
        shots.append(CollapseShot(name, *values, **errors, source=str(table.path), stated=stated))
    return shots


def serial_correlation(values: Float[Tensor, "shots"], order: Float[Tensor, "shots"]) -> float:
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


def scatter_of(
    missed: Float[Tensor, "shots"], variance: Float[Tensor, "shots"], fitted: float
) -> float:
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
