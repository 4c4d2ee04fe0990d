"""Help and options of the subcommands, as ``data/commands.toml`` describes them.

This module imports nothing but the standard library, so that help, version and a mistyped option
answer at once; what a subcommand computes is in the module of its name in :mod:`imr_torch.cli`,
imported when it runs.
"""

import argparse
import math
from typing import Any

from imr_torch.errors import InputDataError
from imr_torch.files import Document, read_table

_models = read_table("models")
MODELS = tuple(_models["models"])
"""Constitutive models."""

PARTS = "; ".join(
    ", ".join(name for name, part in _models["parts"].items() if part["kind"] == kind)
    for kind in ("elastic", "viscous", "memory")
)
"""Parts of composed models: elastic; viscous; memory."""

MEDIA = tuple(read_table("media"))
"""Media whose properties are known."""

FORMATS = ("png", "pdf", "svg")
DEFAULT_MODELS = "newtonian,nhkv,gen_qkv"
COLLAPSES = 2
"""Collapses in the fitted window, if not said otherwise."""

_NAMES = {
    "MODELS": ", ".join(MODELS),
    "PARTS": PARTS,
    "MEDIA": ", ".join(MEDIA),
    "FORMATS": ", ".join(FORMATS),
    "DEFAULT_MODELS": DEFAULT_MODELS,
    "COLLAPSES": COLLAPSES,
}

COMMANDS = read_table("commands")
"""Name -> ``summary``, ``description``, names of its own ``options`` and of those of all commands
(``common``)."""

_SHARED = COMMANDS.pop("shared")
_TYPES = {"int": int, "float": float}


class InRange(argparse.Action):
    """Takes a number and refuses one outside of a range."""

    def __init__(self, *args: Any, low: float, high: float = math.inf, **options: Any) -> None:
        super().__init__(*args, **options)
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


def read_settings(command: str, option: str) -> Document:
    """What :meth:`argparse.ArgumentParser.add_argument` takes for an option of a command, and the
    ``group`` that it stands in, if any.

    >>> from imr_torch.cli.options import read_settings
    >>> read_settings("design", "--rinf-range")["help"]
    'R_inf/Rmax (default 0.14:0.30)'
    """
    settings = COMMANDS[command].get(option) or _SHARED[option]
    settings = settings | {"help": settings["help"].format(**_NAMES)}
    if "type" in settings:
        settings["type"] = _TYPES[settings["type"]]
    if "low" in settings:
        settings["action"] = InRange
    return settings
