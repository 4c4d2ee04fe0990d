"""Registry of file formats: a function that recognises a file, and functions that read it.

:func:`imr_torch.observe.load_traces` asks the readers, the last one registered first; those of the
package (:mod:`imr_torch.observe.formats`) are registered before any other.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from imr_torch.errors import InputDataError
from imr_torch.observe.layout import Layout
from imr_torch.observe.traces import TraceSet


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
        read_with: the same by a layout of the user's; None for a format that takes none.

    >>> import torch
    >>> from imr_torch.observe import RadiusTrace, Reader, TraceSet
    >>> def read(path):
    ...     time, radius = torch.tensor([[float(x) for x in line.split(";")] for line in path.read_text().split()[1:]]).T
    ...     return TraceSet((RadiusTrace(path.stem, 1e-6 * time, 1e-6 * radius, str(path)),))
    >>> Reader("semicolons", lambda path, head: head.startswith(b"IMR;us;um"), read).name
    'semicolons'
    """

    name: str
    recognises: Callable[[Path, bytes], bool]
    read: Callable[[Path], TraceSet]
    read_with: Callable[[Path, Layout], TraceSet] | None = None


READERS: dict[str, Reader] = {}
"""Name -> reader; the last one is asked first."""


def register_reader(reader: Reader) -> Reader:
    """Add a file format; its name must be new.

    >>> from imr_torch.observe import Reader, TraceSet, register_reader
    >>> from imr_torch.observe.readers import READERS
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


def read_file(path: Path, layout: Layout | None) -> TraceSet:
    """Read a file by the first reader that recognises it.

    Raises:
        InputDataError: if the file is missing or empty, no reader recognises it, or its reader
            takes no layout.
    """
    head = _head(path)
    for reader in reversed(READERS.values()):
        if reader.recognises(path, head):
            if layout is None:
                return reader.read(path)
            if reader.read_with is None:
                raise InputDataError(
                    f"{path}: is read as {reader.name!r}, which takes no layout; leave the layout "
                    "out."
                )
            return reader.read_with(path, layout)
    raise InputDataError(
        f"{path}: unknown container (first bytes {head[:8]!r}); expected text (CSV), a MATLAB "
        "file, .xlsx or .npz: export the "
        "curves as CSV with the header experiment_id,time_s,radius_m."
    )


def _head(path: Path) -> bytes:
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
