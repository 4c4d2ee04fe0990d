"""What a file holds by name, whatever its container: vectors of numbers, lists of vectors, texts.

Every container has one reader, which gives a :class:`Content`; everything after it (names, units,
curves) is the same for tables of text, workbooks, MATLAB files and ``.npz``, which is read here.
"""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imr_torch.errors import InputDataError

LARGEST = 2 << 30
"""Bytes that the arrays of one file may take, 2 GiB."""
_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?")


def read_number(cell: str, *, comma: bool = False) -> float | None:
    """A cell as a number, or None; ``comma``: whether ``"1,5"`` is one.

    >>> from imr_torch.reading.content import read_number
    >>> read_number("1,5", comma=True), read_number("1_000"), read_number("-2e-4")
    (1.5, None, -0.0002)
    """
    if comma and _COMMA.fullmatch(cell):
        cell = cell.replace(",", ".")
    if (
        not cell.isascii() or "_" in cell
    ):  # Python reads 1_0 and digits of other scripts too
        return None
    try:
        return float(cell)
    except ValueError:
        return None


@dataclass(frozen=True, eq=False)
class Content:
    """Names and values of a file, in the units of the file.

    Args:
        path: the file, which names its curves.
        values: name -> array, list of arrays (a cell array, or one for each struct), list of texts,
            or text.
        noun: ``"column"`` of a table, ``"variable"`` of other files.
        rows: row number of each entry of a column, counted from 1; None: entries are counted.
        units: name -> unit written beside it.
        has_header: whether the columns of a table have names.
        texts: column -> its cells as written.

    >>> from pathlib import Path
    >>> import numpy as np
    >>> from imr_torch.reading.content import Content
    >>> content = Content(Path("gel.mat"), {"shot.R": np.arange(3.0), "dt": np.array(1e-6)})
    >>> content.find("R"), content.number("frame_interval", "dt"), content.describe()
    ('shot.R', 1e-06, 'shot.R (3,), dt scalar')
    """

    path: Path
    values: dict[str, Any]
    noun: str = "variable"
    rows: np.ndarray | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    has_header: bool = True
    texts: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def is_table(self) -> bool:
        """Whether it is a table of text or of a workbook."""
        return self.noun == "column"

    def lines(self, entries: Any) -> Any:
        """Row numbers of entries of a column, counted from 1."""
        return entries + 1 if self.rows is None else self.rows[entries]

    def names_like(self, name: str) -> list[str]:
        """The name itself if it is there; else names that add a struct before it, or a unit behind
        it.
        """
        if name in self.values:
            return [name]
        pattern = re.compile(rf"(.*\.)?{re.escape(name)}(\s*[\[(/].*)?")
        return [other for other in self.values if pattern.fullmatch(other)]

    def find(self, name: str) -> str:
        """The full name of what a layout names.

        Raises:
            InputDataError: if nothing, or more than one thing, has that name.
        """
        found = self.names_like(name)
        if len(found) != 1:
            raise InputDataError(
                f"{self.path}: {self.noun} '{name}', named by the layout, is not in the file. It "
                f"holds: {self.describe()}. Name one of these in --layout."
            )
        return found[0]

    def vectors(self, name: str) -> list[np.ndarray]:
        """The float64 vectors of a name: one, or one for each cell.

        Raises:
            InputDataError: if it is not there, is no vector, or does not hold real numbers.
        """
        name = self.find(name)
        value = self.values[name]
        if self.is_table and isinstance(value, list):
            raise self._no_numbers(name, value)
        cells = value if isinstance(value, list) else [value]
        out = []
        for i, cell in enumerate(cells):
            where = f"{self.path}: {self.noun} '{name}'"
            where += f", cell {i + 1}" if len(cells) > 1 else ""
            if not isinstance(cell, np.ndarray) or cell.dtype.kind not in "fiub":
                raise InputDataError(
                    f"{where} holds {str(cell)[:40]!r}, not real numbers; name a numeric variable "
                    "in --layout."
                )
            if sum(n > 1 for n in cell.shape) > 1:
                raise InputDataError(
                    f"{where} has shape {cell.shape}; expected a vector, or a cell array of "
                    "vectors: save each curve as one cell."
                )
            out.append(cell.astype(np.float64).reshape(-1))
        return out

    def _no_numbers(self, name: str, cells: list[str]) -> InputDataError:
        """What to say of the first cell of a column that is no number."""
        place, cell = next(
            (i, cell)
            for comma in (True, False)
            for i, cell in enumerate(cells)
            if cell and read_number(cell, comma=comma) is None
        )
        shown = (
            repr(cell) if len(cell) <= 40 else f"{cell[:40]!r}... ({len(cell)} characters)"
        )
        remedy = "write numbers with a decimal point, and a lost frame as NaN."
        if "," in cell:
            remedy = (
                "write numbers without thousands separators, and divide columns by semicolons "
                "where decimals have commas."
            )
        return InputDataError(
            f"{self.path}: row {self.lines(place)}, column '{name}' is {shown}, not a number; {remedy}"
        )

    def entries(self, name: str) -> np.ndarray:
        """All numbers of a name as one vector."""
        return np.concatenate(self.vectors(name) or [np.empty(0)])

    def number(self, setting: str, value: str | float | None) -> float | None:
        """A setting of a layout that is a number, or the name of a scalar.

        Raises:
            InputDataError: if what it names is missing, or not one positive number.
        """
        if not isinstance(value, str):
            return value
        if self.is_table:
            raise InputDataError(
                f"{self.path}: Layout.{setting} is '{value}'; a table has no such variable: give "
                "the number."
            )
        found = self.entries(value)
        if found.size != 1 or not 0.0 < found[0] < math.inf:
            raise InputDataError(
                f"{self.path}: variable '{value}' ({setting}) is "
                f"{_describe_shape(self.values[self.find(value)])} {found[:4]!s}; expected one positive "
                f"number. Write {setting}=<number> into --layout instead."
            )
        return float(found[0])

    def plain_vectors(self) -> dict[str, np.ndarray]:
        """What is one vector of real numbers: columns, and arrays longer than 1."""
        return {
            name: value.astype(np.float64).reshape(-1)
            for name, value in self.values.items()
            if isinstance(value, np.ndarray)
            and value.dtype.kind in "fiub"
            and (self.is_table or value.size > 1)
            and max(value.shape, default=0) == value.size
        }

    def describe(self) -> str:
        """Names and shapes, such as ``R (256,), All cell of 4 x (257,), Req scalar``."""
        if self.is_table:
            return f"columns {', '.join(self.values)}"
        return ", ".join(
            f"{name} {_describe_shape(value)}" for name, value in self.values.items()
        )


def _describe_shape(value: Any) -> str:
    if isinstance(value, str):
        return "text"
    if isinstance(value, list):
        shapes = sorted(
            {str(np.shape(x)) for x in value if not isinstance(x, (dict, list))}
        )
        return f"cell of {len(value)} x {' or '.join(shapes[:3]) or 'struct'}"
    return str(np.shape(value)) if np.shape(value) else "scalar"


def read_npz(path: Path) -> Content:
    """One curve, or one a row, in SI units."""
    arrays = read_arrays(path, ("time_s", "radius_m"))
    time = arrays["time_s"]
    radius = arrays["radius_m"]
    if radius.ndim not in (1, 2) or time.ndim not in (1, radius.ndim):
        raise InputDataError(
            f"{path}: time_s has shape {time.shape} and radius_m {radius.shape}; expected frames, "
            "or curves x frames, with one time for every radius. Sets of repeated designs "
            "(designs x repeats x frames) are read by imr-torch diagnose."
        )
    values = {name: x if x.ndim == 1 else list(x) for name, x in arrays.items()}
    return Content(path, values)


def read_arrays(path: str | Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Arrays of an ``.npz`` file as float64.

    Args:
        path: the file.
        names: arrays that it must hold.

    Raises:
        InputDataError: if the file is missing or no ``.npz``, lacks an array, or declares arrays
            that are no numbers, or take more than ``LARGEST`` together.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy
    >>> from imr_torch.reading.content import read_arrays
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     numpy.savez(Path(folder) / "gel.npz", time_s=[0.0, 1e-6])
    ...     read_arrays(Path(folder) / "gel.npz", ["time_s"])["time_s"].shape
    (2,)
    """
    path = Path(path)
    if not path.is_file():
        raise InputDataError(
            f"{path}: no such file; check the name and the folder ({path.parent.resolve()})."
        )
    arrays = {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in names if name not in archive.files]
            if missing:
                raise InputDataError(
                    f"{path}: no array {missing[0]!r}; expected {', '.join(names)}, got "
                    f"{', '.join(archive.files) or 'none'}."
                )
            size = sum(archive.zip.getinfo(f"{name}.npy").file_size for name in names)
            if size > LARGEST:
                raise InputDataError(
                    f"{path}: its arrays take {size / 2**30:.3g} GiB, more than "
                    f"{LARGEST / 2**30:.3g} GiB; it is damaged, or must be divided into several "
                    "files."
                )
            for name in names:
                array = archive[name]
                if array.dtype.kind not in "fiub":
                    raise ValueError(
                        f"array {name!r} holds {array.dtype}, not real numbers"
                    )
                arrays[name] = array.astype(np.float64)
    except InputDataError:
        raise
    except (
        Exception
    ) as error:  # zipfile and NumPy each raise their own kinds on damaged files
        raise InputDataError(
            f"{path}: cannot be read as .npz arrays of numbers ({error}); write it with "
            "numpy.savez."
        ) from error
    return arrays
