"""``imr-torch --print-completion SHELL``: the script that lets a shell complete subcommands,
options and file names.
"""

import argparse
import importlib
from typing import Any

SHELLS = ("bash", "zsh", "fish", "tcsh")
_FILES = ("FILE", "FOLDER", "A.json", "B.json", "RESULT.json")


class PrintCompletion(argparse.Action):
    """Prints the script, made by shtab from the parser, and ends."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: object,
        values: object,
        option_string: object = None,
    ) -> None:
        """Print and exit."""
        try:
            shtab = importlib.import_module("shtab")
        except ImportError:
            parser.exit(2, "imr-torch: --print-completion needs shtab: pip install shtab\n")
        _mark_files(parser, {"file": shtab.FILE, "folder": shtab.DIRECTORY})
        print(shtab.complete(parser, shell=str(values)))
        parser.exit()


def _mark_files(parser: argparse.ArgumentParser, kinds: dict[str, Any]) -> None:
    """Say which arguments are files and which are folders, by their placeholders, in a parser and
    those of its subcommands.
    """
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                _mark_files(sub, kinds)
        elif action.metavar in _FILES:
            action.complete = kinds["file"]  # type: ignore[attr-defined]
        elif action.metavar == "DIR":
            action.complete = kinds["folder"]  # type: ignore[attr-defined]
