"""Characterise many shots: every file by itself, in several processes, with a summary over all.

  imr-torch batch day1/ --out day1_results
  imr-torch batch "gel7/*.csv" --out gel7 --workers 8 --layout "radius=R,radius_unit=um,time=t,time_unit=us"
  imr-torch batch day1/ --out day1_results --cluster tcp://scheduler:8786

Writes DIR/shots/NAME.json (a result as of characterize, for imr-torch compare and plot),
DIR/summary.csv (and summary.xlsx, with openpyxl), DIR/summary.html and a figure of each parameter.
Curves of one file are of one gel and fitted together; --each takes every curve by itself. The same
command again computes only what is missing: shots whose file, JSON beside it or options have
changed, and those that failed. A file that cannot be used does not stop the others; the exit status
is then 2. Workers of a cluster (Dask, with the extra 'cluster') get the curves sent and need
imr_torch, not the files. --medium states the medium of all shots; without it each file's JSON may
state its own.
"""

import argparse

from imr_torch.cli.options.names import METHODS
from imr_torch.cli.options.shared import (
    InRange,
    add_medium_argument,
    add_physics_argument,
    add_prior_arguments,
    add_reading_arguments,
    add_window_arguments,
)

NAME = "batch"
SUMMARY = "characterise every file of a folder, in processes; resumes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument(
        "files", nargs="+", metavar="FOLDER", help="folders, files or patterns, as for characterize"
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        required=True,
        help="folder for the results; that of an earlier run to resume",
    )
    parser.add_argument(
        "--each", action="store_true", help="every curve of a file is a shot of its own"
    )
    add_reading_arguments(parser)
    add_window_arguments(parser)
    parser.add_argument("--method", choices=METHODS, default="map", help="as for characterize")
    parser.add_argument(
        "--workers", action=InRange, type=int, metavar="N", help="processes (default: one per core)"
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="Dask scheduler whose workers do it, such as tcp://scheduler:8786",
    )
    add_medium_argument(parser)
    add_physics_argument(parser)
    add_prior_arguments(parser)
