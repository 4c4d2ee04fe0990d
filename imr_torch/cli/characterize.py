"""Infer a gel's properties from measured R(t): intervals, model probabilities, and figures of the fit.

  imr-torch characterize gel.csv --out result
  imr-torch characterize bubble.mat --layout "radius=Rnew,radius_unit=px,pixel_size=deltax,frame_interval=deltat"

CSV files have the columns experiment_id, time_s, radius_m (a JSON file of the same name beside it may give R_inf);
MATLAB files of known layouts are recognised, others need --layout. All curves are taken to be of one gel and are fitted
together. A report says which rows were left out and why.
"""

import argparse
from pathlib import Path

from imr_torch.characterize import Characterization, characterize, predictive_band
from imr_torch.cli.common import add_prior_arguments, parse_pair, prior_of, progress_of, save_figure, write_result
from imr_torch.material import Belief
from imr_torch.observe import Layout, TraceSet, load_traces
from imr_torch.plot import plot_experiment, plot_parameter, plot_probabilities
from imr_torch.simulate import PolytropicSimulator, Simulator

NAME = "characterize"
SUMMARY = "properties of a gel from measured R(t) files"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="CSV, text or MATLAB files")
    parser.add_argument("--layout", metavar="TEXT", help="how to read the files: name=value pairs, see the tutorial 02")
    parser.add_argument("--experiments", metavar="ID,...", help="fit only these experiments")
    parser.add_argument("--collapses", type=int, default=2, help="collapses in the fitted window (default 2)")
    parser.add_argument("--rest-radius", metavar="VALUE:SD", help="assumed R_inf/Rmax, for records without a tail")
    parser.add_argument(
        "--noise",
        choices=("estimated", "published"),
        default="estimated",
        help="observation noise: scale and correlation time estimated from the residuals (default), or the published law",
    )
    parser.add_argument("--out", metavar="DIR", help="folder for figures, report and JSON")
    add_prior_arguments(parser)


def run(args: argparse.Namespace) -> None:
    """Load, infer, report."""
    traces = load_traces(*args.files, layout=Layout.from_text(args.layout) if args.layout else None)
    if args.experiments:
        traces = traces.select([name.strip() for name in args.experiments.split(",")])
    print(traces.report())
    prior, simulator = prior_of(args), PolytropicSimulator()
    result = characterize(
        traces,
        prior=prior,
        simulator=simulator,
        estimate_noise=args.noise == "estimated",
        collapses=args.collapses,
        rest_radius=parse_pair(args.rest_radius, "--rest-radius"),
        seed=args.seed,
        progress=progress_of(args),
    )
    print("\n" + result.report())
    if args.out:
        _figures(result, prior, simulator, Path(args.out))
        _write_report(traces, result, Path(args.out))
    write_result(args, result.to_dict())


def _figures(result: Characterization, prior: Belief, simulator: Simulator, folder: Path) -> None:
    best = result.posterior.best
    band = predictive_band(result.assimilation, result.posterior, simulator, best.model)
    for e, experiment in enumerate(result.experiments):
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in experiment.label)
        save_figure(plot_experiment(experiment, tuple(x[e] for x in band)), folder, f"curve_{name}")  # type: ignore[arg-type]
    for name in best.names:
        pair = (("prior", prior[best.model]), ("posterior", best))
        save_figure(plot_parameter(pair, name), folder, f"parameter_{name}")
    save_figure(plot_probabilities((("prior", prior), ("posterior", result.posterior))), folder, "models")
    print(f"wrote {len(result.experiments) + len(best.names) + 1} figures to {folder}")


def _write_report(traces: TraceSet, result: Characterization, folder: Path) -> None:
    (folder / "report.txt").write_text(traces.report() + "\n\n" + result.report() + "\n")
