"""Simulate one bubble: a gel and a design in, R(t) out.

  imr-torch simulate --model nhkv --set G=8310,mu=0.093 --we 300 --rinf 0.2 --out bubble

Values are in SI units (G in Pa, mu in Pa s). The design is the Weber number We = p_inf Rmax/(2
gamma) and R_inf* = R_inf/Rmax. --medium states the density, sound speed, surface tension,
temperature and ambient pressure.
"""

import argparse

from imr_torch.cli.options.names import MODELS
from imr_torch.cli.options.shared import (
    InRange,
    add_driving_argument,
    add_medium_argument,
    add_output_arguments,
    add_physics_argument,
)

NAME = "simulate"
SUMMARY = "R(t) of one bubble in a gel"
WITHOUT = ("seed",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
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
