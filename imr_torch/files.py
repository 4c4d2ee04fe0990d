"""Atomic writing of files, and JSON that keeps every bit of a float64."""

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any


def write_atomically(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, flush it to disk and rename it into place.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.files import write_atomically
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_atomically(Path(folder) / "curve.bin", lambda file: file.write(b"radius"))
    ...     (Path(folder) / "curve.bin").read_bytes()
    b'radius'
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def write_json(path: str | Path, document: Any) -> None:
    """Write ``document`` as indented JSON, atomically. Non-finite numbers are refused, since JSON cannot represent them.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.files import write_json
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_json(Path(folder) / "fit.json", {"G": 5000.0})
    ...     (Path(folder) / "fit.json").read_text().split()
    ['{', '"G":', '5000.0', '}']
    """
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    write_atomically(Path(path), lambda stream: stream.write(text.encode()))
