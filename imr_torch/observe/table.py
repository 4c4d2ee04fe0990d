"""Tables of text: CSV with a header, or bare columns with separator rows, and the JSON file that may accompany them."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.observe.layout import Layout
from imr_torch.observe.raw import RawCurve
from imr_torch.observe.traces import MIN_SAMPLES, Given, LeftOut, row_ranges


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
    settled = entry.get("Rinf_settled")
    if settled is not None and not isinstance(settled, bool):
        raise InputDataError(f"Rinf_settled is {settled!r}; expected true or false.")
    return Given(top, time, rest, sd, settled)
