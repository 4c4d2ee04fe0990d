"""Draw the figures and the page of a result again, from its JSON alone.

  imr-torch plot result/characterize.json
  imr-torch plot result/characterize.json --out paper --format pdf,svg --html gel.html

Nothing is computed again. Results of characterize, diagnose, design and simulate hold what their figures need. Figures go
beside the JSON file, or into --out.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imr_torch.cli.figures import FORMATS, formats_of, save_figures, subfolder
from imr_torch.errors import InputDataError
from imr_torch.html import write
from imr_torch.results import characterization_page, draw_figures, read_document

NAME = "plot"
SUMMARY = "the figures of a result, from its JSON"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("file", metavar="RESULT.json", help="a result that --json or --out wrote")
    parser.add_argument("--out", metavar="DIR", help="folder of the figures (default: that of the JSON file)")
    parser.add_argument("--format", default="png,pdf", metavar="NAME,...", help=f"of {', '.join(FORMATS)} (default png,pdf)")
    parser.add_argument("--html", metavar="FILE", help="write the page of a characterisation too")


def run(args: argparse.Namespace) -> None:
    """Read, draw."""
    formats, document = formats_of(args.format), read_document(args.file)
    folder = Path(args.out) if args.out else Path(args.file).parent
    if "each" in document:
        for name, part in document["each"].items():
            if "error" in part:
                print(f"{name}: not fitted: {part['error']}")
                continue
            save_figures(draw_figures(part), folder / subfolder(name), formats)
        if args.html:
            raise InputDataError("--html: the result holds one fit per curve (--each), and a page shows one; leave --html out.")
        return
    save_figures(draw_figures(document), folder, formats)
    if args.html:
        print(f"wrote {write(_page(document), args.html)}")


def _page(document: Mapping[str, Any]) -> str:
    name = document["schema"]["name"]
    if name != "imr_torch characterize":
        raise InputDataError(
            f"--html: the result is of {name!r}; a page is made again for characterize only. Leave --html out."
        )
    return characterization_page(document)
