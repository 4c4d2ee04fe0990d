"""Tables of text or of a spreadsheet: their columns as numbers, and the rows of each curve.

A table has one row a frame. Its curves are told apart by a column with names, by separator rows, or
by columns of radii that share the times (a wide table). Numbers may have a decimal comma where the
columns are not divided by commas.
"""

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.observe.layout import Layout
from imr_torch.observe.raw import RawCurve
from imr_torch.observe.traces import MIN_SAMPLES, LeftOut, row_ranges

EVERY_COLUMN = "*"
_LONGEST = 131_072  # characters of a field; no number or name is longer
_SHOWN = 40  # characters of a cell in a message
_SEPARATOR = re.compile(r"sep=[;,\t]", re.IGNORECASE)
_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True, eq=False)
class Table:
    """The rows of a file: names of the columns, cells as text, and the line each row stands on.

    Args:
        columns: names of the columns, each once; ``"1"``, ``"2"``, ... in a file without header.
        cells: one list of texts per row.
        lines: line of the file of each row, counted from 1.
        decimal_comma: whether ``"1,5"`` is a number.
        units: units written in a row below the header, one per column; empty without such a row.
    """

    columns: tuple[str, ...]
    cells: list[list[str]]
    lines: np.ndarray
    decimal_comma: bool = False
    units: tuple[str, ...] = ()

    @property
    def has_header(self) -> bool:
        """Whether the columns have names."""
        return self.columns != _numbered(len(self.columns))

    def has_rows_of(self, value: float | None) -> bool:
        """Whether a row consists of ``value`` alone (True for None)."""
        return value is None or any(_all_equal(row, value) for row in self.cells)

    def is_number(self, cell: str) -> bool:
        """Whether a cell holds a number."""
        return _is_number(cell) or (self.decimal_comma and _COMMA.fullmatch(cell) is not None)

    def numbers(self, name: str) -> np.ndarray | None:
        """A column as float64, NaN where a cell is empty; None if a cell is no number."""
        k = self.columns.index(name)
        texts = [row[k] or "nan" for row in self.cells]
        if not all(map(str.isascii, texts)) or any("_" in text for text in texts):
            return None
        try:
            return np.array(list(map(float, texts)))
        except ValueError:
            if not self.decimal_comma:
                return None
        try:
            return np.array(
                [float(x.replace(",", ".") if _COMMA.fullmatch(x) else x) for x in texts]
            )
        except ValueError:
            return None


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(str(i + 1) for i in range(count))


def _all_equal(row: list[str], value: float) -> bool:
    return all(_is_number(cell) and float(cell) == value for cell in row)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return (
        cell.isascii() and "_" not in cell
    )  # Python reads 1_0 and digits of other scripts as numbers too


def shown(cell: str) -> str:
    """A cell in a message, cut to a readable length."""
    return repr(cell) if len(cell) <= _SHOWN else f"{cell[:_SHOWN]!r}... ({len(cell)} characters)"


def read_table(path: Path) -> Table:
    """Read a table of text, with or without header; columns are divided by semicolon, tab, comma or
    blanks.

    Lines that begin with ``#`` or ``%`` are comments; the last one before the rows is the header if
    it has as many fields.

    Raises:
        InputDataError: if the file is no text, has no rows, rows of different lengths, a field that
            no number or name fills, or two columns of one name.
    """
    lines = [(i, line) for i, line in enumerate(_text(path).splitlines(), 1) if line.strip()]
    if lines and _SEPARATOR.fullmatch(
        lines[0][1].strip()
    ):  # of spreadsheets, which then ignore the line
        lines = lines[1:]
    comments = [line.lstrip("#% \t") for _, line in lines if line.startswith(("#", "%"))]
    lines = [(i, line) for i, line in lines if not line.startswith(("#", "%"))]
    if not lines:
        raise InputDataError(f"{path}: holds no row; export the curve again.")
    mark = _mark(lines[0][1], lines[-1][1])
    rows = [_split(path, i, line, mark) for i, line in lines]
    numbers = [i for i, _ in lines]
    if (
        mark is None and len(rows) > 1 and len(rows[0]) != len(rows[1])
    ):  # names with single blanks in them
        rows[0] = [cell.strip() for cell in re.split(r"\s{2,}", lines[0][1].strip())]
    comma = mark != ","
    if comments and _are_numbers(rows[0], comma):
        heading = _split(
            path, 0, comments[-1], _mark(comments[-1], comments[-1]) if mark is None else mark
        )
        if len(heading) == len(rows[0]) and not _are_numbers(heading, comma):
            rows = [heading, *rows]
            numbers = [0, *numbers]
    return make_table(path, rows, numbers, decimal_comma=comma)


def _text(path: Path) -> str:
    """The text of a file in UTF-8, in UTF-16 with a byte-order mark, or with Latin-1 micro signs
    alone.
    """
    content = path.read_bytes()
    try:
        if content.startswith((b"\xff\xfe", b"\xfe\xff")):
            return content.decode("utf-16")
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if not set(content) & set(range(0x80, 0x100)) - {0xB5}:
            return content.decode("latin-1")
        raise InputDataError(
            f"{path}: is neither a MATLAB file nor UTF-8 text ({error.reason} at byte "
            f"{error.start}); export as CSV in UTF-8."
        ) from None


def _mark(first: str, last: str) -> str | None:
    """What divides the columns; None for blanks."""
    fields = last.split()
    if (
        ";" not in first
        and "\t" not in first
        and len(fields) > 1
        and all(_COMMA.fullmatch(field) for field in fields)
    ):
        return None
    return next((c for c in ";\t," if c in first), None)


def _split(path: Path, number: int, line: str, mark: str | None) -> list[str]:
    if mark is None:
        return line.split()
    if '"' not in line:
        cells = [cell.strip() for cell in line.split(mark)]
    else:
        try:
            cells = [cell.strip() for cell in next(csv.reader([line], delimiter=mark))]
        except csv.Error as error:
            raise InputDataError(
                f"{path}: row {number} cannot be divided into fields ({error}); close every "
                "quotation mark in its own row, "
                f"and keep fields below {_LONGEST} characters."
            ) from None
    if len(line) > _LONGEST and max(map(len, cells)) > _LONGEST:
        raise InputDataError(
            f"{path}: row {number} has a field of {max(map(len, cells))} characters, more than "
            f"{_LONGEST}; this is no table "
            "of numbers: divide the columns by commas and write one row a frame."
        )
    return cells


def _are_numbers(cells: Iterable[str], comma: bool) -> bool:
    return all(_is_number(cell) or (comma and _COMMA.fullmatch(cell)) for cell in cells)


def make_table(
    path: Path, rows: list[list[str]], numbers: list[int], *, decimal_comma: bool = False
) -> Table:
    """A table of rows of cells, the first of which may be a header and the second the units.

    Args:
        path: the file, for messages.
        rows: the cells of each row.
        numbers: row numbers for messages.
        decimal_comma: whether ``"1,5"`` is a number.

    Raises:
        InputDataError: if there are no rows, rows of different lengths, or two columns of one name.
    """
    has_header = not _are_numbers((cell or "nan" for cell in rows[0]), decimal_comma)
    columns = tuple(rows[0]) if has_header else _numbered(len(rows[0]))
    rows, numbers = (rows[1:], numbers[1:]) if has_header else (rows, numbers)
    units: tuple[str, ...] = ()
    if (
        has_header
        and rows
        and len(rows[0]) == len(columns)
        and _is_unit_row(rows[0], rows[1:2], decimal_comma)
    ):
        units = tuple(rows[0])
        rows = rows[1:]
        numbers = numbers[1:]
    kept = [i for i, row in enumerate(rows) if any(row)]
    if len(kept) < len(rows):
        rows = [rows[i] for i in kept]
        numbers = [numbers[i] for i in kept]
    if not rows:
        raise InputDataError(
            f"{path}: has the header {', '.join(columns)} and no rows; export the curve again."
        )
    _check_widths(path, rows, numbers, len(columns))
    if "" in columns:
        columns, rows, units = _without_blank_columns(columns, rows, units)
    _check_names(path, columns)
    return Table(columns, rows, np.array(numbers), decimal_comma, units)


def _is_unit_row(row: Sequence[str], next_rows: Sequence[Sequence[str]], comma: bool) -> bool:
    """Whether a row below the header is one of units: no number in it, and numbers below it."""
    worded = all(not _are_numbers([cell], comma) for cell in row if cell) and any(row)
    return (
        worded
        and bool(next_rows)
        and any(cell and _are_numbers([cell], comma) for cell in next_rows[0])
    )


def _check_widths(path: Path, rows: list[list[str]], numbers: list[int], width: int) -> None:
    for row, line in zip(rows, numbers, strict=True):
        if len(row) != width:
            decimal = (
                " If the numbers have decimal commas, divide the columns by semicolons."
                if len(row) == 2 * width
                else ""
            )
            raise InputDataError(
                f"{path}: row {line} has {len(row)} field(s) and the first row {width}; write "
                "every row with "
                f"the same columns (a lost frame as NaN).{decimal}"
            )


def _without_blank_columns(
    columns: tuple[str, ...], rows: list[list[str]], units: tuple[str, ...]
) -> tuple[tuple[str, ...], list[list[str]], tuple[str, ...]]:
    """The table without columns that have neither name nor content, as spreadsheets leave them at
    the end.
    """
    kept = [k for k, name in enumerate(columns) if name or any(row[k] for row in rows)]
    names = tuple(columns[k] for k in kept)
    below = tuple(units[k] for k in kept) if units else ()
    return names, [[row[k] for k in kept] for row in rows], below


def _check_names(path: Path, columns: tuple[str, ...]) -> None:
    places: dict[str, int] = {}
    for k, name in enumerate(columns, 1):
        if name in places:
            raise InputDataError(
                f"{path}: columns {places[name]} and {k} are both named '{name}'; give every "
                "column a name of its own."
            )
        places[name] = k


def table_curves(path: Path, table: Table, layout: Layout) -> tuple[list[RawCurve], list[LeftOut]]:
    """The curves of a table in its own units, and rows left out on the way.

    Raises:
        InputDataError: if a column is missing, or a cell is no number.
    """
    file = str(path)
    time = None if layout.time is None else _column(file, table, _named(file, table, layout.time))
    radii = radius_columns(file, table, layout)
    groups, left_out = _groups(path, table, layout)
    curves = []
    for column in radii:
        radius = _column(file, table, column)
        for name, chosen in groups.items():
            label = name if len(radii) == 1 else column if len(groups) == 1 else f"{name}:{column}"
            part = None if time is None else time[chosen]
            curves.append(RawCurve(file, label, part, radius[chosen], table.lines[chosen]))
    return curves, left_out


def radius_columns(file: str, table: Table, layout: Layout) -> list[str]:
    """The columns of radii: one, those joined by ``+``, or with ``*`` all but those of times and
    names.
    """
    if layout.radius == EVERY_COLUMN:
        other = {
            _named(file, table, name)
            for name in (layout.time, layout.experiment)
            if name is not None
        }
        found = [name for name in table.columns if name not in other]
        if not found:
            raise InputDataError(
                f"{file}: radius=* names every other column, and there is none; add a column of "
                "radii."
            )
        return found
    if layout.radius in table.columns or "+" not in layout.radius:
        return [_named(file, table, layout.radius)]
    return [_named(file, table, name.strip()) for name in layout.radius.split("+")]


def _named(file: str, table: Table, name: str) -> str:
    """A column by its name, or by its name without the unit behind it."""
    if name in table.columns:
        return name
    alike = [
        column for column in table.columns if re.fullmatch(re.escape(name) + r"\s*[\[(/].*", column)
    ]
    if len(alike) == 1:
        return alike[0]
    raise InputDataError(
        f"{file}: column '{name}', named by the layout, is not in the file. It holds: columns "
        f"{', '.join(table.columns)}. Name one of these in --layout."
    )


def _column(file: str, table: Table, name: str) -> np.ndarray:
    values = table.numbers(name)
    if values is not None:
        return values
    k = table.columns.index(name)
    i = next(i for i, row in enumerate(table.cells) if row[k] and not table.is_number(row[k]))
    cell = table.cells[i][k]
    remedy = "write numbers with a decimal point, and a lost frame as NaN."
    if "," in cell:
        remedy = (
            "write numbers without thousands separators, and divide columns by semicolons where "
            "decimals have commas."
        )
    raise InputDataError(
        f"{file}: row {table.lines[i]}, column '{name}' is {shown(cell)}, not a number; {remedy}"
    )


def _groups(
    path: Path, table: Table, layout: Layout
) -> tuple[dict[str, np.ndarray], list[LeftOut]]:
    """Row indices of each curve, by experiment column, by separator rows, or all in one."""
    if layout.experiment is not None:
        k = table.columns.index(_named(str(path), table, layout.experiment))
        groups: dict[str, list[int]] = {}
        for i, row in enumerate(table.cells):
            groups.setdefault(row[k], []).append(i)
        if "" in groups:
            line = table.lines[groups[""][0]]
            raise InputDataError(
                f"{path}: row {line}, column '{layout.experiment}' is empty; name the experiment."
            )
        return {name: np.array(rows) for name, rows in groups.items()}, []
    count = len(table.cells)
    if layout.separator is None:
        return {path.stem: np.arange(count)}, []
    marks = [i for i, row in enumerate(table.cells) if _all_equal(row, layout.separator)]
    left_out = (
        [LeftOut(str(path), "", row_ranges(table.lines[marks]), "separator rows between curves")]
        if marks
        else []
    )
    parts = [np.arange(a + 1, b) for a, b in zip([-1, *marks], [*marks, count], strict=True)]
    if marks and 0 < len(parts[0]) < MIN_SAMPLES:
        left_out.append(
            LeftOut(
                str(path),
                "",
                row_ranges(table.lines[parts[0]]),
                "stray row(s) before the first separator",
            )
        )
        parts = parts[1:]
    filled = [part for part in parts if len(part)]
    return {f"{path.stem}_{i:03d}": part for i, part in enumerate(filled, 1)}, left_out
