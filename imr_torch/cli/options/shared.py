"""What an option is, and the options that several subcommands have."""

import argparse
import math
from typing import Any

from imr_torch.cli.options.names import (
    CASES,
    COLLAPSES,
    DEFAULT_MODELS,
    ENGINES,
    EVALUATIONS,
    LIQUIDS,
    MEDIA,
    MODELS,
    PARTS,
    PHYSICS,
    RADIAL,
)
from imr_torch.errors import InputDataError

Option = tuple[str, str, dict[str, Any]]
"""The heading that it stands under in the help, or :data:`ONE_OF`; its name; and the arguments of
:meth:`argparse.ArgumentParser.add_argument`."""
Options = tuple[Option, ...]

ONE_OF = "one of"
"""Group of the options of a command of which only one may be given."""


class InRange(argparse.Action):
    """Takes a number and refuses one outside of a range."""

    def __init__(self, *args: Any, low: float, high: float, **options: Any) -> None:
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


def text_option(name: str, metavar: str | None, help: str, **settings: Any) -> Option:
    """An option that takes a text, None if not given and no ``default`` is said."""
    return "", name, {"metavar": metavar, "help": help, **settings}


def flag_option(name: str, help: str) -> Option:
    """An option that is there or not."""
    return "", name, {"action": "store_true", "help": help}


def choice_option(name: str, choices: tuple[str, ...], default: str | None, help: str) -> Option:
    """An option that takes one of several names."""
    return "", name, {"choices": choices, "default": default, "help": help}


def number_option(
    name: str,
    default: float | None,
    help: str,
    *,
    low: float = 1,
    high: float = math.inf,
    metavar: str | None = None,
) -> Option:
    """An option that takes a number in a range, a whole one unless its default is another."""
    kind = float if isinstance(default, float) else int
    limits = {"action": InRange, "low": low, "high": high}
    return text_option(name, metavar, help, default=default, type=kind, **limits)


def group_options(heading: str, *options: Option) -> Options:
    """Options under a heading of their own."""
    return tuple((heading, name, settings) for _, name, settings in options)


PRIOR = group_options(
    "what is believed before",
    choice_option("--case", CASES, None, "prior of a reference gel of the literature"),
    text_option(
        "--belief", "FILE", "a saved belief (the 'belief' of an earlier --json, or Belief.save)"
    ),
    text_option(
        "--models",
        None,
        f"candidate models, of {', '.join(MODELS)}, or composed of an elastic, a viscous and a memory "
        f"part, as gent+cross+maxwell, of {PARTS} (default {DEFAULT_MODELS})",
    ),
    text_option(
        "--known",
        "NAME=VALUE,...",
        "independently measured parameters in SI, which are not inferred (qkv needs G=...)",
    ),
)
"""Options that choose the prior belief."""

OUT_OPTION = text_option("--out", "DIR", "folder for figures and JSON")
OUTPUT = (
    OUT_OPTION,
    text_option("--html", "FILE", "write the result with its figures as one HTML file"),
)
"""Options for where figures and the page go."""

READING = (
    text_option(
        "--layout",
        "TEXT",
        "how to read the files: name=value pairs (radius=R,radius_unit=um,time=t,...), as "
        "imr-torch characterize --help says",
    ),
    text_option("--rest-radius", "VALUE:SD", "assumed R_inf/Rmax, for records without a tail"),
    flag_option(
        "--sort",
        "put the rows of every curve in the order of their times, as digitised curves need it",
    ),
)
"""Options that say what files of curves do not."""

SPACE = (
    text_option("--we-range", "LOW:HIGH", "Weber numbers (default 100:1000)", default="100:1000"),
    text_option("--rinf-range", "LOW:HIGH", "R_inf/Rmax (default 0.14:0.30)", default="0.14:0.30"),
    number_option(
        "--repeats",
        None,
        "curves per design (default 100 with --case, as in the literature, else 10)",
    ),
    number_option(
        "--evaluations", EVALUATIONS, "designs evaluated in each search (default %(default)s)"
    ),
)
"""Options for the designs a laboratory can shoot and how it will observe them."""

COUNT_ALL_SHOTS = flag_option(
    "--count-all-shots",
    "a shot that stands out from its set by its record alone counts as much as the others "
    "(else little)",
)
BUBBLE = (
    choice_option(
        "--physics",
        PHYSICS,
        "transport",
        "transport of heat and vapour, as in real bubbles (default), or polytropic gas, some "
        "20 times faster and biased",
    ),
    choice_option(
        "--radial", RADIAL, "keller_miksis", "the radial equation (default keller_miksis)"
    ),
    choice_option(
        "--liquid",
        LIQUIDS,
        None,
        "equation of state of the liquid, for radial equations in enthalpy (default tait; of herring "
        "constant_density)",
    ),
)
"""Options of the bubble's own physics."""
DRIVING = text_option(
    "--driving",
    "FILE",
    "pressure on top of the ambient one, such as a hydrophone's: a table with units in "
    'its header ("time (us),p (kPa)"), time zero at the maximum radius',
)
MEDIUM = text_option(
    "--medium",
    "TEXT",
    "the medium: a name and values in SI, each with an optional standard deviation, for example "
    "water,temperature=310,density=1125:11 (properties density, sound_speed, surface_tension, "
    "temperature, pressure; names "
    f"{', '.join(MEDIA)}); a density that is not stated is inferred with the gel of curves (1060 +- 30 "
    "kg/m^3), what else is not stated is assumed",
)
ENGINE = (
    choice_option(
        "--engine",
        ENGINES,
        "compiled",
        "what integrates the bubbles: compiled code (default), or tensors through "
        "torchdiffeq; same results, slower",
    ),
    number_option(
        "--threads",
        None,
        "processor threads of the compiled engine (default: all cores)",
        metavar="N",
    ),
)
"""Options that choose the engine and its threads."""

COMMON: dict[str, Options] = {
    "seed": (
        number_option(
            "--seed", 0, "seed of everything random, from 0 on (default 0)", low=0, high=2**63 - 1
        ),
    ),
    "json": (text_option("--json", "FILE", "write the result as JSON"),),
    "import": (
        text_option(
            "--import",
            "FILE.py",
            "a Python file that adds models, effects or file formats; may be repeated",
            action="append",
            default=[],
            dest="imports",
        ),
    ),
    "engine": ENGINE,
    "": (
        flag_option("--quiet", "no progress on the terminal"),
        flag_option("--verbose", "every step of the fits, instead of one line of progress"),
    ),
}
"""Options of all subcommands, but those that :data:`WITHOUT` takes out."""

WITHOUT = {
    "demo": ("import",),
    "app": ("seed", "engine", "json", "import"),
    "simulate": ("seed",),
    "compare": ("seed", "engine"),
    "plot": ("seed", "engine", "json"),
}
"""Of the options of all subcommands, those that would do nothing."""


def window_options(*, sets: bool = False) -> Options:
    """Options for which part of a curve is fitted, and with what noise.

    Args:
        sets: whether the command takes sets too, whose noise is known and whose window is their own.
    """
    return (
        number_option(
            "--collapses", None, f"collapses in the fitted window of a curve (default {COLLAPSES})"
        ),
        choice_option(
            "--noise",
            ("estimated", "published"),
            None if sets else "estimated",
            "observation noise: estimated from residuals (default of curves), or the published law"
            + " (default of sets)" * sets,
        ),
    )
