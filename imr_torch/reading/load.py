"""Reading curves from files, folders and glob patterns.

A :class:`~imr_torch.reading.layout.Layout` says what a file means; without one, its names must be
those of one of ``KNOWN_LAYOUTS``, or must say the units.

A measured pressure, such as the trace of a hydrophone, as driving of a bubble.
"""

import glob
from pathlib import Path

import numpy as np

from imr_torch.errors import InputDataError
from imr_torch.reading.curves import curves_of
from imr_torch.reading.layout import TIMES, Layout
from imr_torch.reading.names import read_heading
from imr_torch.reading.readers import (
    find_reader,
    is_of_registered_format,
    is_shot_file,
    read_contents,
)
from imr_torch.reading.sidecar import Sidecar
from imr_torch.reading.traces import TraceSet
from imr_torch.simulate import TabulatedDriving

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".mat", ".xlsx", ".npz")
"""Endings of the files that are read when a folder is named."""


def load_traces(*paths: str | Path, layout: Layout | None = None, sort: bool = False) -> TraceSet:
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
    return TraceSet.join([_load_file(path, layout, sort) for path in find_files(*paths)])


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
    found: list[Path] = []
    for name in paths:
        if not str(name) or "\0" in str(name):
            raise InputDataError(f"{str(name)!r} names no file or folder; give the name of one.")
    for path in map(Path, paths):
        if path.is_dir():
            inside = sorted(
                p
                for p in path.iterdir()
                if not p.name.startswith((".", "~$"))
                and (p.suffix.lower() in SUFFIXES or is_of_registered_format(p))
            )
            if not inside:
                raise InputDataError(
                    f"{path}: the folder holds no file of curves; expected files that end in "
                    f"{', '.join(SUFFIXES)}."
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


def _load_file(path: Path, layout: Layout | None, sort: bool) -> TraceSet:
    """The curves of one file, with what the JSON file beside it says."""
    beside = Sidecar(path)
    if layout is None and is_shot_file(path):
        raise InputDataError(
            f"{path}: holds collapse times and no curves; characterize takes such shots "
            "(load_collapse_times reads them)."
        )
    reader = find_reader(path)
    if reader is None:
        contents = read_contents(path)
        traces = TraceSet.join([curves_of(x, layout, beside.said, sort=sort) for x in contents])
    elif layout is None:
        traces = reader.read(path)
    else:
        raise InputDataError(
            f"{path}: is read as {reader.name!r}, which takes no layout; leave the layout out."
        )
    return beside.added_to(traces)


PRESSURES = {"pa": 1.0, "kpa": 1e3, "mpa": 1e6, "bar": 1e5, "atm": 101325.0}
"""Unit, in small letters -> Pa."""


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
    for units, what, example in ((TIMES, "time", "time (us)"), (PRESSURES, "pressure", "p (kPa)")):
        found = {
            name: units[unit]
            for name in content.plain_vectors()
            if (unit := read_heading(name, content.units.get(name, ""), units).unit) is not None
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
        return TabulatedDriving(tuple(times[kept].tolist()), tuple(pressures[kept].tolist()))
    except InputDataError as error:
        raise InputDataError(f"{path}: {error}") from None
