"""Infer a gel's properties from measured R(t): intervals, model probabilities, and figures of the fit.

  imr-torch characterize gel.csv --out result
  imr-torch characterize day1/ "day2/*.csv"
  imr-torch characterize gel.csv --layout "radius=R,radius_unit=um,time=t,time_unit=us"
  imr-torch characterize wide.csv --layout "radius=*,radius_unit=um,time=t,time_unit=us"
  imr-torch characterize bubble.mat --layout "radius=Rnew,radius_unit=px,pixel_size=deltax,frame_interval=deltat"

Files are tables (text or .xlsx) with the columns experiment_id, time_s, radius_m, or with units in the header ("time (us)",
"R [um]"), MATLAB files, or .npz. What their names do not say, --layout says; units are never guessed. In a wide table
every column of radii is a curve. A JSON file of the same name beside a file may give R_inf, Rmax, their sd, medium, frame
rate, pixel size and exposure. All curves are taken to be of one gel and are fitted together; --each fits every curve by
itself, which shows whether they agree. A report says which rows were left out and why.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

from imr_torch.characterize import EFFORTS, Characterization, characterize, predictive_band
from imr_torch.cli.common import (
    METHODS,
    add_physics_argument,
    add_prior_arguments,
    file_name,
    names_of,
    parse_pair,
    prior_of,
    progress_of,
    save_figure,
    simulator_of,
    write_result,
)
from imr_torch.errors import ConvergenceError, ImrError, InputDataError
from imr_torch.material import Belief
from imr_torch.observe import Layout, TraceSet, load_traces, prepare
from imr_torch.plot import plot_experiment, plot_parameter, plot_probabilities
from imr_torch.simulate import Simulator

NAME = "characterize"
SUMMARY = "properties of a gel from measured R(t) files"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="files (CSV, text, .xlsx, MATLAB, .npz), folders or patterns")
    parser.add_argument("--layout", metavar="TEXT", help="how to read the files: name=value pairs, see above")
    parser.add_argument("--experiments", metavar="ID,...", help="fit only these experiments")
    parser.add_argument("--each", action="store_true", help="fit every curve by itself instead of all together")
    parser.add_argument("--collapses", type=int, default=2, help="collapses in the fitted window (default 2)")
    parser.add_argument("--rest-radius", metavar="VALUE:SD", help="assumed R_inf/Rmax, for records without a tail")
    parser.add_argument(
        "--noise",
        choices=("estimated", "published"),
        default="estimated",
        help="observation noise: estimated from the residuals (default), or the published law",
    )
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
    parser.add_argument("--out", metavar="DIR", help="folder for figures, report and JSON")
    add_physics_argument(parser)
    add_prior_arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Load, infer, report."""
    if args.each and args.scores:
        raise InputDataError("--scores predicts curves from others, and --each fits every one alone; leave one of them out.")
    traces = load_traces(*args.files, layout=Layout.from_text(args.layout) if args.layout else None)
    if args.experiments is not None:
        traces = traces.select(names_of(args.experiments, "--experiments"))
    print(traces.report())
    if args.each:
        _each(traces, args)
        return
    result = _characterize(traces, args, Path(args.out) if args.out else None)
    write_result(args, result.to_dict())
    if not result.assimilation.converged:
        raise ConvergenceError("a fit has not converged (see its certificate above), so its numbers are not to be used.")


def _each(traces: TraceSet, args: argparse.Namespace) -> None:
    """Fit every curve by itself; one that cannot be fitted is reported, and the others are kept, also on an interruption."""
    results: dict[str, Any] = {}
    wrong: dict[str, ImrError] = {}
    try:
        for trace in traces:
            print(f"\n--- {trace.experiment_id}")
            folder = Path(args.out) / file_name(trace.experiment_id) if args.out else None
            try:
                result = _characterize(traces.select([trace.experiment_id]), args, folder)
            except ImrError as error:
                print(f"imr-torch: {error}", file=sys.stderr)
                wrong[trace.experiment_id], results[trace.experiment_id] = error, {"error": str(error)}
                continue
            results[trace.experiment_id] = result.to_dict()
            if not result.assimilation.converged:
                wrong[trace.experiment_id] = ConvergenceError("a fit has not converged.")
    finally:
        write_result(args, {"each": results})
    if wrong:
        kind = InputDataError if any(isinstance(x, InputDataError) for x in wrong.values()) else ConvergenceError
        raise kind(
            f"{len(wrong)} of {len(traces)} curves have no result to be used: {', '.join(wrong)}; the others are written."
        )


def _characterize(traces: TraceSet, args: argparse.Namespace, folder: Path | None) -> Characterization:
    """Fit some curves together, print the result, draw its figures."""
    prior, simulator = prior_of(args), simulator_of(args)
    rest_radius = parse_pair(args.rest_radius, "--rest-radius")
    prepared = prepare(traces, simulator.conditions.surroundings, collapses=args.collapses, rest_radius=rest_radius)
    print(prepared.report())
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
        seed=args.seed,
        progress=progress_of(args),
    )
    print("\n" + result.report())
    if folder:
        _figures(result, prior, simulator, folder)
        (folder / "report.txt").write_text("\n\n".join((traces.report(), prepared.report(), result.report())) + "\n")
    return result


def _figures(result: Characterization, prior: Belief, simulator: Simulator, folder: Path) -> None:
    best = result.posterior.best
    band = predictive_band(result.assimilation, result.posterior, simulator, best.model)
    for e, experiment in enumerate(result.experiments):
        axes = plot_experiment(experiment, (band[0][e], band[1][e], band[2][e]))
        save_figure(axes, folder, f"curve_{file_name(experiment.label)}")
    for name in best.names:
        pair = (("prior", prior[best.model]), ("posterior", best))
        save_figure(plot_parameter(pair, name), folder, f"parameter_{name}")
    save_figure(plot_probabilities((("prior", prior), ("posterior", result.posterior))), folder, "models")
    print(f"wrote {len(result.experiments) + len(best.names) + 1} figures to {folder}")
