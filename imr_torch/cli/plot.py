"""Runs ``imr-torch plot``."""

from argparse import Namespace
from pathlib import Path

from imr_torch.cli.figures import formats_of, save_figures
from imr_torch.errors import InputDataError
from imr_torch.results import draw_figures, read_document, write_page


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
