"""Runs ``imr-torch characterize``; its help and options are in :mod:`imr_torch.cli.options.characterize`."""

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from imr_torch.assimilate import NOISE_ROUNDS
from imr_torch.characterization import characterize
from imr_torch.cli.common import (
    METHODS,
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
from imr_torch.cli.options.names import COLLAPSES
from imr_torch.cli.progress import characterize_stages
from imr_torch.errors import ConvergenceError, ImrError, InputDataError
from imr_torch.files import write_atomically
from imr_torch.html import write
from imr_torch.material import ModelBelief
from imr_torch.observe import TraceSet, load_traces, prepare
from imr_torch.population import SCALE
from imr_torch.results import characterization_document, characterization_page, draw_figures


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
    traces = load_traces(*args.files, layout=layout_of(args))
    if args.experiments is not None:
        traces = traces.select(names_of(args.experiments, "--experiments"))
    print(traces.report())
    if args.each:
        _each(traces, args)
        return
    document, report, converged = _characterize(traces, args)
    write_result(args, document)  # before any figure, so that nothing computed is lost if one fails
    _show(document, report, args, Path(args.out) if args.out else None)
    if not converged:
        raise ConvergenceError("a fit has not converged (see its certificate above), so its numbers are not to be used.")


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


def _characterize(traces: TraceSet, args: argparse.Namespace, label: str = "") -> tuple[dict[str, Any], str, bool]:
    """Fit some curves together and print the result: its document, the report, and whether all fits have converged."""
    simulator, rounds = simulator_of(args), NOISE_ROUNDS if args.noise == "estimated" else 0
    rest_radius = rest_radius_of(args)
    simulator, prior, medium = with_medium(args, simulator, prior_of(args), traces)
    prepared = prepare(traces, simulator.conditions.surroundings, collapses=args.collapses, rest_radius=rest_radius)
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
    report = "\n\n".join((traces.report(), prepared.report(frames=False), said)) + "\n"
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
