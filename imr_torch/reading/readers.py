"""Containers of files, and the registry of further formats: a function that recognises a file, and
functions that read it.

:func:`imr_torch.reading.load_traces` asks the registered readers first, the last one registered
before the others.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy  # whose parts are imported when they are used

from imr_torch.errors import InputDataError
from imr_torch.reading.content import LARGEST, Content
from imr_torch.reading.matlab import is_matlab, read_matlab_curves
from imr_torch.reading.table import is_workbook, read_text, read_workbook
from imr_torch.reading.traces import TraceSet


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


def find_reader(path: Path) -> Reader | None:
    """The registered reader that recognises a file; None: it is of a container of the package.

    Raises:
        InputDataError: if the file is missing or empty.
    """
    head = _read_head(path)
    return next((x for x in reversed(READERS.values()) if x.recognises(path, head)), None)


def is_of_registered_format(path: Path) -> bool:
    """Whether a registered reader recognises what may be a file."""
    if not READERS or not path.is_file():
        return False
    with path.open("rb") as stream:
        head = stream.read(4096)
    return any(reader.recognises(path, head) for reader in READERS.values())


def read_contents(path: Path) -> list[Content]:
    """What a file of one of the package's containers holds: one table, or several sheets.

    Raises:
        InputDataError: if the file is missing, empty, damaged, or of no known container.
    """
    head = _read_head(path)
    if head.startswith(b"PK") and path.suffix.lower() == ".npz":
        return read_npz(path)
    if is_workbook(path, head):
        return read_workbook(path)
    if is_matlab(path, head):
        return read_matlab_curves(path)
    if b"\0" not in head or head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return read_text(path)
    raise InputDataError(
        f"{path}: unknown container (first bytes {head[:8]!r}); expected text (CSV), a MATLAB "
        "file, .xlsx or .npz: export the curves as CSV with the header "
        "experiment_id,time_s,radius_m."
    )


SHOT_COLUMNS = ("experiment_id", "rmax_m", "stretch", "collapse_time_s")
"""Columns of a table of collapse times."""
SHOT_ARRAY = "pIMR_array"
"""Variable of such a table in MATLAB files: Rmax in m, stretch, collapse time in s; one row a shot."""


def is_shot_file(path: str | Path) -> bool:
    """Whether a file is a table of collapse times, by its header or its variable."""
    try:
        if Path(path).suffix.lower() == ".mat":
            return SHOT_ARRAY in {name for name, _, _ in scipy.io.whosmat(str(path))}
        with Path(path).open(encoding="utf-8-sig") as stream:
            return set(SHOT_COLUMNS) <= {cell.strip() for cell in stream.readline().split(",")}
    except Exception:  # what cannot be read is reported where it is read
        return False


def _read_head(path: Path) -> bytes:
    """The first bytes of a file that can be one."""
    if not path.exists():
        raise InputDataError(
            f"{path}: no such file; check the name and the folder ({path.parent.resolve()})."
        )
    if path.is_dir():
        raise InputDataError(f"{path}: is a folder; name the files in it.")
    with path.open("rb") as stream:
        head = stream.read(4096)
    if not head.removeprefix(b"\xef\xbb\xbf").strip():
        raise InputDataError(f"{path}: the file is empty; export the curve again.")
    return head


def read_npz(path: Path) -> list[Content]:
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
    return [Content(path, values)]


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
    >>> from imr_torch.reading.readers import read_arrays
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
                    raise ValueError(f"array {name!r} holds {array.dtype}, not real numbers")
                arrays[name] = array.astype(np.float64)
    except InputDataError:
        raise
    except Exception as error:  # zipfile and NumPy each raise their own kinds on damaged files
        raise InputDataError(
            f"{path}: cannot be read as .npz arrays of numbers ({error}); write it with "
            "numpy.savez."
        ) from error
    return arrays
