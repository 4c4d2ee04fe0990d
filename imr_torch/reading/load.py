"""Reading curves from files, folders and glob patterns.

A :class:`~imr_torch.reading.layout.Layout` says what a file means; without one, its names must be
those of one of ``KNOWN_LAYOUTS``, or must say the units. Further formats are registered: a function
that recognises a file, and one that reads it; the last one registered is asked first.

Tables of collapse times are recognised here (:func:`is_shot_file`) and read by
:mod:`imr_torch.observe.collapse`. :func:`load_driving` reads a measured pressure, such as the trace
of a hydrophone, as driving.
"""

import glob
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy  # whose parts are imported when they are used

from imr_torch.errors import InputDataError
from imr_torch.files import read_table
from imr_torch.reading.content import Content, read_npz
from imr_torch.reading.curves import curves_of
from imr_torch.reading.layout import TIMES, Layout
from imr_torch.reading.matlab import is_matlab, read_matlab_curves
from imr_torch.reading.names import read_heading
from imr_torch.reading.sidecar import Sidecar
from imr_torch.reading.table import is_workbook, read_text, read_workbook
from imr_torch.reading.traces import TraceSet
from imr_torch.simulate import TabulatedDriving

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".mat", ".xlsx", ".npz")
"""Endings of the files that are read when a folder is named."""

SHOT_COLUMNS = ("experiment_id", "rmax_m", "stretch", "collapse_time_s")
"""Columns of a table of collapse times."""
SHOT_ARRAY = "pIMR_array"
"""Variable of such a table in MATLAB files: Rmax in m, stretch, collapse time in s; one row a shot."""


@dataclass(frozen=True)
class Reader:
    """A file format.

    Args:
        name: unique.
        recognises: whether a file is of this format, from its path and its first 4096 bytes; it
            should look at the content.
        read: the curves of a file, in SI units, with what was left out and why. It raises
            :class:`imr_torch.errors.InputDataError` with file, place, value and remedy where it
            cannot.

    >>> import torch
    >>> from imr_torch.reading import RadiusTrace, Reader, TraceSet
    >>> def read(path):
    ...     time, radius = torch.tensor([[float(x) for x in line.split(";")] for line in path.read_text().split()[1:]]).T
    ...     return TraceSet((RadiusTrace(path.stem, 1e-6 * time, 1e-6 * radius, str(path)),))
    >>> Reader("semicolons", lambda path, head: head.startswith(b"IMR;us;um"), read).name
    'semicolons'
    """

    name: str
    recognises: Callable[[Path, bytes], bool]
    read: Callable[[Path], TraceSet]


READERS: dict[str, Reader] = {}
"""Name -> reader of a further format; the last one is asked first."""


def register_reader(reader: Reader) -> Reader:
    """Add a file format; its name must be new.

    >>> from imr_torch.reading import READERS, Reader, TraceSet, register_reader
    >>> reader = Reader("nothing", lambda path, head: head.startswith(b"NOTHING"), lambda path: TraceSet(()))
    >>> register_reader(reader) is READERS["nothing"]
    True
    >>> _ = READERS.pop("nothing")  # undo it here
    """
    if reader.name in READERS:
        raise InputDataError(
            f"A reader of the name {reader.name!r} is registered already; give this one another "
            "name."
        )
    READERS[reader.name] = reader
    return reader


def load_traces(
    *paths: str | Path,
    layout: Layout | None = None,
    sort: bool = False,
    exclude: Collection[str] = (),
) -> TraceSet:
    """Read curves from files.

    Args:
        paths: files, folders (all files in them that end in one of ``SUFFIXES``, or are of a
            registered format), and patterns such as ``"gel7/*.csv"``. A file is a table of text or
            ``.xlsx`` (columns
            ``experiment_id,time_s,radius_m``, or time and radius with their units in the header,
            one column of radii a curve if there are several, or half axes ``a`` and ``b``), a
            MATLAB file (v4 to v7.3), an ``.npz`` with ``time_s`` and ``radius_m``, or of a
            registered format (:func:`imr_torch.reading.register_reader`). A JSON file of the same
            name beside it adds what the laboratory says (:mod:`imr_torch.reading.sidecar`).
        layout: what the columns or variables mean, the same for all files; None: names and units in
            the file must say it.
        sort: put rows in the order of their times, as digitised curves need it; of rows with the
            same time the first is kept.
        exclude: names of curves in these files that are left out, and not checked.

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
    return TraceSet.join(
        [_load_file(path, layout, sort, exclude) for path in find_files(*paths)]
    )


def find_files(*paths: str | Path) -> list[Path]:
    """The files that names of files, folders and patterns stand for, in order.

    Raises:
        InputDataError: if a folder holds no file of a known ending, or no file fits a pattern.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.reading import find_files
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for name in ("b.csv", "a.csv", "a.json"):
    ...         (Path(folder) / name).touch()
    ...     [path.name for path in find_files(folder)]
    ['a.csv', 'b.csv']
    """
    for name in paths:
        if not str(name) or "\0" in str(name):
            raise InputDataError(
                f"{str(name)!r} names no file or folder; give the name of one."
            )
    found: list[Path] = []
    for path in map(Path, paths):
        inside = [path]
        lacking = ""
        if path.is_dir():
            inside = [file for file in path.iterdir() if _is_of_curves(file)]
            lacking = (
                "the folder holds no file of curves; expected files that end in "
                f"{', '.join(SUFFIXES)}"
            )
        elif not path.exists() and glob.has_magic(str(path)):
            inside = [
                file
                for file in map(Path, glob.glob(str(path), recursive=True))
                if file.is_file()
            ]
            lacking = f"no file fits this pattern; check it and the folder ({Path.cwd()})"
        if not inside:
            raise InputDataError(f"{path}: {lacking}.")
        found += sorted(inside)
    return found


def _is_of_curves(path: Path) -> bool:
    """Whether a file of a folder is one of curves, by its ending or by a registered reader."""
    if path.name.startswith((".", "~$")):
        return False
    if path.suffix.lower() in SUFFIXES:
        return True
    return (
        bool(READERS)
        and path.is_file()
        and _find_reader(path, _first_bytes(path)) is not None
    )


def _load_file(
    path: Path, layout: Layout | None, sort: bool, exclude: Collection[str]
) -> TraceSet:
    """The curves of one file, with what the JSON file beside it says."""
    beside = Sidecar(path)
    if layout is None and is_shot_file(path):
        raise InputDataError(
            f"{path}: holds collapse times and no curves; characterize takes such shots "
            "(load_collapse_times reads them)."
        )
    reader = _find_reader(path, _read_head(path))
    if reader is None:
        contents = read_contents(path)
        said = beside.said
        curves = [curves_of(x, layout, said, sort=sort, exclude=exclude) for x in contents]
        traces = TraceSet.join(curves)
    elif layout is None:
        traces = reader.read(path)
    else:
        raise InputDataError(
            f"{path}: is read as {reader.name!r}, which takes no layout; leave the layout out."
        )
    return beside.added_to(traces)


def _find_reader(path: Path, head: bytes) -> Reader | None:
    """The registered reader that recognises a file; None: it is of a container of the package."""
    return next((x for x in reversed(READERS.values()) if x.recognises(path, head)), None)


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(4096)


def _read_head(path: Path) -> bytes:
    """The first bytes of a file that can be one."""
    if not path.exists():
        raise InputDataError(
            f"{path}: no such file; check the name and the folder ({path.parent.resolve()})."
        )
    if path.is_dir():
        raise InputDataError(f"{path}: is a folder; name the files in it.")
    head = _first_bytes(path)
    if not head.removeprefix(b"\xef\xbb\xbf").strip():
        raise InputDataError(f"{path}: the file is empty; export the curve again.")
    return head


def read_contents(path: Path) -> list[Content]:
    """What a file of one of the package's containers holds: one table, or several sheets.

    Raises:
        InputDataError: if the file is missing, empty, damaged, or of no known container.
    """
    head = _read_head(path)
    if head.startswith(b"PK") and path.suffix.lower() == ".npz":
        return [read_npz(path)]
    if is_workbook(path, head):
        return read_workbook(path)
    if is_matlab(path, head):
        return [read_matlab_curves(path)]
    if b"\0" not in head or head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return [read_text(path)]
    raise InputDataError(
        f"{path}: unknown container (first bytes {head[:8]!r}); expected text (CSV), a MATLAB "
        "file, .xlsx or .npz: export the curves as CSV with the header "
        "experiment_id,time_s,radius_m."
    )


def is_shot_file(path: str | Path) -> bool:
    """Whether a file is a table of collapse times, by its header or its variable."""
    try:
        if Path(path).suffix.lower() == ".mat":
            return SHOT_ARRAY in {name for name, _, _ in scipy.io.whosmat(str(path))}
        with Path(path).open(encoding="utf-8-sig") as stream:
            return set(SHOT_COLUMNS) <= {
                cell.strip() for cell in stream.readline().split(",")
            }
    except Exception:  # what cannot be read is reported where it is read
        return False


def load_driving(path: str | Path) -> TabulatedDriving:
    r"""The pressure on top of the ambient one, from a file with columns of time and pressure.

    Args:
        path: a file of any container that curves are read from, with the units in its names, such
            as ``time (us),p (kPa)``. Time zero is the maximum radius of the bubble.

    Raises:
        InputDataError: for a column that is missing, twice there or without unit, and for samples
            that are no driving.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.reading import load_driving
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "p.csv").write_text("time (us),p (kPa)\n0,0\n10,-50\n20,0\n")
    ...     load_driving(Path(folder) / "p.csv").pressures
    (0.0, -50000.0, 0.0)
    """
    content = read_contents(Path(path))[0]
    columns = []
    for units, what, example in (
        (TIMES, "time", "time (us)"),
        (read_table("units")["pressures"], "pressure", "p (kPa)"),
    ):
        found = {
            name: units[unit]
            for name in content.plain_vectors()
            if (unit := read_heading(name, content.units.get(name, ""), units).unit)
            is not None
        }
        if len(found) != 1:
            raise InputDataError(
                f"{path}: expected one column of {what} with its unit, such as '{example}', and "
                f"found {', '.join(found) or 'none'}. The file holds: {content.describe()}."
            )
        ((name, factor),) = found.items()
        columns.append(content.entries(name) * factor)
    times, pressures = columns
    kept = np.isfinite(times) & np.isfinite(pressures)
    try:
        return TabulatedDriving(
            tuple(times[kept].tolist()), tuple(pressures[kept].tolist())
        )
    except InputDataError as error:
        raise InputDataError(f"{path}: {error}") from None
