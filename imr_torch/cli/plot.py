"""Runs ``imr-torch plot``, and saves the figures of all commands: several formats, one failure costs
no other figure.
"""

from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt

from imr_torch.cli.options import FORMATS
from imr_torch.errors import InputDataError, in_one_line
from imr_torch.files import write_atomically
from imr_torch.progress import Progress, report_progress
from imr_torch.results import (
    NamedFigure,
    document_report,
    draw_figures,
    read_document,
    write_page,
)

matplotlib.use("Agg")  # commands write files and open no window


def run_command(args: Namespace) -> None:
    """Read, check, draw.

    Raises:
        InputDataError: naming the file, for a result that is not whole, or of which a figure could
            not be drawn.
    """
    formats = [part.strip().lower() for part in args.format.split(",")]
    if not set(formats) <= set(FORMATS):
        raise InputDataError(
            f"--format is {args.format!r}; expected some of {', '.join(FORMATS)} with commas "
            "between."
        )
    document = read_document(args.file)
    folder = Path(args.out) if args.out else Path(args.file).parent
    try:
        # what fails is to fail before figures are drawn
        report = document_report(document) if args.html else ""
        failed = save_figures(draw_figures(document), folder, formats)
        if failed:
            raise InputDataError(f"{'; '.join(failed)}; make the result anew.")
        if args.html:
            write_page(document, args.html, report=report)
    except InputDataError as error:
        raise InputDataError(f"{args.file}: {error}") from None


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
        text = f"figures: {item.name}"
        report_progress(progress, text, step="figures", done=number, of=2 * len(figures))
        try:
            figure = item.draw()
            for kind in formats:
                # text stays text
                with plt.rc_context({"pdf.fonttype": 42, "svg.fonttype": "none"}):
                    write_atomically(
                        folder / f"{item.name}.{kind}",
                        partial(figure.savefig, format=kind, dpi=150),
                    )
                figure.set_layout_engine("none")  # else made anew for each format
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
