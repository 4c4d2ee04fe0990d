"""What the runs of subcommands share: priors and simulators from options, progress, and where
results go.
"""

import math
import shlex
import sys
from argparse import Namespace
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from imr_torch.assimilate import En4DVarOptions, FitOptions, SearchOptions
from imr_torch.characterization import medium_of
from imr_torch.cli.options import COLLAPSES, DEFAULT_MODELS
from imr_torch.cli.plot import save_figures
from imr_torch.document import is_explained
from imr_torch.errors import InputDataError
from imr_torch.files import Document, read_json, without_nonfinite, write_json
from imr_torch.float64 import tensor
from imr_torch.material import PARAMETERS, Belief, reference_case, wide_prior
from imr_torch.observe import CollapseShot, GelMedium, Layout, Statement, TraceSet
from imr_torch.reading import load_driving
from imr_torch.results import document_report, draw_figures, header, write_page
from imr_torch.simulate import (
    ACCURACIES,
    LIQUIDS,
    RADIAL_EQUATIONS,
    PolytropicSimulator,
    RadialEquation,
    Simulator,
    TransportSimulator,
)

AnySimulator = PolytropicSimulator | TransportSimulator
SIMULATORS: dict[str, AnySimulator] = {
    "polytropic": PolytropicSimulator(),
    "transport": TransportSimulator(accuracy=ACCURACIES["search"]),
}

METHODS: dict[str, FitOptions] = {"map": SearchOptions(), "en4dvar": En4DVarOptions()}
"""Methods that fit a gel, by name."""


def read_options(args: Namespace) -> None:
    """Read the texts of options that hold more than a name, before any work.

    ``args.given`` keeps all options as they were given.
    """
    args.given = dict(vars(args))
    args.collapses = args.given.get("collapses") or COLLAPSES
    for name, read in _READ.items():
        if args.given.get(name) is not None:
            setattr(args, name, read(args.given[name], f"--{name.replace('_', '-')}"))


def refuse_options(args: Namespace, names: Iterable[str], why: str) -> None:
    """Raise if one of some options is given, with a sentence that begins with its name."""
    for name in names:
        if args.given[name] not in (None, False):
            raise InputDataError(f"--{name.replace('_', '-')} {why}")


def with_medium(
    args: Namespace,
    prior: Belief,
    traces: TraceSet | None = None,
    shots: Sequence[CollapseShot] = (),
) -> tuple[Simulator, Belief, GelMedium]:
    """The simulator that the options name and a prior, with the medium that options and files state.

    The header of results will say it.
    """
    simulator = simulator_of(args)
    surroundings = simulator.conditions.surroundings
    medium = medium_of(traces or TraceSet(()), args.medium, surroundings, shots)
    args.gel_medium = medium
    return medium.applied(simulator), medium.believed(prior), medium


def exact_medium(args: Namespace, prior: Belief) -> str:
    """What nobody stated, and is exact here while ``characterize`` infers it, in a sentence."""
    medium = args.gel_medium
    known = [*medium.sds, *prior.models[0].material.names]
    exact = [name for name in medium.loosened.sds if name not in known]
    if args.case or not exact:
        return ""
    return (
        f"You did not state the {exact[0]}: {medium.value(exact[0])} is taken as exact here, while "
        "characterize infers it and finds wider intervals of G. Measure it and state it "
        "(--medium density=VALUE:SD)."
    )


def with_engine(simulator: AnySimulator, args: Namespace) -> AnySimulator:
    """A simulator with the engine, threads, radial equation and driving that the options name."""
    driving = getattr(args, "driving", None)
    conditions = replace(simulator.conditions, motion=motion_of(args), driving=driving)
    return replace(
        simulator, engine=args.engine, threads=args.threads, conditions=conditions
    )


def motion_of(args: Namespace) -> RadialEquation:
    """The radial equation that the options name, with its liquid."""
    motion = RADIAL_EQUATIONS[args.radial]
    if args.liquid is None:
        return motion
    try:
        return replace(motion, liquid=LIQUIDS[args.liquid])
    except ValueError:
        raise InputDataError(
            f"--liquid is {args.liquid}, and --radial {args.radial} is an equation in pressure; leave "
            "it out, or give --radial keller_miksis_enthalpy."
        ) from None


def simulator_of(args: Namespace) -> AnySimulator:
    """The simulator that ``--physics`` names, with what other options say about it."""
    return with_engine(SIMULATORS[args.physics], args)


def prior_of(args: Namespace) -> Belief:
    """The prior that the options name: a saved belief, a case, or the wide prior over ``--models``."""
    if args.belief and args.case:
        raise InputDataError("--belief and --case both name a prior; give one of them.")
    if args.belief or args.case:
        other = "--belief" if args.belief else "--case"
        why = f"has no effect beside {other}, which names models and priors; leave one of them out."
        refuse_options(args, ("models", "known"), why)
        if not args.belief:
            return reference_case(args.case).prior
        belief = Belief.load(args.belief)
        belief_cautions(args)  # refuses a result that is not whole
        return belief
    return wide_prior(args.models or DEFAULT_MODELS.split(","), known=args.known)


def belief_cautions(args: Namespace) -> list[str]:
    """What is to be known of the result whose belief ``--belief`` names."""
    path = args.belief
    if not path or is_explained(read_json(path), f"{path}: ") is not False:
        return []
    return [
        f"the model of {path} does not explain its curves, and what follows assumes that it "
        "does; find out what it lacks first: imr-torch diagnose"
    ]


def parse_values(text: str, option: str) -> dict[str, float]:
    """``"G=2770,mu=0.1"`` as a dictionary of SI values."""
    values = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, _, number = item.partition("=")
        name = PARAMETERS[name.strip()].name
        try:
            value = float(number)
        except ValueError:
            raise InputDataError(
                f"{option}: {item!r} is not NAME=NUMBER, for example G=2770 (SI units)."
            ) from None
        if name in values:
            raise InputDataError(
                f"{option}: {name} is given twice, {values[name]:g} and {value:g}; give it once."
            )
        PARAMETERS.check(name, tensor(value))
        values[name] = value
    return values


def parse_names(text: str, option: str) -> list[str]:
    """``"a,b"`` as names; there must be one, and none twice."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names or len(set(names)) < len(names):
        raise InputDataError(
            f"{option} is {text!r}; name at least one, each once, separated by commas."
        )
    return names


def parse_pair(
    text: str, option: str, form: str = "VALUE:VALUE, for example 0.2:0.1"
) -> tuple[float, float]:
    """``"0.2:0.1"`` as two numbers."""
    try:
        first, second = (float(x) for x in text.split(":"))
        if not (math.isfinite(first) and math.isfinite(second)):
            raise ValueError("not finite")
    except ValueError:
        raise InputDataError(f"{option}: {text!r} is not {form}.") from None
    return first, second


def parse_rest_radius(text: str, option: str) -> tuple[float, float]:
    """R_inf/Rmax and its standard deviation."""
    ratio, sd = parse_pair(text, option)
    if not (0.0 < ratio < 1.0 and sd >= 0.0):
        raise InputDataError(
            f"{option} is {text!r}; expected R_inf/Rmax between 0 and 1 and a standard deviation "
            ">= 0, for example 0.2:0.1."
        )
    return ratio, sd


_READ: dict[str, Callable[[str, str], Any]] = {
    "medium": Statement.from_text,
    "layout": lambda text, _: Layout.from_text(text),
    "driving": lambda path, _: load_driving(path),
    "rest_radius": parse_rest_radius,
    **dict.fromkeys(
        ("we_range", "rinf_range"),
        partial(parse_pair, form="LOW:HIGH, for example 0.15:0.25"),
    ),
    **dict.fromkeys(("known", "set"), parse_values),
    **dict.fromkeys(
        ("models", "experiments", "exclude", "effects", "without", "heldout"), parse_names
    ),
}


def header_of(args: Namespace) -> Document:
    """What the result of a command says of itself: schema, software, date, command, files, medium,
    physics, radial equation, liquid, seed.
    """
    given = vars(args)
    read = [*(given.get("files") or ()), *(given.get("tell") or ()), given.get("belief")]
    physics = given.get("physics")
    assumed = SIMULATORS[physics].conditions.surroundings if physics else None
    medium = given.get("gel_medium") or assumed
    command = shlex.join(["imr-torch", *args.argv])
    files = [path for path in read if path]
    motion = motion_of(args) if physics else None
    return header(args.command, files=files, medium=medium, command=command) | {
        "physics": physics,
        "radial": motion and motion.key,
        "liquid": motion and motion.liquid.key,
        "seed": given.get("seed"),
    }


def write_result(args: Namespace, document: Document) -> Document:
    """Write ``document`` with its header to ``--json`` and into ``--out``, where given; returns it.

    A number that is not finite is written as null, and its place is said: what was computed is not
    lost for it.
    """
    document, places = without_nonfinite(header_of(args) | document)
    if places:
        document["not_finite"] = places
    targets = [Path(args.json)] if args.json else []
    if getattr(args, "out", None):
        targets.append(Path(args.out) / f"{args.command}.json")
    for path in targets:
        write_json(path, document)
        print(f"wrote {path}")
    return document


def show_result(args: Namespace, document: Document, *, report: str = "") -> None:
    """Draw the figures of a result into ``--out`` and its page into ``--html``, where given.

    Args:
        args: the options.
        document: with its header, as :func:`write_result` returns it.
        report: what the page holds as text; the report of the document when not given.
    """
    if args.out:
        figures = draw_figures(document)
        for failure in save_figures(figures, Path(args.out), progress=args.terminal):
            print(f"imr-torch: {failure}", file=sys.stderr)
    if getattr(args, "html", None):
        kept = args.json or (args.out and f"{args.out}/{args.command}.json")
        write_page(
            document | ({"result_file": kept} if kept else {}), args.html, report=report
        )


def report_result(args: Namespace, document: Document) -> None:
    """Write a result, print its report, and show its figures and its page.

    It is written before any figure is drawn, so that nothing is lost.
    """
    document = write_result(args, document)
    print(document_report(document))
    show_result(args, document)
