"""Help and options of the subcommands, as ``data/commands.toml`` describes them, and extensions of
the command line: Python files that ``--import`` names, and installed packages.

Importing an extension registers what it adds: models, effects, file formats. A package is one by an
entry point of the group ``imr_torch``, whose value is the module to import.

This module imports nothing but the standard library, so that help, version and a mistyped option
answer at once; what a subcommand computes is in the module of its name in :mod:`imr_torch.cli`,
imported when it runs.
"""

import argparse
import math
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
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

    def __init__(
        self, *args: Any, low: float, high: float = math.inf, **options: Any
    ) -> None:
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
                f"{self.low} to {self.high}"
                if self.high < math.inf
                else f"at least {self.low}"
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


def load_extensions(files: Sequence[str]) -> tuple[str, ...]:
    """Import the modules of installed extensions, and Python files.

    Args:
        files: Python files; their folders are searched for modules from then on, after all others.

    Returns:
        The names of the modules, with which another process can import them too.

    Raises:
        InputDataError: if a file is no Python file, has the name of another module, or cannot be
            run; the message says where.
    """
    installed = entry_points(group="imr_torch")
    modules = [
        _import_module(entry.module, f"extension {entry.name!r}") for entry in installed
    ]
    for path in map(Path, files):
        if path.suffix != ".py" or not path.is_file():
            raise InputDataError(
                f"--import {path}: no such Python file; name one that ends in .py."
            )
        sys.path.append(str(path.resolve().parent))
        module = _import_module(path.stem, f"--import {path}")
        if Path(getattr(module, "__file__", None) or "").resolve() != path.resolve():
            raise InputDataError(
                f"--import {path}: {path.stem!r} is the name of another module; rename the file, "
                "such as my_gel.py."
            )
        modules.append(module)
    return tuple(module.__name__ for module in modules)


def _import_module(name: str, place: str) -> ModuleType:
    try:
        return import_module(name)
    except Exception as error:  # of the code of others
        frames = traceback.extract_tb(error.__traceback__)
        lines = [
            x.lineno for x in frames if Path(x.filename).stem == name.rpartition(".")[2]
        ]
        line = f", line {lines[-1]}" if lines else ""
        raise InputDataError(
            f"{place}{line}: cannot be imported: {type(error).__name__}: {error}. Correct it."
        ) from error
