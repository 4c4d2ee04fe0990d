"""Help and options of the subcommands, in the order of ``imr-torch --help``, as ``data/options.toml``
states them.

This package imports nothing but the standard library, so that help, version and a mistyped option
answer at once; what a subcommand computes is in the module of its name in :mod:`imr_torch.cli`,
imported when it runs.
"""

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any

from imr_torch.cli.options import names
from imr_torch.errors import InputDataError
from imr_torch.files import Document, read_table

Option = tuple[str, str, dict[str, Any]]
"""The heading that it stands under in the help, or :data:`ONE_OF`; its name; and the arguments of
:meth:`argparse.ArgumentParser.add_argument`."""

ONE_OF = "one of"
"""Heading of the options of a command of which only one may be given."""


class InRange(argparse.Action):
    """Takes a number and refuses one outside of a range."""

    def __init__(
        self, *args: Any, low: float, high: float = math.inf, type: Any = int, **options: Any
    ) -> None:
        super().__init__(*args, type=type, **options)
        self.low = low
        self.high = high

    def __call__(
        self, parser: object, namespace: argparse.Namespace, value: Any, option: Any = None
    ) -> None:
        """Keep the number.

        Raises:
            InputDataError: if it is outside of the range.
        """
        if not self.low <= value <= self.high:
            limits = (
                f"{self.low} to {self.high}" if self.high < math.inf else f"at least {self.low}"
            )
            raise InputDataError(f"{option} is {value}; expected {limits}.")
        setattr(namespace, self.dest, value)


@dataclass(frozen=True)
class Command:
    """What the command line says of a command and takes from it.

    Args:
        summary: what it does, in a phrase.
        description: its help.
        options: of its own.
        common: those that nearly all commands have.

    >>> from imr_torch.cli.options import COMMANDS
    >>> [name for _, name, _ in COMMANDS["plot"].options]
    ['file', '--out', '--format', '--html']
    """

    summary: str
    description: str
    options: tuple[Option, ...]
    common: tuple[Option, ...]


_TABLE = read_table("options")
_NAMED = {name: value for name, value in vars(names).items() if name.isupper()}
_LISTED = {
    name: ", ".join(value) if isinstance(value, tuple) else value for name, value in _NAMED.items()
}
_TYPES = {"int": int, "float": float}


def _list_options(table: Document) -> Iterator[Option]:
    """The options of a table, with those that it shares in their places."""
    for name, row in table.items():
        if not row:
            yield from _list_options(_TABLE["shared"][name])
            continue
        given = {
            key: _NAMED.get(value, value) if isinstance(value, str) else value
            for key, value in row.items()
        }
        given["help"] = given["help"].format(**_LISTED)
        if "type" in given:
            given["type"] = _TYPES[given["type"]]
        if "low" in given:
            given["action"] = InRange
        yield given.pop("heading", ""), name, given


def _read_command(row: Document) -> Command:
    missing = row.get("without", ())
    common = [options for kind, options in _TABLE["common"].items() if kind not in missing]
    return Command(
        row["summary"],
        row["description"].strip(),
        tuple(_list_options(row["options"])),
        tuple(chain(*map(_list_options, common))),
    )


COMMANDS = {name: _read_command(row) for name, row in _TABLE["commands"].items()}
"""Command -> its help and options."""
