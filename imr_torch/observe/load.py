"""Reading curves from files: tables of text and MATLAB files, read by an explicit mapping of their columns or variables.

:func:`load_traces` looks at the content of a file, not at its name. A :class:`~imr_torch.observe.layout.Layout` says what
the file means; without one, the names in the file must select exactly one of ``KNOWN_LAYOUTS``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.observe import matlab
from imr_torch.observe.layout import EXAMPLE, KNOWN_LAYOUTS, LENGTHS, TIMES, Layout
from imr_torch.observe.raw import RawCurve
from imr_torch.observe.readers import READERS
from imr_torch.observe.table import Table, read_table, table_curves
from imr_torch.observe.traces import MIN_SAMPLES, LeftOut, TraceSet


def load_traces(*paths: str | Path, layout: Layout | None = None) -> TraceSet:
    """Read curves from files.

    Args:
        paths: files of a registered format (:func:`imr_torch.observe.register_reader`); CSV files with header
            ``experiment_id,time_s,radius_m`` (a JSON file of the same name beside it adds what the laboratory says), tables of
            text, or MATLAB files (v4 to v7.3).
        layout: what the columns or variables mean, the same for all files; None: one of ``KNOWN_LAYOUTS`` must fit.

    Returns:
        The traces in SI units, the rows that were left out and why, and notes on the decisions taken.

    Raises:
        InputDataError: if a file cannot be used; the message names file, place, value and remedy.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch import load_traces
    >>> rows = ["shot 1,0,2e-4", "shot 1,1e-6,1.9e-4", "shot 1,2e-6,1.7e-4", "shot 1,3e-6,1.4e-4", "shot 1,4e-6,1e-4"]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "gel.csv"
    ...     _ = path.write_text(chr(10).join(["experiment_id,time_s,radius_m", *rows]))
    ...     traces = load_traces(path)
    >>> traces.ids, len(traces["shot 1"])
    (('shot 1',), 5)
    """
    if not paths:
        raise InputDataError("load_traces was given no file; name at least one.")
    return TraceSet.join([_load_file(Path(path), layout) for path in paths])


def _load_file(path: Path, layout: Layout | None) -> TraceSet:
    file, head = str(path), _head(path)
    for reader in READERS.values():
        if reader.recognises(path, head):
            if layout is not None:
                raise InputDataError(f"{path}: is read as {reader.name!r}, which takes no layout; leave the layout out.")
            return reader.read(path)
    data: matlab.Variables | Table = matlab.read_variables(path) if _is_matlab(path, head) else read_table(path)
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


def _head(path: Path) -> bytes:
    """The first bytes of a file that can be one."""
    if not path.exists():
        raise InputDataError(f"{path}: no such file; check the name and the folder ({path.parent.resolve()}).")
    if path.is_dir():
        raise InputDataError(f"{path}: is a folder; name the files in it.")
    with path.open("rb") as stream:
        head = stream.read(4096)
    if not head.strip():
        raise InputDataError(f"{path}: the file is empty; export the curve again.")
    return head


def _is_matlab(path: Path, head: bytes) -> bool:
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
