"""Registry of further file formats: a function that recognises a file, and one that reads it.

:func:`imr_torch.observe.load_traces` asks these before its own readers of text and MATLAB files.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from imr_torch.errors import InputDataError
from imr_torch.observe.traces import TraceSet


@dataclass(frozen=True)
class Reader:
    """A file format.

    Args:
        name: unique.
        recognises: whether a file is of this format, from its path and its first 4096 bytes; it should look at the content.
        read: the curves of a file, in SI units, with what was left out and why. It raises
            :class:`imr_torch.errors.InputDataError` with file, place, value and remedy where it cannot.

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


READERS: dict[str, Reader] = {}
"""Name -> reader, in the order in which they are asked."""


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
        raise InputDataError(f"A reader of the name {reader.name!r} is registered already; give this one another name.")
    READERS[reader.name] = reader
    return reader
