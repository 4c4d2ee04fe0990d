"""Infer a gel's properties from measured R(t): intervals, model probabilities, and figures of the fit.

  imr-torch characterize gel.csv --out result
  imr-torch characterize day1/ "day2/*.csv"
  imr-torch characterize day1/ --population --html day1.html
  imr-torch characterize gel.csv --layout "radius=R,radius_unit=um,time=t,time_unit=us"
  imr-torch characterize wide.csv --layout "radius=*,radius_unit=um,time=t,time_unit=us"
  imr-torch characterize bubble.mat --layout "radius=Rnew,radius_unit=px,pixel_size=deltax,frame_interval=deltat"

Files are tables (text or .xlsx) with the columns experiment_id, time_s, radius_m, or with units in the header ("time (us)",
"R [um]"), MATLAB files, or .npz. What their names do not say, --layout says; units are never guessed. In a wide table
every column of radii is a curve. A JSON file of the same name beside a file may give R_inf, Rmax, their sd, medium, frame
rate, pixel size and exposure. A table with the columns experiment_id, rmax_m, stretch, collapse_time_s holds shots of which no
more is known (errors: collapse_time_sd_s, 20 ns if not given, rmax_sd_m, stretch_sd), alone or beside curves of the same gel.
--medium states density, sound speed, surface tension, temperature and ambient pressure of the gel (--medium
water,temperature=310,density=1125:11: with a standard deviation it is inferred beside the gel); the report says what was
assumed and whether that matters. All curves are taken to be of one gel and are fitted together; --each fits every curve by
itself, which shows whether they agree, and --population says how much the gel differs between them, by evidence. The report
says whether the model explains the curves, which rows were left out, which frames were fitted, and why.
"""

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from imr_torch.assimilate import NOISE_ROUNDS
from imr_torch.characterize import EFFORTS, FRAMES, characterize
from imr_torch.cli.common import (
    COLLAPSES,
    METHODS,
    add_medium_argument,
    add_physics_argument,
    add_prior_arguments,
    add_window_arguments,
    header_of,
    layout_of,
    names_of,
    prior_of,
    progress_of,
    rest_radius_of,
    simulator_of,
    statement_of,
    with_medium,
    write_result,
)
from imr_torch.cli.figures import save_figures, subfolder
from imr_torch.cli.progress import characterize_stages
from imr_torch.errors import ConvergenceError, ImrError, InputDataError
from imr_torch.files import write_atomically
from imr_torch.html import write
from imr_torch.material import ModelBelief
from imr_torch.observe import CollapseShot, TraceSet, find_files, load_collapse_times, load_traces, prepare
from imr_torch.observe.collapse import is_collapse_file
from imr_torch.population import SCALE
from imr_torch.results import characterization_document, characterization_page, draw_figures

NAME = "characterize"
SUMMARY = "properties of a gel from measured R(t) files"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="files (CSV, text, .xlsx, MATLAB, .npz), folders or patterns")
    parser.add_argument("--layout", metavar="TEXT", help="how to read the files: name=value pairs, see above")
    parser.add_argument("--experiments", metavar="ID,...", help="fit only these experiments")
    parser.add_argument("--each", action="store_true", help="fit every curve by itself instead of all together")
    parser.add_argument(
        "--population",
        action="store_true",
        help="also fit every curve by itself and infer how much the gel differs from shot to shot: median, scatter, evidence",
    )
    parser.add_argument(
        "--scatter-scale",
        type=float,
        metavar="SD",
        help=f"scale of the half-normal prior of the scatters of ln G, ln mu, ... (default {SCALE:g})",
    )
    add_window_arguments(parser)
    parser.add_argument(
        "--scores",
        action="store_true",
        help="also hold curves out and score how well each model predicts them from the others",
    )
    parser.add_argument(
        "--method",
        choices=tuple(METHODS),
        default="map",
        help="the most probable gel by multistart Gauss-Newton (default), or hybrid ensemble 4D-Var, with the data's own "
        "likelihood or with the tempered one of arXiv 2409.00011; draws are weighed by the posterior after either",
    )
    parser.add_argument(
        "--effort",
        choices=tuple(EFFORTS),
        default="normal",
        help="how far draws are weighed where they do not settle the intervals of a model (default normal)",
    )
    parser.add_argument(
        "--frames",
        choices=FRAMES,
        default="all",
        help="single bad frames are named; `robust` leaves them out of the fit too (default all)",
    )
    parser.add_argument("--out", metavar="DIR", help="folder for figures, report and JSON")
    parser.add_argument("--html", metavar="FILE", help="write the result with its figures as one HTML file")
    add_medium_argument(parser)
    add_physics_argument(parser)
    add_prior_arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Load, infer, report."""
    if args.each and args.scores:
        raise InputDataError("--scores predicts curves from others, and --each fits every one alone; leave one of them out.")
    if args.each and args.html:
        raise InputDataError("--html shows one gel, and --each fits every curve by itself; leave one of them out.")
    if args.each and args.population:
        raise InputDataError("--population takes the curves as shots of one gel, and --each every one alone; leave one out.")
    if args.scatter_scale is not None and not args.population:
        raise InputDataError("--scatter-scale is about --population; add that, or leave it out.")
    statement_of(args)  # checked before any work
    traces, shots = _load(args)
    if len(traces):
        print(traces.report())
    if shots:
        print(
            f"{len(shots)} shot(s) of which the collapse time alone is known, from {', '.join({s.source: 0 for s in shots})}."
        )
    if args.each:
        _each(traces, args)
        return
    document, report, converged = _characterize(traces, args, shots=shots)
    write_result(args, document)  # before any figure, so that nothing computed is lost if one fails
    _show(document, report, args, Path(args.out) if args.out else None)
    if not converged:
        raise ConvergenceError("a fit has not converged (see its certificate above), so its numbers are not to be used.")


def _load(args: argparse.Namespace) -> tuple[TraceSet, tuple[CollapseShot, ...]]:
    """Curves and shots of collapse times in the files that are named, those of ``--experiments`` if it is given."""
    files = find_files(*args.files)
    tables = [path for path in files if is_collapse_file(path)]
    curves, shots = [path for path in files if path not in tables], load_collapse_times(*tables) if tables else ()
    for option in ("each", "scores", "population") if shots else ():
        if getattr(args, option):
            raise InputDataError(f"--{option} is about curves, and {tables[0]} holds collapse times; leave one of them out.")
    traces = load_traces(*curves, layout=layout_of(args)) if curves else TraceSet(())
    double = {trace.experiment_id for trace in traces} & {shot.experiment_id for shot in shots}
    if double:
        raise InputDataError(f"{tables[0]}: experiment_id '{min(double)}' is also that of a curve; give the shots other names.")
    if args.experiments is None:
        return traces, shots
    wanted, known = names_of(args.experiments, "--experiments"), {shot.experiment_id for shot in shots}
    of_curves = [name for name in wanted if name not in known]
    chosen = traces.select(of_curves) if of_curves else TraceSet(())
    return chosen, tuple(shot for shot in shots if shot.experiment_id in wanted)


def _each(traces: TraceSet, args: argparse.Namespace) -> None:
    """Fit every curve by itself; one that cannot be fitted is reported, and the others are kept, also on an interruption."""
    results: dict[str, Any] = {}
    wrong: dict[str, ImrError] = {}
    try:
        for number, trace in enumerate(traces, start=1):
            print(f"\n--- {trace.experiment_id}")
            one, label = traces.select([trace.experiment_id]), f"curve {number} of {len(traces)}"
            try:
                document, report, converged = _characterize(one, args, label)
            except ImrError as error:
                print(f"imr-torch: {error}", file=sys.stderr)
                wrong[trace.experiment_id], results[trace.experiment_id] = error, {"error": str(error)}
                continue
            results[trace.experiment_id] = document
            if not converged:
                wrong[trace.experiment_id] = ConvergenceError("a fit has not converged.")
            _show(document, report, args, Path(args.out) / subfolder(trace.experiment_id) if args.out else None)
    finally:
        write_result(args, {"each": results})
    if wrong:
        kind = InputDataError if any(isinstance(x, InputDataError) for x in wrong.values()) else ConvergenceError
        raise kind(
            f"{len(wrong)} of {len(traces)} curves have no result to be used: {', '.join(wrong)}; the others are written."
        )


def _characterize(
    traces: TraceSet, args: argparse.Namespace, label: str = "", shots: tuple[CollapseShot, ...] = ()
) -> tuple[dict[str, Any], str, bool]:
    """Fit some curves together and print the result: its document, the report, and whether all fits have converged."""
    simulator, rounds = simulator_of(args), NOISE_ROUNDS if args.noise == "estimated" else 0
    rest_radius = rest_radius_of(args)
    simulator, prior, medium = with_medium(args, simulator, prior_of(args), traces, shots)
    prepared = prepare(traces, simulator.conditions.surroundings, collapses=args.collapses, rest_radius=rest_radius)
    if len(traces):
        print(prepared.report(frames=False))
    result = characterize(
        traces,
        prior=prior,
        simulator=simulator,
        estimate_noise=args.noise == "estimated",
        collapses=args.collapses,
        rest_radius=rest_radius,
        options=METHODS[args.method],
        scores=args.scores,
        effort=args.effort,
        medium=medium,
        shots=shots,
        frames=args.frames,
        population=args.population,
        scatter_scale=SCALE if args.scatter_scale is None else args.scatter_scale,
        seed=args.seed,
        progress=progress_of(args, characterize_stages(rounds, scores=args.scores, population=args.population), label),
    )
    command = diagnose_command(args, result.posterior.best)
    said = result.report(command)
    print("\n" + said)
    document = characterization_document(result, traces, simulator, command=command, seed=args.seed)
    read = (traces.report(), prepared.report(frames=False)) if len(traces) else ()
    report = "\n\n".join((*read, said)) + "\n"
    return document, report, result.assimilation.converged


def _show(document: dict[str, Any], report: str, args: argparse.Namespace, folder: Path | None) -> None:
    """Write the report, the figures and the page of a result."""
    if folder:
        write_atomically(folder / "report.txt", lambda stream: stream.write(report.encode()))
        save_figures(draw_figures(document), folder)
    if args.html:
        print(f"wrote {write(characterization_page(header_of(args) | document, report=report), args.html)}")


def diagnose_command(args: argparse.Namespace, best: ModelBelief) -> str:
    """The command that looks for what the most probable model lacks, on the same curves."""
    parts = ["imr-torch", "diagnose", *args.files, "--base", best.material.key.split("+")[0]]
    if best.known:
        parts += ["--known", ",".join(f"{name}={value:g}" for name, value in best.known.items())]
    for option, value in (
        ("--layout", args.layout),
        ("--experiments", args.experiments),
        ("--rest-radius", args.rest_radius),
        ("--collapses", str(args.collapses) if args.collapses != COLLAPSES else None),
        ("--medium", args.medium),
        ("--physics", args.physics if args.physics != "transport" else None),
    ):
        if value:
            parts += [option, value]
    return shlex.join([*parts, "--html", "diagnosis.html"])
