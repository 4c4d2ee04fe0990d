"""Atomic writing of files, and JSON that keeps every bit of a float64."""

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from imr_torch.errors import InputDataError


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


def read_json(path: str | Path, *, expected: str = "expected JSON") -> Any:
    """Read a JSON file whose objects have every name once.

    Args:
        path: the file.
        expected: what it should be, for messages.

    Raises:
        InputDataError: if it cannot be read, is no JSON in UTF-8, nests too deep, or repeats a name.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.files import read_json
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "fit.json").write_text('{"G": 5000.0}')
    ...     read_json(Path(folder) / "fit.json")
    {'G': 5000.0}
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8-sig"), object_pairs_hook=_once)
    except (OSError, ValueError, RecursionError) as error:
        why = "its values are nested too deep" if isinstance(error, RecursionError) else f"{type(error).__name__}: {error}"
        raise InputDataError(f"{path}: cannot be used ({why}); {expected}: correct it, or move it away.") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the name {twice!r} occurs twice in one object")
    return found
