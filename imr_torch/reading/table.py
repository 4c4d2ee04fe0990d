"""Tables of text and workbooks: their columns as numbers, or as texts where a cell is no number.

A table has one row a frame. Numbers may have a decimal comma where the columns are not divided by
commas. A row below the header may hold the units.
"""

import csv
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.reading.content import LARGEST, Content, read_number

_LONGEST = csv.field_size_limit()  # characters of a field; no number or name is longer
_SEPARATOR = re.compile(r"sep=[;,\t]", re.IGNORECASE)


def read_text(path: Path) -> Content:
    """Read a table of text, with or without header; columns are divided by semicolon, tab, comma or
    blanks.

    Lines that begin with ``#`` or ``%`` are comments; the last one before the rows is the header if
    it has as many fields.

    Raises:
        InputDataError: if the file is no text, has no rows, rows of different lengths, a field that
            no number or name fills, or two columns of one name.
    """
    lines = [
        (i, line)
        for i, line in enumerate(_decode_text(path).splitlines(), 1)
        if line.strip()
    ]
    if lines and _SEPARATOR.fullmatch(lines[0][1].strip()):  # of spreadsheets
        lines = lines[1:]
    comments = [line.lstrip("#% \t") for _, line in lines if line.startswith(("#", "%"))]
    lines = [(i, line) for i, line in lines if not line.startswith(("#", "%"))]
    if not lines:
        raise InputDataError(f"{path}: holds no row; export the curve again.")
    mark = _find_mark(lines[0][1], lines[-1][1])
    rows = [(i, _split_line(path, i, line, mark)) for i, line in lines]
    first, row = rows[0]
    if (
        mark is None and len(rows) > 1 and len(row) != len(rows[1][1])
    ):  # blanks within names
        row = re.split(r"\s{2,}", lines[0][1].strip())
        rows[0] = (first, row)
    comma = mark != ","
    if comments and _are_numbers(row, comma):
        header_mark = _find_mark(comments[-1], comments[-1]) if mark is None else mark
        header = _split_line(path, 0, comments[-1], header_mark)
        if len(header) == len(row) and not _are_numbers(header, comma):
            rows = [(0, header), *rows]
    return table_content(path, rows, comma=comma)


def _decode_text(path: Path) -> str:
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


def _find_mark(first: str, last: str) -> str | None:
    """What divides the columns; None for blanks."""
    fields = last.split()
    decimal = len(fields) > 1 and all(
        read_number(field, comma=True) is not None and "," in field for field in fields
    )
    if decimal and ";" not in first and "\t" not in first:
        return None
    return next((c for c in ";\t," if c in first), None)


def _split_line(path: Path, number: int, line: str, mark: str | None) -> list[str]:
    if mark is None:
        return line.split()
    try:
        cells = (
            next(csv.reader([line], delimiter=mark)) if '"' in line else line.split(mark)
        )
    except csv.Error as error:
        raise InputDataError(
            f"{path}: row {number} cannot be divided into fields ({error}); close every "
            f"quotation mark in its own row, and keep fields below {_LONGEST} characters."
        ) from None
    if max(map(len, cells)) > _LONGEST:
        raise InputDataError(
            f"{path}: row {number} has a field of {max(map(len, cells))} characters, more than "
            f"{_LONGEST}; this is no table of numbers: divide the columns by commas and write one "
            "row a frame."
        )
    return [cell.strip() for cell in cells]


def _are_numbers(cells: Sequence[str], comma: bool) -> bool:
    return all(not cell or read_number(cell, comma=comma) is not None for cell in cells)


def table_content(
    path: Path, rows: Sequence[tuple[int, list[str]]], *, comma: bool = False
) -> Content:
    """The columns of rows of cells, the first of which may be a header and the second the units.

    Args:
        path: the file, for messages.
        rows: number, for messages, and cells of each row.
        comma: whether ``"1,5"`` is a number.

    Raises:
        InputDataError: if there are no rows, rows of different lengths, or two columns of one name.
    """
    first = rows[0][1]
    has_header = not _are_numbers(first, comma)
    names = first if has_header else [str(i + 1) for i in range(len(first))]
    body = rows[has_header:]
    units: list[str] = []
    if (
        has_header
        and len(body) > 1
        and _is_unit_row(body[0][1], body[1][1], len(names), comma)
    ):
        units = body[0][1]
        body = body[1:]
    body = [(line, row) for line, row in body if any(row)]
    if not body:
        raise InputDataError(
            f"{path}: has the header {', '.join(names)} and no rows; export the curve again."
        )
    for line, row in body:
        if len(row) != len(names):
            decimal = (
                " If the numbers have decimal commas, divide the columns by semicolons."
            )
            raise InputDataError(
                f"{path}: row {line} has {len(row)} field(s) and the first row {len(names)}; "
                "write every row with the same columns (a lost frame as NaN)."
                + (decimal if len(row) == 2 * len(names) else "")
            )
    texts: dict[str, Sequence[str]] = {}
    beside: dict[str, str] = {}
    for k, (name, *cells) in enumerate(zip(names, *(row for _, row in body), strict=True)):
        if not name and not any(cells):  # as spreadsheets leave them at the end
            continue
        if name in texts:
            raise InputDataError(
                f"{path}: columns {names.index(name) + 1} and {k + 1} are both named '{name}'; give "
                "every column a name of its own."
            )
        texts[name] = cells
        if units:
            beside[name] = units[k]
    columns: dict[str, np.ndarray | list[str]] = {}
    for name, cells in texts.items():
        numbers = [read_number(cell, comma=comma) if cell else np.nan for cell in cells]
        columns[name] = (
            list(cells) if None in numbers else np.array(numbers, dtype=np.float64)
        )
    lines = np.array([line for line, _ in body])
    return Content(path, columns, "column", lines, beside, has_header, texts)


def _is_unit_row(row: list[str], below: list[str], width: int, comma: bool) -> bool:
    """Whether a row below the header is one of units: no number in it, and numbers below it."""
    worded = any(row) and not any(_are_numbers([cell], comma) for cell in row if cell)
    return (
        len(row) == width and worded and any(_are_numbers([x], comma) for x in below if x)
    )


def is_workbook(path: Path, head: bytes) -> bool:
    """Whether a file is an ``.xlsx``."""
    if not head.startswith(b"PK") or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return "xl/workbook.xml" in archive.namelist()


def read_workbook(path: Path) -> list[Content]:
    """The sheets of an ``.xlsx`` that are not empty, each as a table, named after their sheets if
    there are several.
    """
    try:
        import openpyxl
    except ImportError:
        raise UnsupportedError(
            f"{path}: .xlsx files need openpyxl: pip install 'imr_torch[xlsx]'; or save the sheet "
            "as CSV."
        ) from None
    with zipfile.ZipFile(path) as archive:
        size = sum(member.file_size for member in archive.infolist())
    if size > LARGEST:
        raise InputDataError(
            f"{path}: unpacks to {size / 2**30:.3g} GiB, more than {LARGEST / 2**30:.3g} GiB; "
            "divide it."
        )
    try:
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        sheets = {
            sheet.title: [
                [_cell_text(x) for x in row] for row in sheet.iter_rows(values_only=True)
            ]
            for sheet in book.worksheets
        }
        book.close()
    except Exception as error:  # each parser raises its own kinds on damaged files
        raise InputDataError(
            f"{path}: cannot be read as a workbook ({type(error).__name__}: {error}); save it "
            "again, or save the sheet as CSV."
        ) from error
    filled = {title: rows for title, rows in sheets.items() if any(map(any, rows))}
    if not filled:
        raise InputDataError(f"{path}: every sheet is empty; export the curve again.")
    contents = []
    for title, rows in filled.items():
        width = max(map(len, rows))
        square = [
            (i, row + [""] * (width - len(row)))
            for i, row in enumerate(rows, 1)
            if any(row)
        ]
        place = (
            path
            if len(filled) == 1
            else path.with_name(f"{path.stem} {title}{path.suffix}")
        )
        contents.append(table_content(place, square))
    return contents


def _cell_text(value: object) -> str:
    if isinstance(value, (int, float)):
        return repr(float(value))
    return "" if value is None else str(value).strip()
