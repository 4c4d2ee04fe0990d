"""The file formats of the package, as readers: text, MATLAB, ``.npz``, ``.xlsx`` and results of
IMRFit.
"""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.observe import matlab
from imr_torch.observe.headers import unit_of
from imr_torch.observe.layout import LENGTHS, TIMES, Layout
from imr_torch.observe.load import table_traces, variable_traces
from imr_torch.observe.npz import LARGEST, read_arrays
from imr_torch.observe.readers import Reader, register_reader
from imr_torch.observe.table import make_table, read_table
from imr_torch.observe.traces import TraceSet

_NPZ = ("time_s", "radius_m")
_IMRFIT = ("t_exp", "R_exp", "time_unit", "radius_unit")
_WORKBOOK = "xl/workbook.xml"


def _is_text(path: Path, head: bytes) -> bool:
    return head.startswith((b"\xff\xfe", b"\xfe\xff")) or b"\0" not in head


def _read_text(path: Path, layout: Layout | None = None) -> TraceSet:
    return table_traces(path, read_table(path), layout)


def _is_matlab(path: Path, head: bytes) -> bool:
    named = path.suffix.lower() == ".mat" and b"\0" in head
    return named or head.startswith((b"MATLAB 5.0", b"MATLAB 7.3", b"\x89HDF"))


def _read_matlab(path: Path, layout: Layout | None = None) -> TraceSet:
    return variable_traces(path, matlab.read_variables(path), layout)


def _is_npz(path: Path, head: bytes) -> bool:
    return head.startswith(b"PK") and path.suffix.lower() == ".npz"


def _read_npz(path: Path) -> TraceSet:
    """One curve, or one a row, in SI units."""
    arrays = read_arrays(path, _NPZ)
    time, radius = (arrays[name] for name in _NPZ)
    if (
        radius.ndim not in (1, 2)
        or time.ndim not in (1, radius.ndim)
        or time.shape[-1:] != radius.shape[-1:]
    ):
        raise InputDataError(
            f"{path}: time_s has shape {time.shape} and radius_m {radius.shape}; expected frames, "
            "or curves x frames, with one "
            "time for every radius. Sets of repeated designs (designs x repeats x frames) are "
            "read by imr-torch diagnose."
        )
    if time.ndim == 2 and len(time) != len(radius):
        raise InputDataError(
            f"{path}: time_s has {len(time)} curves and radius_m {len(radius)}; give one row of "
            "times each."
        )
    cells: Any = [radius] if radius.ndim == 1 else list(radius)
    times: Any = time if time.ndim == 1 else list(time)
    return variable_traces(
        path,
        {"radius_m": cells, "time_s": times},
        Layout("radius_m", radius_unit="m", time="time_s"),
    )


def _is_xlsx(path: Path, head: bytes) -> bool:
    if not head.startswith(b"PK") or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return _WORKBOOK in archive.namelist()


def _read_xlsx(path: Path, layout: Layout | None = None) -> TraceSet:
    """The sheets of a workbook that are not empty, each as a table.

    With several, curves are named after their sheets.
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
            sheet.title: [[_cell(x) for x in row] for row in sheet.iter_rows(values_only=True)]
            for sheet in book.worksheets
        }
        book.close()
    except (
        Exception
    ) as error:  # openpyxl, zipfile and the XML parser each raise their own kinds on damaged files
        raise InputDataError(
            f"{path}: cannot be read as a workbook ({type(error).__name__}: {error}); save it "
            "again, or save the sheet as CSV."
        ) from error
    filled = {title: rows for title, rows in sheets.items() if any(any(row) for row in rows)}
    if not filled:
        raise InputDataError(f"{path}: every sheet is empty; export the curve again.")
    sets = []
    for title, rows in filled.items():
        numbers = [i for i, row in enumerate(rows, 1) if any(row)]
        width = max(len(row) for row in rows)
        square = [rows[i - 1] + [""] * (width - len(rows[i - 1])) for i in numbers]
        place = path if len(filled) == 1 else path.with_name(f"{path.stem} {title}{path.suffix}")
        sets.append(table_traces(place, make_table(place, square, numbers), layout))
    return TraceSet.join(sets)


def _cell(value: object) -> str:
    return (
        ""
        if value is None
        else repr(float(value))
        if isinstance(value, (int, float))
        else str(value).strip()
    )


def _is_imrfit(path: Path, head: bytes) -> bool:
    return _is_matlab(path, head) and set(_IMRFIT) <= set(matlab.names(path))


def _read_imrfit(path: Path) -> TraceSet:
    """The measured curve of a result, in the units that the file declares."""
    variables = matlab.read_variables(path)
    units = []
    for name, allowed in (("time_unit", TIMES), ("radius_unit", LENGTHS)):
        written = variables[name]
        unit = unit_of(written) if isinstance(written, str) else None
        if unit not in allowed:
            raise InputDataError(
                f"{path}: variable '{name}' is {str(written)[:40]!r}; expected one of "
                f"{', '.join(allowed)}: export it again."
            )
        units.append(unit)
    rest = (
        "Req"
        if np.size(variables.get("Req", [])) == 1 and float(np.ravel(variables["Req"])[0]) > 0.0
        else None
    )
    layout = Layout(
        "R_exp",
        radius_unit=units[1],
        time="t_exp",
        time_unit=units[0],
        rest_radius=rest,
        rest_radius_unit=units[1],
    )
    read = variable_traces(path, variables, layout)
    note = (
        f"{path}: read as a result of IMRFit, which declares times in {units[0]} and radii in "
        f"{units[1]}."
    )
    return TraceSet(read.traces, read.left_out, (*read.notes, note))


register_reader(Reader("text", _is_text, _read_text, _read_text))
register_reader(Reader("matlab", _is_matlab, _read_matlab, _read_matlab))
register_reader(Reader("npz", _is_npz, _read_npz))
register_reader(Reader("xlsx", _is_xlsx, _read_xlsx, _read_xlsx))
register_reader(Reader("imrfit", _is_imrfit, _read_imrfit, _read_matlab))
