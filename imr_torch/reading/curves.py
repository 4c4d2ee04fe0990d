"""From what a file holds to curves in SI units, with a record of every row left out.

A :class:`~imr_torch.reading.layout.Layout` says what names mean.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from imr_torch.errors import InputDataError, about_experiment
from imr_torch.html import render
from imr_torch.reading.content import Content
from imr_torch.reading.layout import (
    KNOWN_LAYOUTS,
    LENGTHS,
    TIMES,
    Layout,
    Said,
    Scales,
    find_scales,
    max_radii,
    rest_radii,
)
from imr_torch.reading.names import headings_of, infer_layout, unit_of
from imr_torch.reading.traces import (
    MIN_SAMPLES,
    RADIUS_RANGE_M,
    Given,
    LeftOut,
    RadiusTrace,
    TraceSet,
    row_ranges,
)

_TABLES = ("experiment_table", "separated_table")


@dataclass(frozen=True, eq=False)
class RawCurve:
    """One curve as rows of a file: NaN or zero radii still in it.

    Args:
        file: the file, for messages.
        experiment_id: name of the experiment.
        time: ``n`` array of times (in s once converted); numbers of frames where the file has no
            times.
        radius: ``n`` array of radii (in m once converted).
        rows: ``n`` array of row numbers counted from 1.
        asphericity: ``n`` array, or None: see :class:`imr_torch.reading.RadiusTrace`.
        given: what the laboratory says.
        left_out: rows that were taken out of it.
    """

    file: str
    experiment_id: str
    time: np.ndarray
    radius: np.ndarray
    rows: np.ndarray
    asphericity: np.ndarray | None = None
    given: Given = Given()
    left_out: tuple[LeftOut, ...] = ()

    @property
    def where(self) -> str:
        """File and experiment, for messages."""
        return f"{self.file}: experiment '{self.experiment_id}'"

    def take_rows(self, index: np.ndarray | slice) -> "RawCurve":
        """The curve at some of its rows, in the order of an index."""
        parts = {k: x[index] for k, x in vars(self).items() if isinstance(x, np.ndarray)}
        return replace(self, **parts)

    def leave_out(self, rows: np.ndarray, reason: str) -> "RawCurve":
        """The curve without the rows where the ``n`` boolean array ``rows`` holds."""
        return self.note_lost(rows, reason).take_rows(~rows)

    def note_lost(self, rows: np.ndarray, reason: str) -> "RawCurve":
        """The curve with a record of rows that will be taken out of it, if there are any."""
        numbers = row_ranges(self.rows[rows])
        record = LeftOut(self.file, self.experiment_id, numbers, reason)
        return replace(self, left_out=(*self.left_out, record)) if numbers else self

    def refuse_row(self, wrong: np.ndarray, text: str) -> None:
        """Raise for the first row that is wrong; the text may show its radius, its time, and time
        and number of the row before.
        """
        if wrong.any():
            i = int(wrong.argmax())
            said = text.format(
                radius=self.radius[i],
                time=self.time[i],
                before=self.time[i - 1],
                row=self.rows[i - 1],
            )
            raise InputDataError(f"{self.where}, row {self.rows[i]}: {said}")


def curves_of(
    content: Content,
    layout: Layout | None,
    said: Said,
    *,
    sort: bool,
    exclude: Collection[str] = (),
) -> TraceSet:
    """The curves of a file in SI units, and what was left out of them.

    Args:
        content: what the file holds.
        layout: what its names mean; None: they must say it themselves.
        said: what the JSON file beside it says.
        sort: whether rows are put in the order of their times.
        exclude: names of curves that are left out.

    Raises:
        InputDataError: if the file cannot be used; the message names place, value and remedy.
    """
    notes = []
    if layout is None:
        layout, notes = find_layout(content, said)
    else:
        _check_units(content, layout)
    raw, left_out = _split_curves(content, layout)
    scales, of_times = find_scales(content, layout, said)
    tops, more = max_radii(content, layout, [curve.time for curve in raw], scales)
    rests = rest_radii(content, layout, len(raw))
    traces = []
    for curve, top, rest in zip(raw, tops, rests, strict=True):
        excluded = curve.experiment_id in exclude
        if excluded or not curve.radius.size:
            why = "left out as asked for" if excluded else "an empty cell"
            left_out.append(
                LeftOut(curve.file, curve.experiment_id, row_ranges(curve.rows), why)
            )
            continue
        top_m = None if top is None else top * LENGTHS[layout.max_radius_unit]
        rest_m = (
            None if rest is None else rest * scales.metres(layout.rest_radius_unit, top_m)
        )
        with about_experiment(curve.experiment_id):
            converted = _convert_to_si(
                _mark_absent(curve, layout), layout, scales, top_m, rest_m
            )
            trace, dropped = _make_trace(_leave_out_peak(converted, layout), sort=sort)
        left_out += dropped
        traces += [] if trace is None else [trace]
    asked = [curve for curve in raw if curve.experiment_id not in exclude]
    if not traces and (asked or not raw):
        why = "; ".join(f"row(s) {x.rows or '-'}: {x.reason}" for x in left_out[:4])
        raise InputDataError(
            f"{content.path}: no usable curve ({why or 'it holds no curve'}). Give a record with "
            f"at least {MIN_SAMPLES} frames of the bubble."
        )
    return TraceSet(tuple(traces), tuple(left_out), (*notes, *more, *of_times))


def find_layout(content: Content, said: Said) -> tuple[Layout, list[str]]:
    """The known layout whose names a file holds, or the one that names and units say; and notes."""
    fitting = {
        name: known
        for name, known in KNOWN_LAYOUTS.items()
        if (name in _TABLES) == content.is_table
        and all(len(content.names_like(x)) == 1 for x in known.names())
        and (known.separator is None or _find_separators(content, known.separator).any())
    }
    rank = {name: (_is_possible(content, x), len(x.names())) for name, x in fitting.items()}
    best = [name for name in rank if rank[name] == max(rank.values())]
    if len(best) > 1:
        raise InputDataError(
            f"{content.path}: several known layouts fit ({', '.join(best)}). The file holds: "
            f"{content.describe()}. Say what they mean with --layout "
            '"radius=<name>,radius_unit=um,time=<name>,time_unit=us" (in Python '
            'layout=Layout.from_text("...")).'
        )
    if best:
        return fitting[best[0]], [
            f"{content.path}: read with the known layout '{best[0]}'."
        ]
    layout = infer_layout(content, _add_declared_units(content, said))
    return layout, [render("layout.txt", content=content, layout=layout)]


def _find_separators(content: Content, value: float) -> np.ndarray:
    """Rows of a table that consist of one number alone."""
    if any(isinstance(column, list) for column in content.values.values()):
        return np.zeros(1, dtype=bool)
    return (np.stack(list(content.values.values())) == value).all(0)


def _is_possible(content: Content, layout: Layout) -> bool:
    """Whether a bubble may have the radii of a file by a layout."""
    if layout.radius_unit not in LENGTHS:
        return True
    largest = float(np.nanmax(content.entries(layout.radius), initial=0.0))
    low, high = RADIUS_RANGE_M
    return low < largest * LENGTHS[layout.radius_unit] < high


def _add_declared_units(content: Content, said: Said) -> Said:
    """What is said beside the file, with the units that the file itself declares, as IMRFit does."""
    units = {}
    for name, allowed in (("time_unit", TIMES), ("radius_unit", LENGTHS)):
        if content.is_table or name not in content.values:
            continue
        written = content.values[name]
        unit = unit_of(written) if isinstance(written, str) else None
        if unit not in allowed:
            raise InputDataError(
                f"{content.path}: variable '{name}' is {str(written)[:40]!r}; expected one of "
                f"{', '.join(allowed)}: export it again."
            )
        units[name] = unit
    return replace(said, **units)


def _radius_names(content: Content, layout: Layout) -> list[str]:
    """The columns of radii: one, those joined by ``+``, or with ``*`` all but those of times and
    names.
    """
    if layout.radius == "*":
        named = (layout.time, layout.experiment)
        other = {content.find(name) for name in named if name is not None}
        found = [name for name in content.values if name not in other]
        if not found:
            raise InputDataError(
                f"{content.path}: radius=* names every other column, and there is none; add a "
                "column of radii."
            )
        return found
    if layout.radius in content.values or "+" not in layout.radius:
        return [content.find(layout.radius)]
    return [content.find(name.strip()) for name in layout.radius.split("+")]


def _check_units(content: Content, layout: Layout) -> None:
    """Refuse a layout that contradicts a unit written in the header of a table."""
    if not content.is_table:
        return
    written = {h.name: h.unit for h in headings_of(content)}
    asked = [(column, layout.radius_unit) for column in _radius_names(content, layout)]
    asked += [(layout.time, layout.time_unit)] if layout.time in content.values else []
    for column, unit in asked:
        if written[column] is not None and written[column] != unit:
            raise InputDataError(
                f"{content.path}: column '{column}' is in {written[column]} by its header and in "
                f"{unit} by the layout; correct the one that is wrong, the header in the file or the layout."
            )


def _split_curves(content: Content, layout: Layout) -> tuple[list[RawCurve], list[LeftOut]]:
    """The curves in the units of the file, and rows left out on the way."""
    file = content.path
    names = _radius_names(content, layout)
    columns = [(name, cell) for name in names for cell in content.vectors(name)]
    radii = [radius for _, radius in columns]
    times = _vectors_beside(content, layout, "time", radii)
    axes = _vectors_beside(content, layout, "symmetry_axis", radii)
    groups, left_out = _group_rows(content, layout)
    curves = []
    for i, ((column, radius), time, axis) in enumerate(
        zip(columns, times, axes, strict=True), 1
    ):
        asphericity = None
        if axis is not None:
            seen = (radius > 0.0) & (axis > 0.0)
            asphericity = (
                np.divide(radius, axis, out=np.full(len(axis), np.nan), where=seen) - 1.0
            )
            radius = np.where(seen, np.cbrt(radius * radius * axis), np.nan)
        frames = np.arange(len(radius))
        time = frames if time is None else time
        whole = RawCurve(str(file), "", time, radius, content.lines(frames), asphericity)
        for group, chosen in groups.items():
            label = group or file.stem
            if len(names) > 1:
                label = column if len(groups) == 1 else f"{group}:{column}"
            elif len(radii) > 1:
                label = f"{file.stem}_{i:02d}"
            curves.append(replace(whole.take_rows(chosen), experiment_id=label))
    return curves, left_out


def _vectors_beside(
    content: Content, layout: Layout, setting: str, radii: Sequence[np.ndarray]
) -> Sequence[np.ndarray | None]:
    """The vector of each curve that a setting of the layout names, or that of all; None without."""
    name = getattr(layout, setting)
    if name is None:
        return [None] * len(radii)
    vectors = content.vectors(name)
    vectors = vectors * len(radii) if len(vectors) == 1 else vectors
    if len(vectors) != len(radii):
        what = "times" if setting == "time" else "half axes"
        raise InputDataError(
            f"{content.path}: '{name}' holds {len(vectors)} vectors and '{layout.radius}' "
            f"{len(radii)}; expected one vector of {what} for each curve, or one for all."
        )
    for i, (vector, radius) in enumerate(zip(vectors, radii, strict=True), 1):
        if len(vector) != len(radius):
            raise InputDataError(
                f"{content.path}: curve {i}: '{name}' has {len(vector)} samples and "
                f"'{layout.radius}' {len(radius)}; give one for every radius."
            )
    return vectors


def _group_rows(
    content: Content, layout: Layout
) -> tuple[dict[str, np.ndarray | slice], list[LeftOut]]:
    """Row indices of each curve, by experiment column, by separator rows, or all in one."""
    file = str(content.path)
    if layout.experiment is not None:
        column = content.find(layout.experiment)
        groups: dict[str, list[int]] = {}
        for i, label in enumerate(content.texts.get(column, content.values[column])):
            groups.setdefault(str(label), []).append(i)
        if "" in groups:
            raise InputDataError(
                f"{file}: row {content.lines(groups[''][0])}, column '{layout.experiment}' is empty; name the experiment."
            )
        return {name: np.array(rows) for name, rows in groups.items()}, []
    if layout.separator is None:
        return {"": slice(None)}, []
    separates = _find_separators(content, layout.separator)
    marks = np.flatnonzero(separates)
    parts = [part[~separates[part]] for part in np.split(np.arange(len(separates)), marks)]
    aside = {"separator rows between curves": marks}
    if len(marks) and len(parts[0]) < MIN_SAMPLES:
        aside["stray row(s) before the first separator"] = parts.pop(0)
    left_out = [
        LeftOut(file, "", row_ranges(content.lines(rows)), reason)
        for reason, rows in aside.items()
        if len(rows)
    ]
    filled = [part for part in parts if len(part)]
    return {
        f"{content.path.stem}_{i:03d}": part for i, part in enumerate(filled, 1)
    }, left_out


def _mark_absent(curve: RawCurve, layout: Layout) -> RawCurve:
    """The curve with radius 0 where the file marks a frame without a bubble."""
    radius = curve.radius.copy()
    begun = np.logical_or.accumulate(radius > 0.0)
    absent = (radius == -1.0) | (~begun & begun.any())
    absent |= layout.absent == "negative"
    radius[absent & (radius < 0.0) & np.isfinite(radius)] = 0.0
    return replace(curve, radius=radius)


def _convert_to_si(
    curve: RawCurve,
    layout: Layout,
    scales: Scales,
    max_radius: float | None,
    rest_radius: float | None,
    *,
    tolerance: float = 0.01,
) -> RawCurve:
    """The curve in s and m; ``tolerance``: of the frame interval that is stated beside times."""
    if max_radius is not None and not 0.0 < max_radius < math.inf:
        raise InputDataError(
            f"{curve.where}: max_radius is {max_radius / LENGTHS[layout.max_radius_unit]}; "
            "expected a positive length."
        )
    interval = scales.interval
    by_frames = layout.time is None or layout.time_unit == "frames"
    dimensionless = (max_radius or 1.0) * scales.time_per_length
    scale = interval if by_frames else TIMES.get(layout.time_unit, dimensionless)
    assert scale is not None
    time = curve.time * scale
    if interval is not None and not by_frames and len(time) > 1:
        step = float(np.nanmedian(np.diff(time)))
        if not abs(step / interval - 1.0) <= tolerance:
            raise InputDataError(
                f"{curve.where}: times are {step:.4g} s apart and frame_interval is "
                f"{interval:.4g} s; correct time_unit={layout.time_unit}, max_radius or "
                "frame_interval in --layout."
            )
    radius = curve.radius * scales.metres(layout.radius_unit, max_radius)
    given = Given(max_radius_m=max_radius, rest_radius_m=rest_radius)
    return replace(curve, time=time, radius=radius, given=given)


def _leave_out_peak(curve: RawCurve, layout: Layout) -> RawCurve:
    """The curve without a peak that its source inserted, which is given as the maximum."""
    at_peak = {"first_row": np.arange(len(curve.rows)) == 0, "time_zero": curve.time == 0.0}
    chosen = at_peak.get(layout.inserted_peak or "")
    if chosen is None or not chosen.any():
        return curve
    peak = float(curve.radius[chosen][0])
    stated = curve.given.max_radius_m
    if not peak > 0.0 or (stated is not None and abs(peak / stated - 1.0) > 0.01):
        raise InputDataError(
            f"{curve.where}, row {curve.rows[chosen][0]}: radius {peak:.5g} m is not the fitted "
            f"peak (max_radius {stated} m) that inserted_peak='{layout.inserted_peak}' announces; "
            "write inserted_peak=none into --layout if the row is a camera frame."
        )
    at = float(curve.time[chosen][0])
    given = replace(curve.given, max_radius_m=stated or peak, time_of_max_s=at)
    reason = "fitted peak inserted by the source, not a camera frame"
    return replace(curve, given=given).leave_out(chosen, reason)


def _make_trace(
    curve: RawCurve, *, sort: bool, few: float = 0.02
) -> tuple[RadiusTrace | None, tuple[LeftOut, ...]]:
    """Drop the frames without a bubble and build the trace.

    Args:
        curve: in SI units.
        sort: whether rows are put in the order of their times.
        few: share of the frames that may have an impossible radius and are dropped as lost; more
            are another unit, or no radius.

    Returns:
        The trace (None if fewer than ``MIN_SAMPLES`` frames are left) and what was left out.

    Raises:
        InputDataError: on infinite values, more than single negative ones, times that do not
            increase, and implausible units.
    """
    radius = curve.radius
    impossible = (radius < RADIUS_RANGE_M[0]) & (radius != 0.0) & ~np.isneginf(radius)
    if impossible.sum() <= few * len(radius):
        reason = "radius negative or smaller than a camera sees (lost frames)"
        curve = curve.leave_out(impossible, reason)
    for name, values in (("time", curve.time), ("radius", curve.radius)):
        text = f"{name} is {{{name}}}; write NaN for a lost frame."
        curve.refuse_row(np.isinf(values), text)
    curve.refuse_row(
        curve.radius < 0.0,
        "radius is {radius:g} m, which is negative. Write NaN for a lost frame; if such rows "
        "separate curves, write separator=<that number> into --layout.",
    )
    seen = (curve.radius > 0.0) & ~np.isnan(curve.time)
    begun = np.logical_or.accumulate(seen)
    ended = ~np.logical_or.accumulate(seen[::-1])[::-1]
    for rows, place in (
        (~begun, "before the first frame with a bubble (before nucleation)"),
        (begun & ~seen & ~ended, "between frames with a bubble (lost frames)"),
        (begun & ended, "after the last frame with a bubble (lost frames)"),
    ):
        curve = curve.note_lost(rows, f"radius 0, negative or NaN {place}")
    curve = curve.take_rows(seen)
    if sort:
        curve = curve.take_rows(np.argsort(curve.time, kind="stable"))
        double = np.diff(curve.time, prepend=-np.inf) <= 0.0
        curve = curve.leave_out(double, "its time is that of another row")
    if len(curve.radius) < MIN_SAMPLES:
        reason = f"only {len(curve.radius)} frame(s) with a bubble; a curve needs at least {MIN_SAMPLES}"
        short = LeftOut(curve.file, curve.experiment_id, row_ranges(curve.rows), reason)
        return None, (*curve.left_out, short)
    step = np.diff(curve.time, prepend=-np.inf)
    what = "repeats" if (step[step <= 0.0] == 0.0)[:1].any() else "goes back from"
    curve.refuse_row(
        step <= 0.0,
        f"time {{time:.6g}} s {what} {{before:.6g}} s of row {{row}}; times must increase strictly: "
        "remove the duplicate row, or let --sort (in Python sort=True) sort the rows by time.",
    )
    time = torch.from_numpy(curve.time)
    radii = torch.from_numpy(curve.radius)
    shape = None if curve.asphericity is None else torch.from_numpy(curve.asphericity)
    trace = RadiusTrace(curve.experiment_id, time, radii, curve.file, curve.given, shape)
    return trace, curve.left_out
