"""Find where the model fails: is there a gap to the data, where does it lie, which unmodelled
effect causes it.

  imr-torch diagnose gel.csv --html page.html
  imr-torch diagnose set.npz --without sound_field,pulse --json result.json

Files are those of characterize, one gel in all of them, or .npz sets of repeated designs (time_s:
designs x frames; radius_m: designs x repeats x frames; we and rinf_star: designs, as measured). The
noise of a set is the published law; that of single curves is inferred from how their frames
scatter. --effects and --without choose what may be the cause; by default every effect of the
library may. No cause is named without converged fits, nor where no effect of the library is enough.
"""

import argparse

from imr_torch.cli.options.names import EFFECTS_ADDED, MODELS
from imr_torch.cli.options.shared import (
    InRange,
    add_driving_argument,
    add_medium_argument,
    add_output_arguments,
    add_physics_argument,
    add_reading_arguments,
    add_workers_argument,
)

NAME = "diagnose"
SUMMARY = "where the model fails, and which effect it lacks"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        help="curves (CSV, text, MATLAB) or sets (.npz), not both",
    )
    parser.add_argument(
        "--base",
        default="nhkv",
        help=f"model that is put to the test, of {', '.join(MODELS)} (default nhkv)",
    )
    parser.add_argument(
        "--known",
        default="",
        metavar="NAME=VALUE,...",
        help="independently measured parameters in SI",
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--effects",
        metavar="NAME,...",
        help="effects that may be the cause (default: the whole library)",
    )
    which.add_argument(
        "--without", metavar="NAME,...", help="effects of the library that are left out"
    )
    parser.add_argument(
        "--heldout",
        metavar="ID,...",
        help="experiments that no fit may see (of a set: design 0, design 1, ...)",
    )
    parser.add_argument("--experiments", metavar="ID,...", help="use only these experiments")
    add_reading_arguments(parser)
    parser.add_argument(
        "--collapses",
        action=InRange,
        type=int,
        help="collapses in the window of a curve (default 2)",
    )
    parser.add_argument(
        "--noise",
        choices=("estimated", "published"),
        help="default: published for sets, estimated for curves",
    )
    parser.add_argument(
        "--most",
        action=InRange,
        type=int,
        default=EFFECTS_ADDED,
        metavar="N",
        help=f"effects that are added one after the other (default {EFFECTS_ADDED})",
    )
    add_output_arguments(parser)
    add_medium_argument(parser)
    add_driving_argument(parser)
    add_physics_argument(parser)
    add_workers_argument(parser)
