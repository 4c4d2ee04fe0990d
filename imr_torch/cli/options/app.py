"""Work in the browser, on this machine: drop files, look at the frames, state the medium, run
commands, read their pages.

  imr-torch app
  imr-torch app --out gel_7

It runs the commands of this program and shows what they write; every run has a folder of its own,
with the command line in it. The server can be reached from this machine alone, by the address that
is printed, and loads nothing from elsewhere. It needs the extra `app`: pip install
"imr-torch[app]".
"""

import argparse

from imr_torch.cli.options.shared import InRange

NAME = "app"
SUMMARY = "the same in the browser, on this machine"
WITHOUT = ("seed", "engine", "json")
FOLDER = "imr_torch_app"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument(
        "--out",
        metavar="DIR",
        default=FOLDER,
        help="folder of files and results (default %(default)s)",
    )
    parser.add_argument(
        "--port",
        action=InRange,
        low=0,
        high=65535,
        type=int,
        default=0,
        metavar="N",
        help="where to listen (default: a free port)",
    )
    parser.add_argument(
        "--no-browser", action="store_true", help="print the address and open no browser"
    )
