"""Runs ``imr-torch characterize``."""

import shlex
from argparse import Namespace
from pathlib import Path

from imr_torch.characterization import characterize
from imr_torch.cli.common import (
    METHODS,
    prior_of,
    refuse_options,
    show_result,
    with_medium,
    write_result,
)
from imr_torch.cli.options import COLLAPSES
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.export import write_mat
from imr_torch.files import write_bytes
from imr_torch.material import Belief, ModelBelief
from imr_torch.observe import (
    CollapseShot,
    Prepared,
    TraceSet,
    find_files,
    load_collapse_times,
    load_traces,
)
from imr_torch.progress import ProgressLine
from imr_torch.reading.load import is_shot_file
from imr_torch.results import document_report


def run_command(args: Namespace) -> None:
    """Load, infer, report; of a curve that cannot be used it is said how to leave it out."""
    try:
        _characterize(args)
    except InputDataError as error:
        name = error.experiment
        if name is None or "," in name or name in (args.experiments or ()):
            raise
        raise InputDataError(
            f"{error} One of several curves can be left out: --exclude {name}"
        ) from None


def _characterize(args: Namespace) -> None:
    traces, shots = _load_data(args)
    read = [traces.report()] if len(traces) else []
    if shots:
        names = ", ".join({shot.source: 0 for shot in shots})
        read.append(
            f"{len(shots)} shot(s) of which the collapse time alone is known, from {names}."
        )
    print("\n".join(read))
    simulator, prior, medium = with_medium(args, prior_of(args), traces, shots)

    def show_prepared(prepared: Prepared) -> None:
        if len(traces):
            read.append(prepared.report(frames=False))
            print(read[-1])

    estimate_noise = args.noise == "estimated"
    drawn = bool(args.out or args.html)
    progress = args.terminal.plan_stages(
        noise=estimate_noise,
        curves=len(traces) > 0,
        population=args.population,
        figures=drawn,
    )
    result = characterize(
        traces,
        prior=prior,
        simulator=simulator,
        estimate_noise=estimate_noise,
        collapses=args.collapses,
        rest_radius=args.rest_radius,
        growth=args.growth,
        options=METHODS[args.method],
        effort=args.effort,
        medium=medium,
        shots=shots,
        weigh_odd_shots=not args.count_all_shots,
        population=args.population,
        over_time=args.over_time,
        seed=args.seed,
        on_prepared=show_prepared,
        progress=progress,
    )
    command = diagnose_command(args, choose_base(result.posterior))
    # before any figure, so that nothing is lost
    document = write_result(args, result.to_document(command, seed=args.seed))
    said = document_report(document)
    print("\n" + said)
    report = "\n\n".join((*read, said)) + "\n"
    if args.out:
        write_bytes(Path(args.out) / "report.txt", report.encode())
    if drawn:
        progress(ProgressLine("figures", stage="figures"))
    show_result(args, document, report=report)
    if args.mat:
        write_mat(document, args.mat)
        print(f"wrote {args.mat}")
    if not result.converged:
        raise ConvergenceError(
            "a fit has not converged (see its certificate above), so its numbers are not to be "
            "used."
        )


def _load_data(args: Namespace) -> tuple[TraceSet, tuple[CollapseShot, ...]]:
    """Curves and shots of collapse times in the files that are named, those of ``--experiments`` if
    it is given.
    """
    files = find_files(*args.files)
    tables = [path for path in files if is_shot_file(path)]
    curves = [path for path in files if path not in tables]
    shots = load_collapse_times(*tables) if tables else ()
    why = f"is about curves, and {tables[0]} holds collapse times" if shots else ""
    if shots:
        refuse_options(args, ["population"], f"{why}; leave one of them out.")
    if curves:
        exclude = args.exclude or ()
        traces = load_traces(*curves, layout=args.layout, sort=args.sort, exclude=exclude)
    else:
        about_curves = ("layout", "rest_radius", "collapses", "growth", "count_all_shots")
        refuse_options(args, about_curves, f"{why} alone; leave it out.")
        traces = TraceSet(())
    double = {trace.experiment_id for trace in traces} & {
        shot.experiment_id for shot in shots
    }
    if double:
        raise InputDataError(
            f"{tables[0]}: experiment_id '{min(double)}' is also that of a curve; give the shots "
            "other names."
        )
    if args.experiments is None and args.exclude is None:
        return traces, shots
    known = [shot.experiment_id for shot in shots]
    wanted = args.experiments or [*traces.ids, *known]
    if args.exclude:
        gone = [*known, *(x.experiment_id for x in traces.left_out)]
        # which must be there
        traces.select([name for name in args.exclude if name not in gone])
        wanted = [name for name in wanted if name not in args.exclude]
        args.given["experiments"] = ",".join(wanted)  # what a diagnosis is to take
    of_curves = [name for name in wanted if name not in known]
    chosen = traces.select(of_curves) if of_curves else TraceSet(())
    return chosen, tuple(shot for shot in shots if shot.experiment_id in wanted)


def choose_base(belief: Belief) -> ModelBelief:
    """The most probable model with elasticity, since a gel that no candidate explains is no liquid;
    of any where none has it.
    """
    elastic = [part for part in belief.models if "G" in part.material.names]
    return max(elastic or belief.models, key=lambda part: belief.probabilities[part.model])


def diagnose_command(args: Namespace, best: ModelBelief) -> str:
    """The command that looks for what a model lacks, on the same curves."""
    parts = ["imr-torch", "diagnose", *args.files, "--base", best.material.base]
    if best.known:
        parts += [
            "--known",
            ",".join(f"{name}={value:g}" for name, value in best.known.items()),
        ]
    usual = {"collapses": COLLAPSES, "physics": "transport", "radial": "keller_miksis"}
    for name in (
        "layout",
        "experiments",
        "rest_radius",
        "collapses",
        "medium",
        "driving",
        "physics",
        "radial",
        "liquid",
    ):
        value = args.given[name]
        if value and value != usual.get(name):
            parts += [f"--{name.replace('_', '-')}", f"{value}"]
    parts += ["--sort"] if args.sort else []
    for file in args.imports:
        parts += ["--import", file]
    return shlex.join([*parts, "--html", "diagnosis.html"])
