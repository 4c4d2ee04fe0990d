"""MATLAB files (v4 to v7.3) as names and values: structs, cells, strings, tables and timetables.

The fields of a struct, and the columns of a table, are named ``struct.field``; a field of a struct
array is a list of one value a struct. Row times of a timetable, and durations, are in seconds.
"""

import math
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy  # whose parts are imported when they are used

from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.reading.content import LARGEST, Content


def is_matlab(path: Path, head: bytes) -> bool:
    """Whether a file is one of MATLAB's."""
    named = path.suffix.lower() == ".mat" and b"\0" in head
    return named or head.startswith((b"MATLAB 5.0", b"MATLAB 7.3", b"\x89HDF"))


def read_matlab(path: Path) -> Content:
    """All variables of a MATLAB file.

    Raises:
        InputDataError: if the file cannot be read, or holds no variable.
    """
    holds_objects = _inspect_file(path)
    if holds_objects and find_spec("matio") is None:
        raise UnsupportedError(
            f"{path}: holds objects of MATLAB (tables, timetables or strings), which need mat-io: "
            "pip install mat-io; or save plain vectors, as by table2struct(T, 'ToScalar', true)."
        )
    values: dict[str, Any] = {}
    units: dict[str, str] = {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if holds_objects:
                import matio  # takes long to import

                content = matio.load_from_mat(str(path), add_table_attrs=True)
            else:
                import pymatreader  # takes long to import

                content = pymatreader.read_mat(str(path))
        for name, value in content.items():
            if not name.startswith(("__", "#")):
                _add_values(name, value, values, units)
    except (
        Exception
    ) as error:  # SciPy, h5py and zlib each raise their own kinds on damaged files
        raise InputDataError(
            f"{path}: cannot be read as a MATLAB file ({type(error).__name__}: {error}). Save it "
            "again in MATLAB with save(name, '-v7'), or export time and radius as CSV."
        ) from error
    if not values:
        raise InputDataError(
            f"{path}: holds no variables; save the radius and time vectors into it."
        )
    return Content(path, values, units=units)


def read_matlab_curves(path: Path) -> Content:
    """As :func:`read_matlab`; a matrix with one row, or one column, for each entry of a vector
    beside it, such as the times, is a list of curves, the longest if both fit.
    """
    content = read_matlab(path)
    arrays = {name: x for name, x in content.values.items() if isinstance(x, np.ndarray)}
    lengths = {array.size for array in arrays.values() if array.ndim == 1}
    for name, array in arrays.items():
        if array.ndim == 2:
            fitting = [x for x in (array, array.T) if x.shape[1] in lengths]
            curves = max(fitting, key=lambda x: x.shape[1], default=None)
            content.values[name] = array if curves is None else list(curves)
    return content


def _inspect_file(path: Path) -> bool:
    """Whether a file holds objects: it has a subsystem then, whose place MATLAB 5 heads it with.

    Raises:
        InputDataError: if its variables would take more memory than ``LARGEST``.
    """
    holds_objects = False
    sizes: dict[str, int] = {}
    try:
        if h5py.is_hdf5(path):

            def add(name: str, item: object) -> None:
                if isinstance(item, h5py.Dataset):
                    sizes[name] = item.nbytes

            with h5py.File(path) as file:
                holds_objects = "#subsystem#" in file
                file.visititems(add)
        else:
            with path.open("rb") as stream:
                head = stream.read(124)
            holds_objects = head.startswith(b"MATLAB 5.0") and bool(
                head[116:].strip(b"\0 ")
            )
            sizes = {
                name: 8 * math.prod(shape) for name, shape, _ in scipy.io.whosmat(str(path))
            }
    except Exception:  # a damaged file is reported where it is read
        return holds_objects
    if sum(sizes.values()) > LARGEST:
        name = max(sizes, key=lambda name: sizes[name])
        raise InputDataError(
            f"{path}: its variables take {sum(sizes.values()) / 2**30:.3g} GiB, above "
            f"{LARGEST / 2**30:.3g} (the largest is '{name}'); it is damaged, or holds more than "
            "curves: save radius and time alone."
        )
    return holds_objects


def _add_values(
    name: str, value: Any, values: dict[str, Any], units: dict[str, str]
) -> None:
    """Add a value, or each of its fields or columns, under its name."""
    if hasattr(value, "columns"):  # a table, which is a data frame
        written = value.attrs.get("VariableUnits") or value.attrs.get("varUnits") or []
        if value.index.dtype.kind in "mM":  # of a timetable
            value = value.reset_index()
            written = ["", *written]
        for column, unit in zip(
            value.columns, [*written, *[""] * value.shape[1]], strict=False
        ):
            _add_values(f"{name}.{column}", value[column].to_numpy(), values, units)
            units |= {f"{name}.{column}": unit} if unit else {}
    elif isinstance(value, dict):
        for field, part in value.items():
            _add_values(f"{name}.{field}", part, values, units)
    elif isinstance(value, np.ndarray) and value.dtype.names:
        structs = value.reshape(-1)
        for field in value.dtype.names:
            if len(structs) == 1:
                _add_values(f"{name}.{field}", structs[0][field], values, units)
            else:
                values[f"{name}.{field}"] = [
                    _simplify_value(struct[field]) for struct in structs
                ]
    else:
        values[name] = _simplify_value(value)
        if isinstance(value, np.ndarray) and value.dtype.kind in "mM":
            units[name] = "s"


def _simplify_value(value: Any) -> Any:
    """An array without dimensions of 1, a text, or a list of these."""
    if isinstance(value, list):
        return [_simplify_value(cell) for cell in value]
    if isinstance(value, (bool, int, float, np.generic)):
        return np.asarray(value)
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype.kind in "mM":
        # durations, or dates less the first of them
        since = value if value.dtype.kind == "m" else value - value.reshape(-1)[0]
        return (since / np.timedelta64(1, "s")).squeeze()
    if value.dtype.kind in "UT":
        texts = [str(text) for text in value.reshape(-1)]
        return texts[0] if len(texts) == 1 else texts
    if value.dtype.kind == "O":
        cells = [_simplify_value(cell) for cell in value.reshape(-1, order="F")]
        return cells[0] if len(cells) == 1 and isinstance(cells[0], str) else cells
    return value.squeeze()
