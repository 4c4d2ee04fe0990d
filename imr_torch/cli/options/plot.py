"""Draw the figures and the page of a result again, from its JSON alone.

  imr-torch plot result/characterize.json
  imr-torch plot result/characterize.json --out paper --format pdf,svg --html gel.html
  imr-torch plot result/characterize.json --out paper --format pdf --columns one

Nothing is computed again. Results of characterize (also of result.save in Python), diagnose,
design, campaign, batch, compare and simulate hold what their figures need. Figures go beside the
JSON file, or into --out. With --columns they are drawn at the width at which a journal prints them
(one column: 86 mm, two: 178 mm), with text of 6 to 8 points.
"""

import argparse

from imr_torch.cli.options.names import COLUMNS, FORMATS

NAME = "plot"
SUMMARY = "the figures of a result, from its JSON"
WITHOUT = ("seed", "engine", "json")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("file", metavar="RESULT.json", help="a result that --json or --out wrote")
    parser.add_argument(
        "--out", metavar="DIR", help="folder of the figures (default: that of the JSON file)"
    )
    parser.add_argument(
        "--format",
        default="png,pdf",
        metavar="NAME,...",
        help=f"of {', '.join(FORMATS)} (default png,pdf)",
    )
    parser.add_argument(
        "--columns", choices=COLUMNS, help="draw at the printed width of one or two columns"
    )
    parser.add_argument(
        "--html",
        metavar="FILE",
        help="write the page too (of characterize, campaign, design, batch, compare)",
    )
