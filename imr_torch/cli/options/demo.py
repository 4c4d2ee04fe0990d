"""Run the example: characterise the gel that ships with the package, then a simulated campaign of
two experiments.

  imr-torch demo
  imr-torch demo --out my_first_look

Writes the example curves, reports, figures and two pages to open in a browser into the folder. A
folder that holds files is refused; nothing is ever deleted. The first run on a machine also
compiles the bubble solver, which takes about a minute.
"""

import argparse

NAME = "demo"
SUMMARY = "the example gel and a simulated campaign; start here"
FOLDER = "imr_torch_demo"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument(
        "--out",
        metavar="DIR",
        default=FOLDER,
        help="a new folder for the results (default %(default)s)",
    )
    parser.add_argument(
        "--again",
        action="store_true",
        help="write into the folder of an earlier demo: its files are made anew, other files are "
        "kept",
    )
    parser.add_argument(
        "--short",
        action="store_true",
        help="one model, two curves, one polytropic experiment: only to test an installation",
    )
