"""Options that several subcommands have."""

import argparse
import math
from typing import Any

from imr_torch.cli.options.names import (
    CASES,
    COLLAPSES,
    DEFAULT_MODELS,
    ENGINES,
    MEDIA,
    MODELS,
    PHYSICS,
)
from imr_torch.errors import InputDataError


class InRange(argparse.Action):
    """Takes a number and refuses one outside of a range, at least 1 if not said otherwise."""

    def __init__(self, *args: Any, low: float = 1, high: float = math.inf, **options: Any) -> None:
        super().__init__(*args, **options)
        self.low = low
        self.high = high

    def __call__(
        self, parser: object, namespace: argparse.Namespace, value: Any, option: Any = None
    ) -> None:
        """Keep the number.

        Raises:
            InputDataError: if it is outside of the range.
        """
        if not self.low <= value <= self.high:
            limits = (
                f"{self.low} to {self.high}" if self.high < math.inf else f"at least {self.low}"
            )
            raise InputDataError(f"{option} is {value}; expected {limits}.")
        setattr(namespace, self.dest, value)


def add_prior_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that choose the prior belief."""
    group = parser.add_argument_group("what is believed before")
    group.add_argument("--case", choices=CASES, help="prior of a reference gel of the literature")
    group.add_argument(
        "--belief",
        metavar="FILE",
        help="a saved belief (the 'belief' of an earlier --json, or Belief.save)",
    )
    group.add_argument(
        "--models",
        help=f"candidate models, of {', '.join(MODELS)} (default {DEFAULT_MODELS})",
    )
    group.add_argument(
        "--known",
        default="",
        metavar="NAME=VALUE,...",
        help="independently measured parameters in SI, which are not inferred (qkv needs G=...)",
    )


def add_output_arguments(parser: argparse.ArgumentParser, *, page: bool = True) -> None:
    """Options for where figures and the page go."""
    parser.add_argument("--out", metavar="DIR", help="folder for figures and JSON")
    if page:
        parser.add_argument(
            "--html", metavar="FILE", help="write the result with its figures as one HTML file"
        )


def add_reading_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that say what files of curves do not."""
    parser.add_argument(
        "--layout",
        metavar="TEXT",
        help="how to read the files: name=value pairs (radius=R,radius_unit=um,time=t,...), as "
        "imr-torch characterize --help says",
    )
    parser.add_argument(
        "--rest-radius", metavar="VALUE:SD", help="assumed R_inf/Rmax, for records without a tail"
    )
    parser.add_argument(
        "--sort",
        action="store_true",
        help="put the rows of every curve in the order of their times, as digitised curves need it",
    )


def add_window_arguments(parser: argparse.ArgumentParser, *, sets: bool = False) -> None:
    """Options for which part of a curve is fitted, and with what noise.

    Args:
        parser: of the command.
        sets: whether it takes sets too, whose noise is known and whose window is their own.
    """
    parser.add_argument(
        "--collapses",
        action=InRange,
        type=int,
        default=None if sets else COLLAPSES,
        help=f"collapses in the fitted window of a curve (default {COLLAPSES})",
    )
    parser.add_argument(
        "--noise",
        choices=("estimated", "published"),
        default=None if sets else "estimated",
        help="observation noise: estimated from residuals (default of curves), or the published law"
        + " (default of sets)" * sets,
    )


def add_odd_shots_argument(parser: argparse.ArgumentParser) -> None:
    """``--count-all-shots``."""
    parser.add_argument(
        "--count-all-shots",
        action="store_true",
        help="a shot that stands out from its set by its record alone counts as much as the others "
        "(else little)",
    )


def add_physics_argument(parser: argparse.ArgumentParser) -> None:
    """The option that chooses the simulator."""
    parser.add_argument(
        "--physics",
        choices=PHYSICS,
        default="transport",
        help="transport of heat and vapour, as in real bubbles (default), or polytropic gas, some "
        "20 times faster and biased",
    )


def add_driving_argument(parser: argparse.ArgumentParser) -> None:
    """The option that names a measured pressure."""
    parser.add_argument(
        "--driving",
        metavar="FILE",
        help="pressure on top of the ambient one, such as a hydrophone's: a table with units in "
        'its header ("time (us),p (kPa)"), time zero at the maximum radius',
    )


MEDIUM_HELP = (
    "the medium: a name and values in SI, each with an optional standard deviation, for example "
    "water,temperature=310,density=1125:11 (properties density, sound_speed, surface_tension, "
    "temperature, pressure; names "
    f"{', '.join(MEDIA)}); a density that is not stated is inferred with the gel of curves (1060 +- 30 "
    "kg/m^3), what else is not stated is assumed"
)


def add_medium_argument(parser: argparse.ArgumentParser) -> None:
    """The option that states the medium."""
    parser.add_argument("--medium", metavar="TEXT", help=MEDIUM_HELP)


def add_engine_arguments(parser: argparse.ArgumentParser) -> None:
    """The options that choose the engine and its threads."""
    parser.add_argument(
        "--engine",
        choices=ENGINES,
        default="compiled",
        help="what integrates the bubbles: compiled code (default), or tensors through "
        "torchdiffeq; same results, slower",
    )
    parser.add_argument(
        "--threads",
        action=InRange,
        type=int,
        metavar="N",
        help="processor threads of the compiled engine (default: all cores)",
    )
