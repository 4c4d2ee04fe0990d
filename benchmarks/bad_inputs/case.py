"""A bad input: the command, what has to come of it, and the files that it reads."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from imr_torch import example_gel

EXAMPLE = example_gel()
QUICK = ("--physics", "polytropic", "--threads", "1", "--quiet")
MODELS = ("--models", "nhkv")
FIT = ("characterize", "gel.csv", *MODELS, *QUICK)
NAN = float("nan")
INF = float("inf")


@dataclass(frozen=True)
class Case:
    """One command and what has to come of it.

    Args:
        kind: the group that it is counted in.
        name: unique within the kind.
        arguments: of the command line; ``{here}`` stands for its folder.
        about: what the message must hold: the name of the file, field or option.
        make: writes its files into the folder.
        warned: text that must be printed, where the input is only to be warned of.
        damaged: whether it may be accepted as well.
        status: exit statuses of a refusal.
    """

    kind: str
    name: str
    arguments: tuple[str, ...]
    about: str
    make: Callable[[Path], object] = field(default=lambda here: None)
    warned: str = ""
    damaged: bool = False
    status: tuple[int, ...] = (2,)


def example(experiments: Sequence[str] = ("shot_1",)) -> list[list[str]]:
    """Rows of the example, as fields."""
    rows = [line.split(",") for line in EXAMPLE.read_text().splitlines()]
    return [rows[0], *(row for row in rows[1:] if row[0] in experiments)]


def text_of(rows: Sequence[Sequence[str]]) -> str:
    return "".join(",".join(row) + "\n" for row in rows)


def beside(**more: Any) -> dict[str, Any]:
    """The JSON file beside the example's first curve."""
    entry = {
        "experiment_id": "shot_1",
        "Rinf_m": 4.255438378704616e-05,
        "Rinf_settled": True,
        "Rinf_tail_std_m": 4.25e-07,
    }
    return {"experiments": [entry | more]}


def table(
    content: str | bytes, name: str = "gel.csv", sidecar: Any = None
) -> Callable[[Path], object]:
    """Writes a table, and the JSON file beside it (that of the example when None, none when
    ``False``).
    """

    def make(here: Path) -> None:
        (here / name).write_bytes(
            content if isinstance(content, bytes) else content.encode()
        )
        if sidecar is not False:
            said = beside() if sidecar is None else sidecar
            text = said if isinstance(said, str) else json.dumps(said)
            (here / name).with_suffix(".json").write_text(text)

    return make


def good(here: Path) -> None:
    table(text_of(example()))(here)


def changed(
    change: Callable[[list[list[str]]], Any], sidecar: Any = None
) -> Callable[[Path], object]:
    """The example after a change of its rows."""
    rows = example()
    result = change(rows)
    return table(text_of(rows if result is None else result), sidecar=sidecar)


def written(column: int, value: Callable[[int, str], str]) -> Callable[[Path], object]:
    """The example with another value in a column, of the number of the row and what was there."""

    def change(rows: list[list[str]]) -> None:
        for number, row in enumerate(rows[1:]):
            row[column] = value(number, row[column])

    return changed(change)


def scaled(*columns: int, by: float, sidecar: Any = None) -> Callable[[Path], object]:
    """The example with columns in another unit."""

    def change(rows: list[list[str]]) -> None:
        for row in rows[1:]:
            for column in columns:
                row[column] = repr(by * float(row[column]))

    return changed(change, sidecar)


def cell(row: int, column: int, value: str) -> Callable[[Path], object]:
    """The example with one value changed; row 1 is the first below the header."""
    return written(column, lambda number, old: value if number == row - 1 else old)
