"""Extensions of the command line: Python files that ``--import`` names, and installed packages.

Importing one registers what it adds: models, effects, file formats. A package is an extension by an
entry point of the group ``imr_torch``, whose value is the module to import.
"""

import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from imr_torch.errors import InputDataError


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
    modules = [_import_module(entry.module, f"extension {entry.name!r}") for entry in installed]
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
        lines = [x.lineno for x in frames if Path(x.filename).stem == name.rpartition(".")[2]]
        line = f", line {lines[-1]}" if lines else ""
        raise InputDataError(
            f"{place}{line}: cannot be imported: {type(error).__name__}: {error}. Correct it."
        ) from error
