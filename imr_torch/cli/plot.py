"""Runs ``imr-torch plot``; its help and options are in :mod:`imr_torch.cli.options.plot`."""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from imr_torch.cli.figures import formats_of, save_figures
from imr_torch.errors import InputDataError
from imr_torch.labels import file_name
from imr_torch.results import draw_figures, for_publication, read_document, write_page


def run(args: argparse.Namespace) -> None:
    """Read, check, draw.

    Raises:
        InputDataError: naming the file, for a result that is not whole, or of which a figure could
            not be drawn.
    """
    formats = formats_of(args.format)
    document = read_document(args.file)
    folder = Path(args.out) if args.out else Path(args.file).parent
    failed: list[str] = []
    try:
        parts = _each(args, document, folder) if "each" in document else {folder: document}
        for place, part in parts.items():
            figures = draw_figures(part)
            if args.columns:
                figures = [
                    replace(figure, plot=partial(for_publication, figure.draw, args.columns))
                    for figure in figures
                ]
            failed += save_figures(figures, place, formats)
        if failed:
            raise InputDataError(f"{'; '.join(failed)}; make the result anew.")
        if args.html:
            write_page(document, args.html)
    except InputDataError as error:
        raise InputDataError(f"{args.file}: {error}") from None


def _each(
    args: argparse.Namespace, document: Mapping[str, Any], folder: Path
) -> dict[Path, Mapping[str, Any]]:
    """The results of ``characterize --each`` by the folders of their figures."""
    if args.html:
        raise InputDataError(
            "the result holds one fit per curve (--each), and a page shows one; leave --html out."
        )
    results = document["each"]
    if not isinstance(results, Mapping) or not all(
        isinstance(part, Mapping) for part in results.values()
    ):
        raise InputDataError("'each' is no object of results; make it anew.")
    parts: dict[Path, Mapping[str, Any]] = {}
    for name, part in results.items():
        if "error" in part:
            print(f"{name}: not fitted: {part['error']}")
        else:
            parts[folder / file_name(name)] = part
    return parts
