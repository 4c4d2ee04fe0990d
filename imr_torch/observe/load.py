"""Reading curves from files, folders and glob patterns, and the conversion of their rows to SI
units.

:func:`load_traces` asks the registered readers for each file. A
:class:`~imr_torch.observe.layout.Layout` says what the file means; without one, its names must be
those of one of ``KNOWN_LAYOUTS``, or must say the units.
"""

import glob
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.observe import matlab
from imr_torch.observe.collapse import is_collapse_file
from imr_torch.observe.headers import heading, infer_layout
from imr_torch.observe.layout import KNOWN_LAYOUTS, LENGTHS, TIMES, Layout
from imr_torch.observe.raw import RawCurve
from imr_torch.observe.readers import read_file
from imr_torch.observe.sidecar import Sidecar
from imr_torch.observe.table import Table, radius_columns, table_curves
from imr_torch.observe.traces import MIN_SAMPLES, LeftOut, TraceSet

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".mat", ".xlsx", ".npz")
"""Endings of the files that are read when a folder is named."""

_TABLES = ("experiment_table", "separated_table")


def load_traces(*paths: str | Path, layout: Layout | None = None) -> TraceSet:
    """Read curves from files.

    Args:
        paths: files, folders (all files in them that end in one of ``SUFFIXES``), and patterns such
            as ``"gel7/*.csv"``. A file is a table of text or ``.xlsx`` (columns
            ``experiment_id,time_s,radius_m``, or time and radius with their units in the header,
            one column of radii a curve if there are several), a MATLAB file (v4 to v7.3), an
            ``.npz`` with ``time_s`` and ``radius_m``, or of a registered format
            (:func:`imr_torch.observe.register_reader`). A JSON file of the same name beside it adds
            what the laboratory says (:mod:`imr_torch.observe.sidecar`).
        layout: what the columns or variables mean, the same for all files; None: names and units in
            the file must say it.

    Returns:
        The traces in SI units, the rows that were left out and why, and notes on the decisions
        taken.

    Raises:
        InputDataError: if a file cannot be used; the message names file, place, value and remedy. A
            unit that is written nowhere is asked for, not guessed.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch import load_traces
    >>> rows = ["0,200", "1,190", "2,170", "3,140", "4,100"]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "gel.csv"
    ...     _ = path.write_text(chr(10).join(["time (us),R (um)", *rows]))
    ...     traces = load_traces(path)
    >>> traces.ids, round(1e6 * traces["gel"].radius_m.max().item(), 3)  # um
    (('gel',), 200.0)
    """
    if not paths:
        raise InputDataError("load_traces was given no file; name at least one.")
    return TraceSet.join([load_file(path, layout) for path in find_files(*paths)])


def find_files(*paths: str | Path) -> list[Path]:
    """The files that names of files, folders and patterns stand for, in order.

    Raises:
        InputDataError: if a folder holds no file of a known ending, or no file fits a pattern.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.observe import find_files
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for name in ("b.csv", "a.csv", "a.json"):
    ...         (Path(folder) / name).touch()
    ...     [path.name for path in find_files(folder)]
    ['a.csv', 'b.csv']
    """
    found: list[Path] = []
    for name in paths:
        if not str(name) or "\0" in str(name):
            raise InputDataError(f"{str(name)!r} names no file or folder; give the name of one.")
    for path in map(Path, paths):
        if path.is_dir():
            inside = sorted(
                p
                for p in path.iterdir()
                if p.suffix.lower() in SUFFIXES and not p.name.startswith((".", "~$"))
            )
            if not inside:
                raise InputDataError(
                    f"{path}: the folder holds no file of curves; expected files that end in "
                    f"{_SUFFIXES}."
                )
            found += inside
        elif not path.exists() and glob.has_magic(str(path)):
            inside = sorted(
                p for p in map(Path, glob.glob(str(path), recursive=True)) if p.is_file()
            )
            if not inside:
                raise InputDataError(
                    f"{path}: no file fits this pattern; check it and the folder ({Path.cwd()})."
                )
            found += inside
        else:
            found.append(path)
    return found


_SUFFIXES = ", ".join(SUFFIXES)


def load_file(path: Path, layout: Layout | None) -> TraceSet:
    """The curves of one file, with what the JSON file beside it says."""
    if layout is None and is_collapse_file(path):
        raise InputDataError(
            f"{path}: holds collapse times and no curves; characterize takes such shots "
            "(load_collapse_times reads them)."
        )
    return Sidecar(path).added_to(read_file(path, layout))


def table_traces(path: Path, table: Table, layout: Layout | None) -> TraceSet:
    """The curves of a table, by a layout or by the names and units in its header."""
    file = str(path)
    notes = []
    if layout is None:
        layout, notes = _table_layout(path, table)
    else:
        _check_header(file, table, layout)
    raw, left_out = table_curves(path, table, layout)
    constants = _Constants(
        layout, *(_number_only(file, layout, n) for n in ("frame_interval", "pixel_size"))
    )
    tops: list[float | None] = [_number_only(file, layout, "max_radius")] * len(raw)
    return _to_traces(file, raw, constants, tops, left_out, notes)


def variable_traces(path: Path, variables: matlab.Variables, layout: Layout | None) -> TraceSet:
    """The curves of the variables of a file, by a layout or by their names and units."""
    file = str(path)
    notes = []
    if layout is None:
        layout, notes = _variable_layout(path, variables)
    raw = matlab.curves(path, variables, layout)
    constants = _Constants(
        layout,
        matlab.number(file, variables, "frame_interval", layout.frame_interval),
        matlab.number(file, variables, "pixel_size", layout.pixel_size),
    )
    tops, more = matlab.max_radii(file, variables, layout, raw, constants.frame_interval)
    raw = _with_rest_radius(raw, variables, constants, tops)
    return _to_traces(file, raw, constants, tops, [], [*notes, *more])


def _to_traces(
    file: str,
    raw: Sequence[RawCurve],
    constants: "_Constants",
    tops: Sequence[float | None],
    left_out: list[LeftOut],
    notes: list[str],
) -> TraceSet:
    """Curves in SI units, and what was left out of them."""
    traces = []
    left_out = list(left_out)
    for curve, top in zip(raw, tops, strict=True):
        converted, record = constants.to_si(curve, top)
        trace, dropped = converted.to_trace()
        left_out += record + dropped
        traces += [] if trace is None else [trace]
    if not traces:
        why = (
            "; ".join(f"row(s) {x.rows or '-'}: {x.reason}" for x in left_out[:4])
            or "it holds no curve"
        )
        raise InputDataError(
            f"{file}: no usable curve ({why}). Give a record with at least {MIN_SAMPLES} frames "
            "of the bubble."
        )
    return TraceSet(tuple(traces), tuple(left_out), tuple(notes))


def _table_layout(path: Path, table: Table) -> tuple[Layout, list[str]]:
    """The layout that the header of a table says, or the JSON file beside it."""
    for name in _TABLES:
        known = KNOWN_LAYOUTS[name]
        if set(known.names()) <= set(table.columns) and table.has_rows_of(known.separator):
            return known, [f"{path}: read with the known layout '{name}'."]
    units = table.units or ("",) * len(table.columns)
    headings = [heading(column, below) for column, below in zip(table.columns, units, strict=True)]
    said = Sidecar(path).said
    if not table.has_header and len(table.columns) == 2 and said.time_unit and said.radius_unit:
        headings = [replace(headings[0], bare="t"), replace(headings[1], bare="R")]
    numbers = {
        column: values for column in table.columns if (values := table.numbers(column)) is not None
    }
    layout = infer_layout(str(path), headings, numbers, said, f"columns {', '.join(table.columns)}")
    return layout, [_decision(path, layout)]


def _variable_layout(path: Path, variables: matlab.Variables) -> tuple[Layout, list[str]]:
    """The known layout whose variables a file holds, or the one that names and units say."""
    fitting = [
        name for name, known in KNOWN_LAYOUTS.items() if set(known.names()) <= set(variables)
    ]
    if len(fitting) == 1:
        return KNOWN_LAYOUTS[fitting[0]], [f"{path}: read with the known layout '{fitting[0]}'."]
    holds = matlab.describe(variables)
    if fitting:
        raise InputDataError(
            f"{path}: several known layouts fit ({', '.join(fitting)}). The file holds: {holds}. "
            "Say what they mean with "
            '--layout "radius=<name>,radius_unit=um,time=<name>,time_unit=us" (in Python '
            'layout=Layout.from_text("...")).'
        )
    numbers = matlab.plain_vectors(variables)
    layout = infer_layout(
        str(path), [heading(name) for name in numbers], numbers, Sidecar(path).said, holds
    )
    return layout, [_decision(path, layout)]


def _decision(path: Path, layout: Layout) -> str:
    time = (
        f"time from '{layout.time}' in {layout.time_unit}"
        if layout.time
        else f"frames {layout.frame_interval:g} s apart"
    )
    return f"{path}: radius from '{layout.radius}' in {layout.radius_unit}, {time}."


def _check_header(file: str, table: Table, layout: Layout) -> None:
    """Refuse a layout that contradicts a unit written in the header."""
    units = table.units or ("",) * len(table.columns)
    written = {c: heading(c, below).unit for c, below in zip(table.columns, units, strict=True)}
    asked = [(column, layout.radius_unit) for column in radius_columns(file, table, layout)]
    asked += [(layout.time, layout.time_unit)] if layout.time in table.columns else []
    for column, unit in asked:
        if written[column] is not None and written[column] != unit:
            raise InputDataError(
                f"{file}: column '{column}' is in {written[column]} by its header and in {unit} "
                "by the layout; correct the "
                "layout, or leave it out."
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
        top = (
            None
            if max_radius is None
            else max_radius * layout.length_factor(layout.max_radius_unit)
        )
        if top is not None and not 0.0 < top < math.inf:
            raise InputDataError(
                f"{curve.file}: experiment '{curve.experiment_id}': max_radius is {max_radius}; "
                "expected a positive length."
            )
        radius = curve.radius * layout.length_factor(layout.radius_unit, self.pixel_size, top)
        given = replace(curve.given, max_radius_m=top) if top is not None else curve.given
        curve = replace(curve, time=self._times(curve, top), radius=radius, given=given)
        return self._without_peak(curve)

    def _times(self, curve: RawCurve, top: float | None) -> np.ndarray:
        layout = self.layout
        dt = self.frame_interval
        if curve.time is None or layout.time_unit == "frames":
            assert dt is not None
            return (np.arange(len(curve.radius)) if curve.time is None else curve.time) * dt
        scale = (
            top * layout.time_per_length if layout.time_unit == "dimensionless" and top else None
        )
        time = curve.time * (TIMES[layout.time_unit] if scale is None else scale)
        if dt is not None and len(time) > 1:
            step = float(np.nanmedian(np.diff(time)))
            if not abs(step / dt - 1.0) <= matlab.SPACING_TOLERANCE:
                raise InputDataError(
                    f"{curve.file}: experiment '{curve.experiment_id}': times are {step:.4g} s "
                    "apart and "
                    f"frame_interval is {dt:.4g} s; correct time_unit={layout.time_unit}, "
                    "max_radius or "
                    "frame_interval in --layout."
                )
        return time

    def _without_peak(self, curve: RawCurve) -> tuple[RawCurve, list[LeftOut]]:
        assert curve.time is not None
        where = {
            None: [],
            "first_row": [0] if len(curve.time) else [],
            "time_zero": np.flatnonzero(curve.time == 0.0),
        }
        chosen = where[self.layout.inserted_peak]
        if len(chosen) == 0:
            return curve, []
        peak = float(curve.radius[chosen[0]])
        stated = curve.given.max_radius_m
        if not peak > 0.0 or (stated is not None and abs(peak / stated - 1.0) > 0.01):
            raise InputDataError(
                f"{curve.file}: experiment '{curve.experiment_id}', row {curve.rows[chosen[0]]}: "
                f"radius {peak:.5g} m "
                f"is not the fitted peak (max_radius {stated} m) that "
                f"inserted_peak='{self.layout.inserted_peak}' "
                "announces; write inserted_peak=none into --layout if the row is a camera frame."
            )
        given = replace(
            curve.given, max_radius_m=stated or peak, time_of_max_s=float(curve.time[chosen[0]])
        )
        keep = ~np.isin(np.arange(len(curve.time)), chosen)
        return replace(curve, given=given).without(
            keep, "fitted peak inserted by the source, not a camera frame"
        )


def _with_rest_radius(
    raw: list[RawCurve],
    variables: matlab.Variables,
    constants: _Constants,
    tops: Sequence[float | None],
) -> list[RawCurve]:
    layout = constants.layout
    if layout.rest_radius is None or not raw:
        return raw
    file = raw[0].file
    found = matlab.entries(file, variables, layout.rest_radius)
    if len(found) not in (1, len(raw)) or not (found > 0.0).all():
        raise InputDataError(
            f"{file}: variable '{layout.rest_radius}' (rest_radius) holds {found[:6]} for "
            f"{len(raw)} curves; expected "
            "one positive length, or one for each curve: write rest_radius=none into --layout to "
            "leave it aside."
        )
    out = []
    for curve, value, top in zip(raw, np.broadcast_to(found, len(raw)), tops, strict=True):
        top_m = None if top is None else top * LENGTHS[layout.max_radius_unit]
        rest = float(value) * layout.length_factor(
            layout.rest_radius_unit, constants.pixel_size, top_m
        )
        out.append(replace(curve, given=replace(curve.given, rest_radius_m=rest)))
    return out


def _number_only(file: str, layout: Layout, name: str) -> float | None:
    value = getattr(layout, name)
    if isinstance(value, str):
        raise InputDataError(
            f"{file}: Layout.{name} is '{value}'; a table has no such variable: give the number."
        )
    return value
