"""Saving figures: several formats, one failure costs no other figure."""

import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from imr_torch.errors import InputDataError
from imr_torch.files import write_atomically
from imr_torch.results import NamedFigure

matplotlib.use("Agg")  # commands write files and open no window

FORMATS = ("png", "pdf", "svg")
WRITTEN = ("png", "pdf")  # where a command is not asked for others
_DPI = 150


def formats_of(text: str) -> tuple[str, ...]:
    """``"png,pdf"`` as formats.

    Raises:
        InputDataError: for a format that is not known, or none.
    """
    found = tuple(dict.fromkeys(part.strip().lower() for part in text.split(",") if part.strip()))
    for name in found or (text,):
        if name not in FORMATS:
            raise InputDataError(
                f"--format is {text!r}; expected some of {', '.join(FORMATS)} with commas between."
            )
    return found


def save(figure: Figure, folder: Path, name: str, formats: Sequence[str] = ()) -> list[Path]:
    """Save a figure in each format (none named: ``WRITTEN``), atomically, and close it; its layout
    is that of the first one.
    """
    paths = []
    try:
        for kind in formats or WRITTEN:
            path = folder / f"{name}.{kind}"
            with plt.rc_context({"pdf.fonttype": 42, "svg.fonttype": "none"}):  # text stays text
                write_atomically(
                    path, lambda stream, kind=kind: figure.savefig(stream, format=kind, dpi=_DPI)
                )
            paths.append(path)
            figure.set_layout_engine("none")  # else made anew for each format
    finally:
        plt.close(figure)
    return paths


def save_figures(figures: Sequence[NamedFigure], folder: Path, formats: Sequence[str] = ()) -> int:
    """Draw and save figures.

    One that fails is named on standard error and costs no other. Returns how many were saved.
    """
    count = 0
    formats = tuple(formats) or WRITTEN
    for item in figures:
        try:
            save(item.draw(), folder, item.name, formats)
            count += 1
        except OSError:  # a full disk, a folder without permission: no figure can be written
            raise
        except Exception as error:  # whatever fails in drawing, the numbers are kept
            plt.close("all")
            print(
                f"imr-torch: the figure {item.name} could not be drawn ({type(error).__name__}: "
                f"{error})",
                file=sys.stderr,
            )
    print(f"wrote {count} figure(s) as {', '.join(formats)} to {folder}")
    return count
