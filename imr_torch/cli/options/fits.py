"""Help and options of the commands that work on curves and results: one function each, whose docstring
is the help.
"""

import argparse

from imr_torch.cli.options.names import (
    EFFECTS_ADDED,
    EFFORTS,
    FORMATS,
    METHODS,
    MODELS,
    SCATTER_SCALE,
)
from imr_torch.cli.options.shared import (
    InRange,
    add_driving_argument,
    add_medium_argument,
    add_odd_shots_argument,
    add_output_arguments,
    add_physics_argument,
    add_prior_arguments,
    add_reading_arguments,
    add_window_arguments,
)


def add_characterize(parser: argparse.ArgumentParser) -> None:
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
    the gel, as a density that nobody states is); the report says what was assumed and whether that
    matters. All curves are taken to be of
    one gel and are fitted together; imr-torch batch --each fits every curve by itself, which shows
    whether they agree, and --population says how much the gel differs between them, by evidence. The report says whether
    the model explains the curves, which rows were left out, which frames were fitted, and why.
    """
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
        "4D-Var; draws are weighted by the posterior after either",
    )
    parser.add_argument(
        "--effort",
        choices=EFFORTS,
        default="normal",
        help="how many posterior draws are made of a model whose first ones do not settle its "
        "intervals: up to 4 rounds (normal, default) or 8 (thorough)",
    )
    add_odd_shots_argument(parser)
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


def add_batch(parser: argparse.ArgumentParser) -> None:
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


def add_compare(parser: argparse.ArgumentParser) -> None:
    """Compare two gels from their results: do they differ, in which parameter, and by how much.

      imr-torch compare gel_a/characterize.json gel_b/characterize.json
      imr-torch compare day1_results/shots/a.json day1_results/shots/b.json --model nhkv

    Takes results of characterize or batch (written with --json or --out), of independent data. Ratios
    and differences are of parameters, with 90 % intervals. The Bayes factor weighs one gel against two
    with the same prior; it is given where the posteriors are Gaussian by their weighted draws and both
    had the same prior. Without it, gels are said to differ if one has more of a parameter with a
    probability of 97.5 %.
    """
    parser.add_argument("a", metavar="A.json", help="result of the first gel")
    parser.add_argument("b", metavar="B.json", help="result of the second gel")
    parser.add_argument(
        "--model",
        help="model whose parameters are compared (default: the most probable of both together)",
    )
    add_output_arguments(parser)


def add_diagnose(parser: argparse.ArgumentParser) -> None:
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
    add_window_arguments(parser, sets=True)
    parser.add_argument(
        "--most",
        action=InRange,
        type=int,
        default=EFFECTS_ADDED,
        metavar="N",
        help=f"effects that are added one after the other (default {EFFECTS_ADDED})",
    )
    add_odd_shots_argument(parser)
    add_output_arguments(parser)
    add_medium_argument(parser)
    add_driving_argument(parser)
    add_physics_argument(parser)


def add_plot(parser: argparse.ArgumentParser) -> None:
    """Draw the figures and the page of a result again, from its JSON alone.

      imr-torch plot result/characterize.json
      imr-torch plot result/characterize.json --out paper --format pdf,svg --html gel.html

    Nothing is computed again. Results of characterize (also of result.save in Python), diagnose,
    design, campaign, batch, compare and simulate hold what their figures need. Figures go beside the
    JSON file, or into --out.
    """
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
        "--html",
        metavar="FILE",
        help="write the page too (of characterize, campaign, design, batch, compare)",
    )
