"""What every result document says of itself: schema, software, date, command, files with their
hashes, medium and units.
"""

import hashlib
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from imr_torch.errors import InputDataError
from imr_torch.files import Document, read_json, read_table
from imr_torch.observe import CollapseTime, Experiment, GelMedium
from imr_torch.units import Surroundings

SCHEMA_VERSION = 1
"""Raised when a key of a result document changes its meaning or goes away; new keys do not raise it."""

UNITS = read_table("units")["document"]
"""What the numbers of a result document are in."""


def header(
    kind: str,
    *,
    files: Sequence[str | Path] = (),
    medium: GelMedium | Surroundings | None = None,
    command: str = "",
) -> Document:
    """The keys that every result document begins with.

    Args:
        kind: what the document holds, the name of the command that made it.
        files: data files that were read; JSON files of the same names beside them are named too.
        medium: the liquid side, with what was stated and what was assumed; of plain surroundings
            all is assumed.
        command: the command line.

    >>> from imr_torch.results import header
    >>> from imr_torch.units import Surroundings
    >>> document = header("characterize", medium=Surroundings(density=998.0))
    >>> document["schema"], document["medium"]["density"]["value"]
    ({'name': 'imr_torch characterize', 'version': 1}, 998.0)
    """
    read = [p for path in map(Path, files) for p in (path, path.with_suffix(".json"))]
    document: Document = {
        "schema": {"name": f"imr_torch {kind}", "version": SCHEMA_VERSION},
        "software": {
            "imr_torch": version("imr-torch"),
            "torch": str(torch.__version__),
            "python": platform.python_version(),
        },
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "files": [_describe_file(path) for path in dict.fromkeys(read) if path.is_file()],
        "units": UNITS,
    }
    if medium is not None:
        stated = GelMedium(medium) if isinstance(medium, Surroundings) else medium
        document["medium"] = stated.to_dict()
        document["medium_sentence"] = stated.report().splitlines()[0]
    return document


def describe_shot(shot: Experiment | CollapseTime, surroundings: Surroundings) -> Document:
    """Name and design of a shot, JSON-ready.

    >>> from imr_torch.document import describe_shot
    >>> from imr_torch.observe import CollapseTime
    >>> from imr_torch.units import Surroundings
    >>> shot = describe_shot(CollapseTime("a", (400.0, 0.2), 0.91, 0.001), Surroundings())
    >>> shot["id"], shot["We"], shot["R_inf*"], round(shot["Rmax_m"], 6)
    ('a', 400.0, 0.2, 0.000442)
    """
    weber, rest = shot.design
    size = float(surroundings.max_radius(weber))
    return {"id": shot.label, "We": weber, "R_inf*": rest, "Rmax_m": size}


def is_explained(document: Document, where: str = "") -> bool | None:
    """Whether the most probable model explains the curves; None where that was not tested.

    Args:
        document: a result.
        where: what an error begins with.

    Raises:
        InputDataError: where the document says something else.

    >>> from imr_torch.document import is_explained
    >>> is_explained({"fit_test": {"explained": False}}), is_explained({})
    (False, None)
    """
    said = document.get("fit_test") or {}
    explained = said.get("explained") if isinstance(said, dict) else "none of these"
    if explained is None or isinstance(explained, bool):
        return explained
    raise InputDataError(
        f"{where}'fit_test' is {said!r}; the result is not whole, make it anew."
    )


def _describe_file(path: Path) -> Document:
    content = path.read_bytes()
    return {
        "name": path.name,
        "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def read_document(path: str | Path) -> Document:
    """Read a result document and check it.

    Raises:
        InputDataError: if the file cannot be read, is no JSON, or no result of a version that this
            software knows.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.files import write_json
    >>> from imr_torch.results import header, read_document
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_json(Path(folder) / "result.json", header("design"))
    ...     read_document(Path(folder) / "result.json")["schema"]["name"]
    'imr_torch design'
    """
    document = read_json(path, expected="expected a result that --json or --out wrote")
    check_document(document, str(path))
    return document


def check_document(document: Any, source: str = "The document") -> None:
    """Raise unless a document is a result of a schema version that this software reads.

    Raises:
        InputDataError: naming the key, what it holds and what to do.

    >>> from imr_torch.errors import InputDataError
    >>> from imr_torch.results import check_document
    >>> try:
    ...     check_document({"schema": {"name": "imr_torch design", "version": 99}})
    ... except InputDataError as error:
    ...     print(error)
    The document: schema version is 99; this software reads 1. Install a newer imr-torch.
    """
    schema = document.get("schema") if isinstance(document, Mapping) else None
    if not isinstance(schema, Mapping) or not str(schema.get("name", "")).startswith(
        "imr_torch "
    ):
        raise InputDataError(
            f"{source}: has no 'schema' of imr_torch, so it is no result that can be drawn; make "
            "it anew with --json."
        )
    number = schema.get("version")
    if number != SCHEMA_VERSION:
        newer = isinstance(number, int) and number > SCHEMA_VERSION
        remedy = "Install a newer imr-torch." if newer else "Make the result anew."
        raise InputDataError(
            f"{source}: schema version is {number}; this software reads {SCHEMA_VERSION}. {remedy}"
        )
