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

import argparse

from imr_torch.cli.options.design import add_space_arguments
from imr_torch.cli.options.shared import (
    InRange,
    add_medium_argument,
    add_physics_argument,
    add_prior_arguments,
    add_reading_arguments,
    add_workers_argument,
)

NAME = "campaign"
SUMMARY = "design, shoot, learn, and again"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
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
    add_workers_argument(parser)
    add_prior_arguments(parser)
