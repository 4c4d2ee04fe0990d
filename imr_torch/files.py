"""Atomic writing of files, JSON that keeps every bit of a float64, and the files that ship with the
package.
"""

import json
import math
import os
import secrets
import tempfile
import tomllib
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from imr_torch.errors import InputDataError

Document = dict[str, Any]
"""A JSON object: a result document, or a part of one."""

_LONGEST_NAME = 200  # bytes; file systems take 255, and temporary files have longer names
_TEMPORARY = ".tmp"
_DATA = Path(__file__).parent / "data"
_DIGITS = 7  # after the decimal point, of numbers that are only drawn


def write_atomically(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, flush it to disk and rename it into
    place.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.files import write_atomically
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_atomically(Path(folder) / "curve.bin", lambda file: file.write(b"radius"))
    ...     (Path(folder) / "curve.bin").read_bytes()
    b'radius'
    """
    path = Path(path).resolve()  # a link stays one
    path.parent.mkdir(parents=True, exist_ok=True)
    if (
        path.exists() and not path.is_file()
    ):  # a device or a pipe is written to, not replaced
        with open(path, "wb") as stream:
            write(stream)
        return
    temporary = path.with_name(f".{path.name[:100]}.{secrets.token_hex(6)}{_TEMPORARY}")
    descriptor = os.open(
        temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666
    )
    try:
        with os.fdopen(descriptor, "wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
        flush_folder(path.parent)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if (
            isinstance(error, OSError)
            and error.errno is not None
            and error.filename is None
        ):  # such as a full disk
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file, atomically.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.files import write_bytes
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_bytes(f"{folder}/gel.html", b"<title>Gel</title>")
    ...     [path.name for path in Path(folder).iterdir()]
    ['gel.html']
    """
    write_atomically(Path(path), lambda stream: stream.write(content))


def check_target(path: str | Path, option: str, *, folder: bool = False) -> None:
    """Refuse a path that could not be written to, before any work is done.

    Args:
        path: a file, or a folder.
        option: who asked for it, for the message.
        folder: whether it is to be a folder.

    Raises:
        InputDataError: if it is of the other kind, or it or the nearest folder above it cannot be
            written to.

    >>> import tempfile
    >>> from imr_torch.files import check_target
    >>> with tempfile.TemporaryDirectory() as home:
    ...     check_target(f"{home}/new/fit.json", "--json")
    """
    if not str(path) or "\0" in str(path):
        raise InputDataError(
            f"{option} is {str(path)!r}, which names no {'folder' if folder else 'file'}; give a "
            "name."
        )
    target = Path(path)
    try:
        if len(target.name.encode()) > _LONGEST_NAME:
            raise InputDataError(
                f"{option} has a name of {len(target.name.encode())} bytes; give one of "
                f"{_LONGEST_NAME} at most."
            )
        if target.exists() and target.is_dir() != folder:
            raise InputDataError(
                f"{option} is {str(target)!r}, which is {'a file' if folder else 'a folder'}; "
                "give another name."
            )
        nearest = next(
            place for place in (target, *target.absolute().parents) if place.exists()
        )
        if nearest != target and not nearest.is_dir():
            raise InputDataError(
                f"{option} is {str(target)!r}, and {str(nearest)!r} is no folder; give another "
                "name."
            )
        if not os.access(nearest, os.W_OK):
            raise InputDataError(
                f"{option} is {str(target)!r}, and {str(nearest)!r} may not be written to; give "
                "another folder."
            )
        if nearest.is_dir():  # a file system that takes no files says so here alone
            with tempfile.TemporaryFile(dir=nearest):
                pass
    except OSError as error:
        raise InputDataError(
            f"{option} is {str(path)[:60]!r}, which cannot be written "
            f"({error.strerror or error}); give another place."
        ) from None


def flush_folder(folder: Path) -> None:
    """Flush the names of a folder's files to disk, where the system can.

    >>> from pathlib import Path
    >>> from imr_torch.files import flush_folder
    >>> flush_folder(Path())
    """
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            with suppress(OSError):  # some network file systems cannot
                os.fsync(descriptor)
        finally:
            os.close(descriptor)


def remove_temporaries(folder: Path, *names: str) -> None:
    """Remove what :func:`write_atomically` left in a folder when its process was killed.

    Args:
        folder: where; it must be certain that nobody is writing these files now.
        names: of the files that were to be written, wildcards allowed.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.files import remove_temporaries
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     (Path(folder) / ".curve.bin.x7.tmp").touch()
    ...     remove_temporaries(Path(folder), "curve.bin")
    ...     list(Path(folder).iterdir())
    []
    """
    for name in names:
        for path in folder.glob(f".{name}.*{_TEMPORARY}"):
            path.unlink(missing_ok=True)


def write_json(path: str | Path, document: Any) -> None:
    """Write ``document`` as indented JSON, atomically. Non-finite numbers are refused, since JSON
    cannot represent them.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.files import write_json
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_json(Path(folder) / "fit.json", {"G": 5000.0})
    ...     (Path(folder) / "fit.json").read_text().split()
    ['{', '"G":', '5000.0', '}']
    """
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    write_bytes(path, text.encode())


def without_nonfinite(document: Any) -> tuple[Any, list[str]]:
    """A document with None for every number that is not finite, and the places of these.

    >>> from imr_torch.files import without_nonfinite
    >>> without_nonfinite({"G": 5000.0, "closed": [0.5, float("nan")]})
    ({'G': 5000.0, 'closed': [0.5, None]}, ['closed.1'])
    """
    places: list[str] = []

    def replace_nonfinite(value: Any, place: tuple[str, ...]) -> Any:
        if isinstance(value, Mapping):
            return {
                name: replace_nonfinite(own, (*place, str(name)))
                for name, own in value.items()
            }
        if isinstance(value, (list, tuple)):
            return [
                replace_nonfinite(own, (*place, str(number)))
                for number, own in enumerate(value)
            ]
        if isinstance(value, float) and not math.isfinite(value):
            places.append(".".join(place))
            return None
        return value

    return replace_nonfinite(document, ()), places


def drawn_numbers(values: Any) -> list[float | None]:
    """Numbers of a curve that is only drawn, for JSON, which has no NaN: seven digits, and None
    where one is not finite.

    Args:
        values: a one-dimensional tensor or array.

    >>> import torch
    >>> from imr_torch.files import drawn_numbers
    >>> drawn_numbers(torch.tensor([1.0 / 3.0, float("nan")], dtype=torch.float64))
    [0.3333333, None]
    """
    return [round(x, _DIGITS) if math.isfinite(x) else None for x in values.tolist()]


def read_json(path: str | Path, *, expected: str = "expected JSON") -> Any:
    """Read a JSON file whose objects have every name once.

    Args:
        path: the file.
        expected: what it should be, for messages.

    Raises:
        InputDataError: if it cannot be read, is no JSON in UTF-8, nests too deep, or repeats a
            name.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.files import read_json
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "fit.json").write_text('{"G": 5000.0}')
    ...     read_json(Path(folder) / "fit.json")
    {'G': 5000.0}
    """
    try:
        return json.loads(
            Path(path).read_text(encoding="utf-8-sig"), object_pairs_hook=_read_once
        )
    except FileNotFoundError:
        raise InputDataError(
            f"{path}: no such file; {expected}: check the name and the folder."
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        why = (
            "its values are nested too deep"
            if isinstance(error, RecursionError)
            else f"{type(error).__name__}: {error}"
        )
        raise InputDataError(
            f"{path}: cannot be used ({why}); {expected}: correct it, or move it away."
        ) from None


def read_table(name: str) -> Document:
    """What a table of the package holds, ``data/NAME.toml``.

    >>> from imr_torch.files import read_table
    >>> read_table("parameters")["mu"]["meaning"]
    'viscosity'
    """
    return tomllib.loads((_DATA / f"{name}.toml").read_text("utf-8"))


def example_gel() -> Path:
    """The table of four curves of one simulated gel, as a laboratory would store them.

    The gel is neo-Hookean Kelvin-Voigt with G = 8.31 kPa and mu = 0.093 Pa s; heat and vapour
    transport, 1 us between frames, noise of 0.3 % of the maximum radius, which is 250 to 400 um. A
    JSON file of the same name beside it gives R_inf and the medium.

    Returns:
        Path of ``example_gel.csv``, with the columns ``experiment_id``, ``time_s``, ``radius_m``.

    >>> from imr_torch import example_gel
    >>> example_gel().read_text().splitlines()[0]
    'experiment_id,time_s,radius_m'
    """
    return _DATA / "example_gel.csv"


def _read_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the name {twice!r} occurs twice in one object")
    return found
