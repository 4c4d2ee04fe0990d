"""Help and options of the commands that simulate and design, of the demo and of the application: one
function each, whose docstring is the help.
"""

import argparse

from imr_torch.cli.options.names import (
    EVALUATIONS,
    MODELS,
    STRATEGIES,
    TARGETS,
)
from imr_torch.cli.options.shared import (
    InRange,
    add_driving_argument,
    add_medium_argument,
    add_output_arguments,
    add_physics_argument,
    add_prior_arguments,
    add_reading_arguments,
)


def add_demo(parser: argparse.ArgumentParser) -> None:
    """Run the example: characterise the gel that ships with the package, then a simulated campaign of
    two experiments.

      imr-torch demo
      imr-torch demo --out my_first_look

    Writes the example curves, reports, figures and two pages to open in a browser into the folder. A
    folder that holds files is refused; nothing is ever deleted. The first run on a machine also
    compiles the bubble solver, which takes about a minute.
    """
    parser.add_argument(
        "--out",
        metavar="DIR",
        default="imr_torch_demo",
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


def add_app(parser: argparse.ArgumentParser) -> None:
    """Work in the browser, on this machine: drop files, look at the frames, state the medium, run
    commands, read their pages.

      imr-torch app
      imr-torch app --out gel_7

    It runs the commands of this program and shows what they write; every run has a folder of its own,
    with the command line in it. The server can be reached from this machine alone, by the address that
    is printed, and loads nothing from elsewhere. It needs the extra `app`: pip install
    "imr-torch[app]".
    """
    parser.add_argument(
        "--out",
        metavar="DIR",
        default="imr_torch_app",
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


def add_simulate(parser: argparse.ArgumentParser) -> None:
    """Simulate one bubble: a gel and a design in, R(t) out.

      imr-torch simulate --model nhkv --set G=8310,mu=0.093 --we 300 --rinf 0.2 --out bubble

    Values are in SI units (G in Pa, mu in Pa s). The design is the Weber number We = p_inf Rmax/(2
    gamma) and R_inf* = R_inf/Rmax. --medium states the density, sound speed, surface tension,
    temperature and ambient pressure.
    """
    parser.add_argument(
        "--model", default="nhkv", help=f"constitutive model, of {', '.join(MODELS)} (default nhkv)"
    )
    parser.add_argument(
        "--set", default="", metavar="NAME=VALUE,...", help="parameters of the model in SI units"
    )
    parser.add_argument(
        "--we",
        action=InRange,
        low=1e-3,
        high=1e5,
        type=float,
        default=300.0,
        help="Weber number (default 300: Rmax 332 um)",
    )
    parser.add_argument("--rinf", type=float, default=0.2, help="R_inf/Rmax (default 0.2)")
    parser.add_argument(
        "--until",
        action=InRange,
        low=1e-3,
        high=1e3,
        type=float,
        default=4.0,
        help="last time, in Rmax/U_c (default 4)",
    )
    parser.add_argument(
        "--frames",
        action=InRange,
        low=2,
        high=10**6,
        type=int,
        default=161,
        help="number of output times (default 161)",
    )
    parser.add_argument(
        "--accuracy",
        choices=("fast", "default", "reference"),
        default="default",
        help="named setting",
    )
    add_medium_argument(parser)
    add_driving_argument(parser)
    add_physics_argument(parser)
    add_output_arguments(parser, page=False)


def add_design(parser: argparse.ArgumentParser) -> None:
    """Find the experiment that is expected to tell most: the (We, R_inf*) of largest expected
    information gain.

    imr-torch design --case stiff-pa --out next
    imr-torch design --belief posterior.json --we-range 150:600 --rinf-range 0.15:0.25
    imr-torch design --models nhkv,gen_qkv --q 3        # what to prepare for a day in the laboratory
    """
    add_space_arguments(parser)
    parser.add_argument(
        "--q",
        action=InRange,
        type=int,
        default=1,
        help="designs to prepare together, each chosen beside those before it (default 1)",
    )
    parser.add_argument(
        "--target",
        choices=TARGETS,
        default="both",
        help="what the information is to be about (default both)",
    )
    parser.add_argument(
        "--strategy",
        choices=STRATEGIES,
        default="qLogNEI",
        help="how designs to evaluate are chosen (default qLogNEI)",
    )
    parser.add_argument(
        "--draws",
        action=InRange,
        type=int,
        default=16,
        help="draws per model of each estimate (default 16)",
    )
    add_output_arguments(parser)
    add_medium_argument(parser)
    add_physics_argument(parser)
    add_prior_arguments(parser)


def add_space_arguments(parser: argparse.ArgumentParser) -> None:
    """Options for the designs a laboratory can shoot and how it will observe them."""
    parser.add_argument(
        "--we-range",
        default="100:1000",
        metavar="LOW:HIGH",
        help="Weber numbers (default 100:1000)",
    )
    parser.add_argument(
        "--rinf-range",
        default="0.14:0.30",
        metavar="LOW:HIGH",
        help="R_inf/Rmax (default 0.14:0.30)",
    )
    parser.add_argument(
        "--repeats",
        action=InRange,
        type=int,
        help="curves per design (default 100 with --case, as in the literature, else 10)",
    )
    parser.add_argument(
        "--evaluations",
        action=InRange,
        type=int,
        default=EVALUATIONS,
        help="designs evaluated in each search (default %(default)s)",
    )


def add_campaign(parser: argparse.ArgumentParser) -> None:
    """A sequence of experiments, each chosen for what it is expected to tell.

    With --case the experiments are simulated: a reference gel is kept secret, shot at and
    characterised.

      imr-torch campaign --case stiff-pa --designs 2 --out trial

    With your own gel, ask and tell in turn; the folder remembers everything:

      imr-torch campaign --models nhkv,gen_qkv --out gel7                    # says what to shoot first
      imr-torch campaign --models nhkv,gen_qkv --out gel7 --resume --tell shot1.csv   # learns, says what to shoot next

    Told files carry their achieved design: Rmax and R_inf are measured from the curves. A told file of
    which no curve can be used (a bubble cut off by the edge, a few frames) is recorded as a failed shot
    with its reason: the belief stays, and its design is asked for again, or another one if it failed
    twice. A campaign that was cut off continues with --resume, with the same result as if it had not
    been; --models, --known and --case need not be given again. Each curve counts once; one that should
    not count is taken out again by its number, and may be told again when its file is corrected:

      imr-torch campaign --models nhkv,gen_qkv --out gel7 --resume --forget 2 --tell shot2_corrected.csv

    What to prepare for a day in the laboratory, three designs chosen together:

      imr-torch campaign --models nhkv,gen_qkv --out gel8 --q 3

    Why does the model not fit? Each shot is chosen to tell the remaining causes of the gap apart, until
    one is sure:

      imr-torch campaign --goal cause --models nhkv --out hunt --stop cause=.9 --stop designs=8
      imr-torch campaign --goal cause --case stiff-pa --hide sound_speed --designs 5 --out practice   # with a simulated gel

    How much does the gel differ from shot to shot? Each shot is of a gel of its own; the next one is
    chosen for the median of all and the scatter between them:

      imr-torch campaign --goal population --models nhkv --out gels --stop sd=.05
      imr-torch campaign --goal population --case soft-pa --scatter G=.2 --designs 6 --out practice   # with simulated gels

    What to compare with, and when to end:

      imr-torch campaign --case soft-pa --designs 5 --policy random --stop sd=0.01,probability=0.99 --out baseline
    """
    parser.add_argument(
        "--goal",
        choices=("gel", "cause", "population"),
        default="gel",
        help="what shots are to tell: the gel's model and parameters (default), which effect the "
        "one model lacks, or median "
        "and scatter of one model's parameters where the gel differs from shot to shot",
    )
    parser.add_argument(
        "--effects",
        metavar="NAME,...",
        help="with --goal cause: effects that may be the cause (default: all)",
    )
    parser.add_argument(
        "--hide",
        metavar="NAME[=VALUE]",
        help="with --goal cause and --case: the effect that the simulated gel has, of typical size "
        "if no value (SI) is given",
    )
    parser.add_argument(
        "--scatter",
        metavar="NAME=SD,...",
        help="with --goal population and --case: standard deviation between shots of the logarithm "
        "of parameters, as G=.2",
    )
    parser.add_argument(
        "--designs",
        action=InRange,
        type=int,
        default=2,
        help="experiments of a simulated campaign (default 2)",
    )
    parser.add_argument(
        "--policy",
        default="optimal",
        metavar="NAME",
        help="optimal (default), random, space-filling, or a list of designs "
        "We:R_inf*,We:R_inf*,...",
    )
    parser.add_argument(
        "--stop",
        action="append",
        default=[],
        metavar="RULE",
        help="end early: sd=.01 (every parameter), probability=.99 (of a model), cause=.9 (with "
        "--goal cause, its default), gain=.5 (nats), designs=5, "
        "budget=TOTAL:PER_DESIGN:PER_CURVE (forgotten experiments cost, and are no data); rules "
        "with commas must all hold, "
        "of several options any one",
    )
    parser.add_argument(
        "--method",
        choices=("exact", "en4dvar", "paper"),
        default="exact",
        help="learn from all data by the most probable gels (exact, default) or by hybrid ensemble "
        "4D-Var, or search and learn "
        "as in arXiv 2409.00011, to compare with",
    )
    parser.add_argument(
        "--out", metavar="DIR", required=True, help="folder of the journal, figures and JSON"
    )
    parser.add_argument(
        "--q",
        action=InRange,
        type=int,
        default=1,
        help="designs to choose together, shoot and learn from at once (default 1)",
    )
    parser.add_argument("--resume", action="store_true", help="continue the journal in --out")
    parser.add_argument("--tell", nargs="+", metavar="FILE", help="files of an experiment you made")
    parser.add_argument(
        "--forget",
        type=int,
        metavar="N",
        help="take experiment N, in the order of telling, out of the belief; the journal keeps it "
        "and the numbers of others",
    )
    add_reading_arguments(parser)
    parser.add_argument(
        "--html",
        metavar="FILE",
        help="write the state of the campaign with its figures as one HTML file",
    )
    add_space_arguments(parser)
    add_medium_argument(parser)
    add_physics_argument(parser)
    add_prior_arguments(parser)
