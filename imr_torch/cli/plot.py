"""Runs ``imr-torch plot``; its help and options are in :mod:`imr_torch.cli.options.plot`."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from imr_torch.cli.figures import formats_of, save_figures
from imr_torch.errors import InputDataError
from imr_torch.html import write
from imr_torch.labels import file_name
from imr_torch.results import (
    NamedFigure,
    document_page,
    draw_figures,
    for_publication,
    read_document,
)


def run(args: argparse.Namespace) -> None:
    """Read, check, draw.

    Raises:
        InputDataError: naming the file, for a result that is not whole, or of which a figure could
            not be drawn.
    """
    formats = formats_of(args.format)
    document = read_document(args.file)
    folder = Path(args.out) if args.out else Path(args.file).parent
    parts = _each(args, document, folder) if "each" in document else {folder: document}
    try:
        figures = {place: _sized(draw_figures(part), args.columns) for place, part in parts.items()}
    except InputDataError as error:
        raise InputDataError(f"{args.file}: {error}") from None
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InputDataError(
            f"{args.file}: is not a whole result ({type(error).__name__}: {error}); make it anew."
        ) from None
    missing = sum(
        len(items) - save_figures(items, place, formats) for place, items in figures.items()
    )
    if args.html:
        print(f"wrote {write(document_page(document), args.html)}")
    if missing:
        raise InputDataError(
            f"{args.file}: {missing} figure(s) could not be drawn (see above); make the result "
            "anew."
        )


def _sized(figures: Sequence[NamedFigure], columns: str | None) -> list[NamedFigure]:
    """The figures, at their printed width where one is named."""
    if columns is None:
        return list(figures)
    return [
        replace(figure, plot=partial(for_publication, figure.draw, columns)) for figure in figures
    ]


def _each(
    args: argparse.Namespace, document: Mapping[str, Any], folder: Path
) -> dict[Path, Mapping[str, Any]]:
    """The results of ``characterize --each`` by the folders of their figures."""
    if args.html:
        raise InputDataError(
            "--html: the result holds one fit per curve (--each), and a page shows one; leave "
            "--html out."
        )
    parts: dict[Path, Mapping[str, Any]] = {}
    if not isinstance(document["each"], Mapping):
        raise InputDataError(f"{args.file}: 'each' is no object of results; make it anew.")
    for name, part in document["each"].items():
        if not isinstance(part, Mapping):
            raise InputDataError(f"{args.file}: the result of {name!r} is no object; make it anew.")
        if "error" in part:
            print(f"{name}: not fitted: {part['error']}")
        else:
            parts[folder / file_name(name)] = part
    return parts
