"""Files in, curves out: tables of text and MATLAB files, read by an explicit mapping of their columns or variables.

:func:`load_traces` looks at the content of a file, not at its name. A :class:`Layout` says what the file means (names,
units, scales); without one, the names in the file must select exactly one of ``KNOWN_LAYOUTS``. Dimensionless times are
undone with ``t = t* Rmax sqrt(rho / p_inf)`` (Estrada et al., J. Mech. Phys. Solids 112, 2018).
"""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.observe import matlab
from imr_torch.observe.traces import MIN_SAMPLES, Given, LeftOut, RawCurve, TraceSet, row_ranges

LENGTHS = {"m": 1.0, "um": 1e-6, "mm": 1e-3}
TIMES = {"s": 1.0, "us": 1e-6, "ms": 1e-3}
RADIUS_UNITS = (*LENGTHS, "px", "dimensionless")
TIME_UNITS = (*TIMES, "frames", "dimensionless")
PEAKS = (None, "first_row", "time_zero")
EXAMPLE = 'Layout("<name>", radius_unit="um", time="<name>", time_unit="us")'


@dataclass(frozen=True)
class Layout:
    """What the columns of a table, or the variables of a MATLAB file, mean.

    A name is the name of a variable or column; the columns of a table without header are named ``"1"``, ``"2"``, ...

    Args:
        radius: name of the radius (in MATLAB a vector, or a cell array of vectors: one for each curve).
        radius_unit: one of m, um, mm, px, dimensionless (R/Rmax).
        time: name of the time, or None: frames counted from 0.
        time_unit: one of s, us, ms, frames, dimensionless; ignored without ``time``.
        experiment: name of a column that tells the curves of a table apart.
        frame_interval: seconds between frames, or a variable that holds it.
        pixel_size: metres per pixel, or a variable that holds it.
        max_radius: maximum radius of each curve: a number, or a variable.
        max_radius_unit: m, um or mm.
        max_radius_entries: which entries of ``max_radius`` belong to the curves, counted from 1.
        rest_radius: variable with the equilibrium radius (one, or one for each curve).
        rest_radius_unit: one of the radius units.
        density: kg/m^3, used by the source to make time dimensionless.
        far_field_pressure: Pa, used by the source to make time dimensionless.
        inserted_peak: where the source inserted a fitted peak that is no camera frame: None, "first_row", "time_zero".
        separator: number that fills the rows between curves of a table.

    Raises:
        InputDataError: if a unit is unknown, a number is not positive, or a scale that the units need is missing.
    """

    radius: str
    _: KW_ONLY
    radius_unit: str
    time: str | None = None
    time_unit: str = "s"
    experiment: str | None = None
    frame_interval: float | str | None = None
    pixel_size: float | str | None = None
    max_radius: float | str | None = None
    max_radius_unit: str = "m"
    max_radius_entries: tuple[int, ...] | None = None
    rest_radius: str | None = None
    rest_radius_unit: str = "m"
    density: float = 998.0
    far_field_pressure: float = 101325.0
    inserted_peak: str | None = None
    separator: float | None = None

    def __post_init__(self) -> None:
        for name, allowed in (
            ("radius_unit", RADIUS_UNITS),
            ("time_unit", TIME_UNITS),
            ("max_radius_unit", tuple(LENGTHS)),
            ("rest_radius_unit", RADIUS_UNITS),
            ("inserted_peak", PEAKS),
        ):
            if getattr(self, name) not in allowed:
                listed = ", ".join(map(str, allowed))
                raise InputDataError(f"Layout.{name} is '{getattr(self, name)}'; choose one of: {listed}.")
        for name in ("frame_interval", "pixel_size", "max_radius", "density", "far_field_pressure"):
            value = getattr(self, name)
            if isinstance(value, (int, float)) and not 0.0 < value < math.inf:
                raise InputDataError(f"Layout.{name} is {value}; expected a positive number in SI units.")
        if self.max_radius_entries is not None and (not self.max_radius_entries or min(self.max_radius_entries) < 1):
            raise InputDataError(f"Layout.max_radius_entries is {self.max_radius_entries}; entries are counted from 1.")
        self._check_scales()

    def _check_scales(self) -> None:
        if self.time is None and self.frame_interval is None:
            raise InputDataError(
                "The layout names no time and no frame_interval; set time='<name>', or frame_interval=<seconds between frames>."
            )
        if self.time_unit == "frames" and self.frame_interval is None:
            raise InputDataError("Layout.time_unit is 'frames'; set frame_interval=<seconds between frames>.")
        if "px" in (self.radius_unit, self.rest_radius_unit) and self.pixel_size is None:
            raise InputDataError(
                "Layout.radius_unit is 'px'; set pixel_size=<metres per pixel>, or the variable that holds it."
            )
        if "dimensionless" in (self.radius_unit, self.time_unit, self.rest_radius_unit) and self.max_radius is None:
            raise InputDataError(
                "The layout has a 'dimensionless' unit; set max_radius=<metres>, or the variable that holds it."
            )

    @property
    def time_per_length(self) -> float:
        """``sqrt(rho / p_inf)`` in s/m: dimensionless time times ``Rmax`` times this is seconds."""
        return math.sqrt(self.density / self.far_field_pressure)

    def length_factor(self, unit: str, pixel_size: float | None = None, max_radius_m: float | None = None) -> float:
        """Metres per ``unit``."""
        factor = {**LENGTHS, "px": pixel_size, "dimensionless": max_radius_m}[unit]
        assert factor is not None
        return factor

    def names(self) -> tuple[str, ...]:
        """The variables or columns that the layout asks for."""
        named = ("radius", "time", "experiment", "frame_interval", "pixel_size", "max_radius", "rest_radius")
        return tuple(value for value in (getattr(self, name) for name in named) if isinstance(value, str))

    @classmethod
    def from_text(cls, text: str) -> "Layout":
        """Read the form of the command line, ``"radius=Rnew,radius_unit=px,pixel_size=deltax,frame_interval=deltat"``.

        The entries of ``max_radius_entries`` are joined by ``+``: ``max_radius_entries=1+2+4``.

        Raises:
            InputDataError: if a setting is unknown, repeated, has no value or a wrong one, or the radius is missing.
        """
        known = [field.name for field in fields(cls)]
        settings: dict[str, Any] = {}
        for part in filter(None, (p.strip() for p in text.split(","))):
            name, equals, value = (x.strip() for x in part.partition("="))
            if not equals or not value or name not in known or name in settings:
                raise InputDataError(
                    f"Layout text: cannot use '{part}'; write name=value once, with a name among {', '.join(known)}."
                )
            settings[name] = _setting(name, value)
        for needed in ("radius", "radius_unit"):
            if needed not in settings:
                raise InputDataError(f"Layout text '{text}' has no {needed}; write radius=<name>,radius_unit=um,...")
        return cls(**settings)


def _setting(name: str, value: str) -> Any:
    if value.lower() == "none":
        return None
    try:
        if name == "max_radius_entries":
            return tuple(int(x) for x in value.split("+"))
        if name in ("density", "far_field_pressure", "separator"):
            return float(value)
    except ValueError:
        raise InputDataError(f"Layout text: {name} is '{value}'; expected a number (entries as 1+2+4).") from None
    if name in ("frame_interval", "pixel_size", "max_radius"):
        try:
            return float(value)
        except ValueError:
            return value
    return value


KNOWN_LAYOUTS: Mapping[str, Layout] = MappingProxyType(
    {
        "experiment_table": Layout("radius_m", radius_unit="m", time="time_s", experiment="experiment_id"),
        "separated_table": Layout("2", radius_unit="um", time="1", time_unit="us", separator=-1000.0),
        "dimensionless_cells": Layout(
            "R_nondim_All",
            radius_unit="dimensionless",
            time="t_nondim_All",
            time_unit="dimensionless",
            max_radius="RmaxList",
            inserted_peak="time_zero",
        ),
        "fitted_peak_first": Layout("Rnew", radius_unit="m", time="t", max_radius="RmaxAll", inserted_peak="first_row"),
        "pixels_by_frame": Layout("Rnew", radius_unit="px", pixel_size="deltax", frame_interval="deltat"),
        "micrometres_with_rest": Layout("R", radius_unit="um", time="t", rest_radius="Req", rest_radius_unit="um"),
    }
)


def load_traces(*paths: str | Path, layout: Layout | None = None) -> TraceSet:
    """Read curves from files.

    Args:
        paths: CSV files with header ``experiment_id,time_s,radius_m`` (a JSON file of the same name beside it adds what
            the laboratory says), tables of text, or MATLAB files (v4 to v7.3).
        layout: what the columns or variables mean, the same for all files; None: one of ``KNOWN_LAYOUTS`` must fit.

    Returns:
        The traces in SI units, the rows that were left out and why, and notes on the decisions taken.

    Raises:
        InputDataError: if a file cannot be used; the message names file, place, value and remedy.
    """
    if not paths:
        raise InputDataError("load_traces was given no file; name at least one.")
    return TraceSet.join([_load_file(Path(path), layout) for path in paths])


def _load_file(path: Path, layout: Layout | None) -> TraceSet:
    file = str(path)
    data: matlab.Variables | Table = matlab.read_variables(path) if _is_matlab(path) else read_table(path)
    notes: list[str] = []
    if layout is None:
        name = _select_layout(file, data)
        layout, notes = KNOWN_LAYOUTS[name], [f"{file}: read with the known layout '{name}'."]
    if isinstance(data, Table):
        raw, left_out, more = table_curves(path, data, layout)
        constants = _Constants(layout, *(_number_only(file, layout, n) for n in ("frame_interval", "pixel_size")))
        tops: list[float | None] = [_number_only(file, layout, "max_radius")] * len(raw)
    else:
        raw, left_out = matlab.curves(path, data, layout), []
        constants = _Constants(
            layout,
            matlab.number(file, data, "frame_interval", layout.frame_interval),
            matlab.number(file, data, "pixel_size", layout.pixel_size),
        )
        tops, more = matlab.max_radii(file, data, layout, raw, constants.frame_interval)
        raw = _with_rest_radius(raw, data, constants, tops)
    traces = []
    for curve, top in zip(raw, tops, strict=True):
        converted, record = constants.to_si(curve, top)
        trace, dropped = converted.to_trace()
        left_out += record + dropped
        traces += [] if trace is None else [trace]
    if not traces:
        why = "; ".join(f"row(s) {x.rows or '-'}: {x.reason}" for x in left_out[:4]) or "it holds no curve"
        raise InputDataError(
            f"{file}: no usable curve ({why}). Give a record with at least {MIN_SAMPLES} frames of the bubble."
        )
    return TraceSet(tuple(traces), tuple(left_out), (*notes, *more))


def _is_matlab(path: Path) -> bool:
    if not path.exists():
        raise InputDataError(f"{path}: no such file; check the name and the folder ({path.parent.resolve()}).")
    if path.is_dir():
        raise InputDataError(f"{path}: is a folder; name the files in it.")
    with path.open("rb") as stream:
        head = stream.read(4096)
    if not head.strip():
        raise InputDataError(f"{path}: the file is empty; export the curve again.")
    if head.startswith((b"MATLAB 5.0", b"MATLAB 7.3", b"\x89HDF")) or (path.suffix.lower() == ".mat" and b"\0" in head):
        return True
    if b"\0" in head:
        raise InputDataError(
            f"{path}: unknown container (first bytes {head[:8]!r}); expected text (CSV) or a MATLAB file: export the "
            "curves as CSV with the header experiment_id,time_s,radius_m."
        )
    return False


def _select_layout(file: str, data: "matlab.Variables | Table") -> str:
    found = data.columns if isinstance(data, Table) else tuple(data)
    fitting = [name for name, known in KNOWN_LAYOUTS.items() if set(known.names()) <= set(found)]
    if isinstance(data, Table):
        fitting = [name for name in fitting if data.has_rows_of(KNOWN_LAYOUTS[name].separator)]
    if len(fitting) == 1:
        return fitting[0]
    holds = f"columns {', '.join(data.columns)}" if isinstance(data, Table) else matlab.describe(data)
    why = f"several known layouts fit ({', '.join(fitting)})" if fitting else "no known layout fits"
    raise InputDataError(
        f"{file}: {why}. The file holds: {holds}. Say what they mean, for example layout={EXAMPLE}, or "
        'layout=KNOWN_LAYOUTS["<name>"] with a name among ' + f"{', '.join(KNOWN_LAYOUTS)}."
    )


@dataclass(frozen=True)
class _Constants:
    """A layout with its scales as numbers (s and m/px)."""

    layout: Layout
    frame_interval: float | None
    pixel_size: float | None

    def to_si(self, curve: RawCurve, max_radius: float | None) -> tuple[RawCurve, list[LeftOut]]:
        """The curve in s and m, without an inserted peak."""
        layout = self.layout
        top = None if max_radius is None else max_radius * layout.length_factor(layout.max_radius_unit)
        if top is not None and not 0.0 < top < math.inf:
            raise InputDataError(
                f"{curve.file}: experiment '{curve.experiment_id}': max_radius is {max_radius}; expected a positive length."
            )
        radius = curve.radius * layout.length_factor(layout.radius_unit, self.pixel_size, top)
        given = replace(curve.given, max_radius_m=top) if top is not None else curve.given
        curve = replace(curve, time=self._times(curve, top), radius=radius, given=given)
        return self._without_peak(curve)

    def _times(self, curve: RawCurve, top: float | None) -> np.ndarray:
        layout, dt = self.layout, self.frame_interval
        if curve.time is None or layout.time_unit == "frames":
            assert dt is not None
            return (np.arange(len(curve.radius)) if curve.time is None else curve.time) * dt
        scale = top * layout.time_per_length if layout.time_unit == "dimensionless" and top else None
        time = curve.time * (TIMES[layout.time_unit] if scale is None else scale)
        if dt is not None and len(time) > 1:
            step = float(np.nanmedian(np.diff(time)))
            if not abs(step / dt - 1.0) <= matlab.SPACING_TOLERANCE:
                raise InputDataError(
                    f"{curve.file}: experiment '{curve.experiment_id}': times are {step:.4g} s apart and "
                    f"frame_interval is {dt:.4g} s; correct time_unit='{layout.time_unit}', max_radius or "
                    "frame_interval."
                )
        return time

    def _without_peak(self, curve: RawCurve) -> tuple[RawCurve, list[LeftOut]]:
        assert curve.time is not None
        where = {None: [], "first_row": [0] if len(curve.time) else [], "time_zero": np.flatnonzero(curve.time == 0.0)}
        chosen = where[self.layout.inserted_peak]
        if len(chosen) == 0:
            return curve, []
        peak, stated = float(curve.radius[chosen[0]]), curve.given.max_radius_m
        if not peak > 0.0 or (stated is not None and abs(peak / stated - 1.0) > 0.01):
            raise InputDataError(
                f"{curve.file}: experiment '{curve.experiment_id}', row {curve.rows[chosen[0]]}: radius {peak:.5g} m "
                f"is not the fitted peak (max_radius {stated} m) that inserted_peak='{self.layout.inserted_peak}' "
                "announces; set inserted_peak=None if the row is a camera frame."
            )
        given = replace(curve.given, max_radius_m=stated or peak, time_of_max_s=float(curve.time[chosen[0]]))
        keep = ~np.isin(np.arange(len(curve.time)), chosen)
        return replace(curve, given=given).without(keep, "fitted peak inserted by the source, not a camera frame")


def _with_rest_radius(
    raw: list[RawCurve], variables: matlab.Variables, constants: _Constants, tops: Sequence[float | None]
) -> list[RawCurve]:
    layout = constants.layout
    if layout.rest_radius is None or not raw:
        return raw
    file = raw[0].file
    found = matlab.entries(file, variables, layout.rest_radius)
    if len(found) not in (1, len(raw)) or not (found > 0.0).all():
        raise InputDataError(
            f"{file}: variable '{layout.rest_radius}' (rest_radius) holds {found[:6]} for {len(raw)} curves; expected "
            "one positive length, or one for each curve: set rest_radius=None to leave it aside."
        )
    out = []
    for curve, value, top in zip(raw, np.broadcast_to(found, len(raw)), tops, strict=True):
        top_m = None if top is None else top * LENGTHS[layout.max_radius_unit]
        rest = float(value) * layout.length_factor(layout.rest_radius_unit, constants.pixel_size, top_m)
        out.append(replace(curve, given=replace(curve.given, rest_radius_m=rest)))
    return out


def _number_only(file: str, layout: Layout, name: str) -> float | None:
    value = getattr(layout, name)
    if isinstance(value, str):
        raise InputDataError(f"{file}: Layout.{name} is '{value}'; a table has no such variable: give the number.")
    return value


@dataclass(frozen=True, eq=False)
class Table:
    """The rows of a text file: names of the columns, cells as text, and the line each row stands on."""

    columns: tuple[str, ...]
    cells: list[list[str]]
    lines: list[int]

    def has_rows_of(self, value: float | None) -> bool:
        """Whether a row consists of ``value`` alone (True for None)."""
        return value is None or any(_all_equal(row, value) for row in self.cells)


def _all_equal(row: list[str], value: float) -> bool:
    return all(_is_number(cell) and float(cell) == value for cell in row)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def read_table(path: Path) -> Table:
    """Read a table of text, with or without header; columns are divided by comma, semicolon, tab or blanks.

    Raises:
        InputDataError: if the file is no text, has no rows, or rows of different lengths.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputDataError(
            f"{path}: is neither a MATLAB file nor UTF-8 text ({error.reason} at byte {error.start}); export as CSV in UTF-8."
        ) from None
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    mark = next((c for c in ";\t," if c in lines[0][1]), None)
    split = [line.split() if mark is None else next(csv.reader([line], delimiter=mark)) for _, line in lines]
    rows, numbers = [[cell.strip() for cell in row] for row in split], [i for i, _ in lines]
    has_header = not all(_is_number(cell) for cell in rows[0])
    columns = tuple(rows[0]) if has_header else tuple(str(i + 1) for i in range(len(rows[0])))
    rows, numbers = (rows[1:], numbers[1:]) if has_header else (rows, numbers)
    if not rows:
        raise InputDataError(f"{path}: has the header {', '.join(columns)} and no rows; export the curve again.")
    for row, line in zip(rows, numbers, strict=True):
        if len(row) != len(columns):
            raise InputDataError(
                f"{path}: row {line} has {len(row)} field(s) and the first row {len(columns)}; write every row with "
                "the same columns (a lost frame as NaN)."
            )
    return Table(columns, rows, numbers)


def table_curves(path: Path, table: Table, layout: Layout) -> tuple[list[RawCurve], list[LeftOut], list[str]]:
    """The curves of a table in its own units, rows left out on the way, and notes.

    Raises:
        InputDataError: if a column is missing, or a cell is no number.
    """
    file = str(path)
    for name in filter(None, (layout.radius, layout.time, layout.experiment)):
        if name not in table.columns:
            raise InputDataError(
                f"{file}: column '{name}', named by the layout, is not in the file. It holds: columns "
                f"{', '.join(table.columns)}. Name one of these in the Layout."
            )
    radius = _column(file, table, layout.radius)
    time = None if layout.time is None else _column(file, table, layout.time)
    groups, left_out = _groups(path, table, layout)
    said, notes = _given_beside(path, list(groups)) if layout.experiment else ({}, [])
    curves = []
    for name, chosen in groups.items():
        lines = np.array(table.lines)[chosen]
        part = None if time is None else time[chosen]
        curves.append(RawCurve(file, name, part, radius[chosen], lines, said.get(name, Given())))
    return curves, left_out, notes


def _column(file: str, table: Table, name: str) -> np.ndarray:
    k = table.columns.index(name)
    for row, line in zip(table.cells, table.lines, strict=True):
        if row[k] and not _is_number(row[k]):
            raise InputDataError(
                f"{file}: row {line}, column '{name}' is '{row[k]}', not a number; write numbers with a decimal point, "
                "and a lost frame as NaN."
            )
    return np.array([float(row[k] or "nan") for row in table.cells])


def _groups(path: Path, table: Table, layout: Layout) -> tuple[dict[str, list[int]], list[LeftOut]]:
    """Row indices of each curve, by experiment column, by separator rows, or all in one."""
    if layout.experiment is not None:
        k = table.columns.index(layout.experiment)
        groups: dict[str, list[int]] = {}
        for i, row in enumerate(table.cells):
            if not row[k]:
                raise InputDataError(
                    f"{path}: row {table.lines[i]}, column '{layout.experiment}' is empty; name the experiment."
                )
            groups.setdefault(row[k], []).append(i)
        return groups, []
    if layout.separator is None:
        return {path.stem: list(range(len(table.cells)))}, []
    marks = [i for i, row in enumerate(table.cells) if _all_equal(row, layout.separator)]
    left_out = (
        [LeftOut(str(path), "", row_ranges(table.lines[i] for i in marks), "separator rows between curves")] if marks else []
    )
    parts = [list(range(a + 1, b)) for a, b in zip([-1, *marks], [*marks, len(table.cells)], strict=True)]
    if marks and 0 < len(parts[0]) < MIN_SAMPLES:
        left_out.append(
            LeftOut(str(path), "", row_ranges(table.lines[i] for i in parts[0]), "stray row(s) before the first separator")
        )
        parts[0] = []
    filled = [part for part in parts if part]
    return {f"{path.stem}_{i:03d}": part for i, part in enumerate(filled, 1)}, left_out


def _given_beside(path: Path, names: list[str]) -> tuple[dict[str, Given], list[str]]:
    """What a JSON file of the same name says about the experiments of a table."""
    beside = path.with_suffix(".json")
    if not beside.exists():
        return {}, []
    try:
        listed = json.loads(beside.read_text(encoding="utf-8"))["experiments"]
        entries = {str(entry["experiment_id"]): entry for entry in listed}
        said = {name: _given(entries[name]) for name in names if name in entries}
    except (ValueError, KeyError, TypeError) as error:
        raise InputDataError(
            f"{beside}: cannot be used ({type(error).__name__}: {error}); expected JSON with a list 'experiments' of "
            "entries with experiment_id, Rmax_m, Rinf_m, ...: correct it, or move it away."
        ) from error
    notes = [f"{beside}: gives the laboratory's values for {len(said)} of {len(names)} experiments."]
    extra = [name for name in entries if name not in names]
    if extra:
        notes.append(f"{beside}: describes {len(extra)} experiment(s) that {path.name} does not hold: {', '.join(extra[:5])}.")
    return said, notes


def _given(entry: dict[str, Any]) -> Given:
    names = ("Rmax_m", "t_Rmax_s", "Rinf_m", "Rinf_tail_std_m")
    top, time, rest, sd = (None if entry.get(name) is None else float(entry[name]) for name in names)
    return Given(top, time, rest, sd, entry.get("Rinf_settled"))
