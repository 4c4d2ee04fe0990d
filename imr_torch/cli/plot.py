"""Runs ``imr-torch plot``, and saves the figures of all commands: several formats, one failure costs
no other figure.
"""

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from imr_torch.cli.options import FORMATS
from imr_torch.errors import InputDataError, in_one_line
from imr_torch.files import write_atomically
from imr_torch.progress import Progress, ProgressLine
from imr_torch.results import NamedFigure, draw_figures, read_document, write_page

matplotlib.use("Agg")  # commands write files and open no window


def run_command(args: Namespace) -> None:
    """Read, check, draw.

    Raises:
        InputDataError: naming the file, for a result that is not whole, or of which a figure could
            not be drawn.
    """
    formats = formats_of(args.format)
    document = read_document(args.file)
    folder = Path(args.out) if args.out else Path(args.file).parent
    try:
        failed = save_figures(draw_figures(document), folder, formats)
        if failed:
            raise InputDataError(f"{'; '.join(failed)}; make the result anew.")
        if args.html:
            write_page(document, args.html)
    except InputDataError as error:
        raise InputDataError(f"{args.file}: {error}") from None


def formats_of(text: str) -> list[str]:
    """``"png,pdf"`` as formats.

    Raises:
        InputDataError: for a format that is not known, or none.
    """
    found = [part.strip().lower() for part in text.split(",")]
    if not set(found) <= set(FORMATS):
        raise InputDataError(
            f"--format is {text!r}; expected some of {', '.join(FORMATS)} with commas between."
        )
    return found


def _save_figure(figure: Figure, folder: Path, name: str, formats: Sequence[str]) -> None:
    """Save a figure in each format, atomically; its layout is that of the first one."""
    for kind in formats:
        with plt.rc_context(
            {"pdf.fonttype": 42, "svg.fonttype": "none"}
        ):  # text stays text
            write_atomically(
                folder / f"{name}.{kind}",
                lambda stream, kind=kind: figure.savefig(stream, format=kind, dpi=150),
            )
        figure.set_layout_engine("none")  # else made anew for each format


def save_figures(
    figures: Sequence[NamedFigure],
    folder: Path,
    formats: Sequence[str] = ("png", "pdf"),
    *,
    progress: Progress = None,
) -> list[str]:
    """Draw and save figures; one that fails costs no other.

    Args:
        figures: what is drawn.
        folder: where to.
        formats: of the files.
        progress: called with one line per figure, as the second half of a stage.

    Returns:
        A sentence for each that failed.
    """
    failed = []
    for number, item in enumerate(figures, start=len(figures)):
        if progress:
            text = f"figures: {item.name}"
            progress(ProgressLine(text, step="figures", done=number, of=2 * len(figures)))
        try:
            _save_figure(item.draw(), folder, item.name, formats)
        except (
            OSError
        ):  # a full disk, a folder without permission: no figure can be written
            raise
        except Exception as error:  # whatever fails in drawing, the numbers are kept
            failed.append(
                f"the figure {item.name} could not be drawn ({in_one_line(error)})"
            )
        finally:
            plt.close("all")
    print(
        f"wrote {len(figures) - len(failed)} figure(s) as {', '.join(formats)} to {folder}"
    )
    return failed
