"""Infer a gel's properties from measured R(t): intervals, model probabilities, and figures of the
fit.

  imr-torch characterize gel.csv --out result
  imr-torch characterize day1/ "day2/*.csv"
  imr-torch characterize day1/ --population --html day1.html
  imr-torch characterize gel.csv --layout "radius=R,radius_unit=um,time=t,time_unit=us"
  imr-torch characterize wide.csv --layout "radius=*,radius_unit=um,time=t,time_unit=us"
  imr-torch characterize bubble.mat --layout "radius=Rnew,radius_unit=px,pixel_size=deltax,frame_interval=deltat"

Files are tables (text or .xlsx) with the columns experiment_id, time_s, radius_m, or with units in
the header ("time (us)", "R [um]"), MATLAB files, .npz, or files of other programs of the field
(BubbleTrack, InCA, IMR codes). What their names do not say, --layout says; units are never guessed.
In a wide table every column of radii is a curve. A JSON file of the same name beside a file may
give R_inf, Rmax, their sd, medium, frame rate, pixel size and exposure. A table with the columns
experiment_id, rmax_m, stretch, collapse_time_s holds shots of which no more is known (errors:
collapse_time_sd_s, 20 ns if not given, rmax_sd_m, stretch_sd), alone or beside curves of the same
gel. --medium states density, sound speed, surface tension, temperature and ambient pressure of the
gel (--medium water,temperature=310,density=1125:11: with a standard deviation it is inferred beside
the gel); the report says what was assumed and whether that matters. All curves are taken to be of
one gel and are fitted together; imr-torch batch --each fits every curve by itself, which shows
whether they agree, and --population says how much the gel differs between them, by evidence. The report says whether
the model explains the curves, which rows were left out, which frames were fitted, and why.
"""

import argparse

from imr_torch.cli.options.names import EFFORTS, FRAMES, METHODS, SCATTER_SCALE
from imr_torch.cli.options.shared import (
    add_driving_argument,
    add_medium_argument,
    add_output_arguments,
    add_physics_argument,
    add_prior_arguments,
    add_reading_arguments,
    add_window_arguments,
)

NAME = "characterize"
SUMMARY = "properties of a gel from measured R(t) files"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        help="files (CSV, text, .xlsx, MATLAB, .npz), folders or patterns",
    )
    add_reading_arguments(parser)
    parser.add_argument("--experiments", metavar="ID,...", help="fit only these experiments")
    parser.add_argument("--exclude", metavar="ID,...", help="leave these experiments out")
    parser.add_argument(
        "--population",
        action="store_true",
        help="also fit every curve by itself and infer how much the gel differs from shot to shot: "
        "median, scatter, evidence",
    )
    parser.add_argument(
        "--scatter-scale",
        type=float,
        metavar="SD",
        help="scale of the half-normal prior of the scatters of ln G, ln mu, ... (default "
        f"{SCATTER_SCALE:g})",
    )
    add_window_arguments(parser)
    parser.add_argument(
        "--scores",
        action="store_true",
        help="also hold curves out and score how well each model predicts them from the others",
    )
    parser.add_argument(
        "--profile",
        action="store_true",
        help="also make the profile likelihood of every parameter of the models with .05 of the "
        "probability or more: is it "
        "bounded by the data on both sides, on one, or flat? It takes a tenth to a fifth of the "
        "fit's time for each parameter "
        "(four curves: 7 to 13 s on one core)",
    )
    parser.add_argument(
        "--method",
        choices=METHODS,
        default="map",
        help="the most probable gel by multistart Gauss-Newton (default), or hybrid ensemble "
        "4D-Var, with the data's own "
        "likelihood or with the tempered one of arXiv 2409.00011; draws are weighted by the "
        "posterior after either",
    )
    parser.add_argument(
        "--effort",
        choices=EFFORTS,
        default="normal",
        help="how many posterior draws are made of a model whose first ones do not settle its "
        "intervals: up to 4 rounds (normal, default) or 8 (thorough)",
    )
    parser.add_argument(
        "--frames",
        choices=FRAMES,
        default="all",
        help="single bad frames are named; `robust` leaves them out of the fit too (default all)",
    )
    add_output_arguments(parser)
    parser.add_argument(
        "--mat",
        metavar="FILE",
        help="write parameters, intervals, curves and residuals for MATLAB, which plots a curve in "
        "two lines: load FILE; plot(curves(1).time_us, curves(1).radius_um, '.', "
        "curves(1).model_time_us, curves(1).model_radius_um)",
    )
    add_medium_argument(parser)
    add_driving_argument(parser)
    add_physics_argument(parser)
    add_prior_arguments(parser)
