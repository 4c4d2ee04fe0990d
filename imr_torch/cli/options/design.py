"""Find the experiment that is expected to tell most: the (We, R_inf*) of largest expected
information gain.

imr-torch design --case stiff-pa --out next
imr-torch design --belief posterior.json --we-range 150:600 --rinf-range 0.15:0.25
imr-torch design --models nhkv,gen_qkv --q 3        # what to prepare for a day in the laboratory
"""

import argparse

from imr_torch.cli.options.names import ESTIMATORS, EVALUATIONS, STRATEGIES, TARGETS
from imr_torch.cli.options.shared import (
    InRange,
    add_medium_argument,
    add_output_arguments,
    add_physics_argument,
    add_prior_arguments,
    add_workers_argument,
)

NAME = "design"
SUMMARY = "the most informative next experiment"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
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
        "--estimator",
        choices=ESTIMATORS,
        default="laplace",
        help="of the information gain (default laplace)",
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
    add_workers_argument(parser)
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
