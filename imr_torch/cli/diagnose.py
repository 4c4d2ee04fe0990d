"""Runs ``imr-torch diagnose``."""

import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from imr_torch.characterization import medium_document, medium_of
from imr_torch.cli.common import refuse_options, report_result, simulator_of
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.gap import (
    Effect,
    compare_gels,
    diagnose,
    examine,
    library,
    load_set,
    medium_sensitivities,
    to_json,
)
from imr_torch.gap.document import laboratory_document
from imr_torch.gap.hypotheses import Inquiry
from imr_torch.material import material, wide_prior
from imr_torch.observe import (
    Experiment,
    ExperimentBatch,
    GelMedium,
    TraceSet,
    load_traces,
    prepare,
)
from imr_torch.progress import ProgressLine
from imr_torch.record import ALL_ALIKE, Record, RecordOptions, describe_record
from imr_torch.simulate import Simulator

_SET = ".npz"


def _read_files(args: Namespace) -> tuple[Inquiry, GelMedium, Record]:
    """Check everything that was asked for, and read the files of a gel."""
    simulator = simulator_of(args)
    effects = _choose_effects(args)
    base = wide_prior((args.base,), known=args.known).models[0]
    experiments, medium, traces = _load_experiments(args, simulator)
    if args.experiments is not None:
        experiments = _select_named(experiments, args.experiments, "--experiments")
    labels = [experiment.label for experiment in experiments]
    chosen = [trace for trace in traces if trace.experiment_id in labels]
    record = describe_record(
        chosen,
        medium.surroundings,
        options=ALL_ALIKE if args.count_all_shots else RecordOptions(),
    )
    batch = ExperimentBatch(tuple(record.weighted(experiments)))
    effects = _beside_medium(effects, medium, args)
    base = medium.believed_of(base)
    return Inquiry(base, batch, medium.applied(simulator), effects), medium, record


def _holds_sets(args: Namespace) -> bool:
    """Whether the files are sets, with known noise, and not curves."""
    sets = {name.lower().endswith(_SET) for name in args.files}
    if len(sets) > 1:
        raise InputDataError(
            "Sets (.npz) and files of curves cannot be mixed: their noise is known differently."
        )
    return sets.pop()


def _estimates_noise(args: Namespace) -> bool:
    return args.noise == "estimated" or not (args.noise or _holds_sets(args))


def _compare_files(args: Namespace) -> None:
    """Ask of gels, a file each, whether what they miss is common."""
    started = time.perf_counter()
    refuse_options(
        args,
        ("experiments", "heldout"),
        "has no effect beside --gels; leave one of them out.",
    )
    names = [Path(file).stem for file in args.files]
    if len(set(names)) < len(names):
        raise InputDataError(
            f"--gels takes each file as a gel, and got {', '.join(names)}; give two or more of "
            "different names."
        )
    args.command = args.terminal.command = "laboratory"
    terminal = args.terminal.plan_stages()
    _holds_sets(args)  # refuses a mixture before any file is read
    read = {
        name: _read_files(Namespace(**vars(args) | {"files": [file]}))
        for name, file in zip(names, args.files, strict=True)
    }
    common = set.intersection(*(set(gel.effects) for gel, _, _ in read.values()))
    gels = {
        name: replace(
            gel,
            effects=tuple(filter(common.__contains__, gel.effects)),
            progress=lambda text, name=name: terminal(ProgressLine(text, step=name)),
        )
        for name, (gel, _, _) in read.items()
    }
    found = compare_gels(gels, estimate_noise=_estimates_noise(args), seed=args.seed)
    media = {name: medium.report() for name, (_, medium, _) in read.items()}
    document = laboratory_document(media, found)
    report_result(args, document | {"seconds": time.perf_counter() - started})


def run_command(args: Namespace) -> None:
    """Check everything that was asked for, diagnose, report."""
    if args.gels:
        _compare_files(args)
        return
    started = time.perf_counter()
    inquiry, medium, record = _read_files(args)
    experiments, simulator = inquiry.batch.curves, inquiry.simulator
    held_out = (
        []
        if args.heldout is None
        else _select_named(experiments, args.heldout, "--heldout")
    )
    fitted = [e for e in experiments if e not in held_out]
    if not fitted:
        raise InputDataError(
            f"--heldout leaves none of the {len(experiments)} experiments to fit; hold out fewer."
        )
    estimate_noise = _estimates_noise(args)
    progress = args.terminal.plan_stages(noise=estimate_noise)
    report = diagnose(
        fitted,
        base=inquiry.base,
        effects=inquiry.effects,
        estimate_noise=estimate_noise,
        simulator=simulator,
        most=args.most,
        seed=args.seed,
        progress=progress,
    )
    parts = examine(report, simulator, unseen=held_out, seed=args.seed, progress=progress)
    fit, batch = report.quoted
    assumed = (
        medium_sensitivities(fit, batch, simulator, medium) if report.converged else ()
    )
    document = to_json(report, parts, simulator=simulator) | {"record": record.to_dict()}
    document |= medium_document(medium, assumed, fit.posterior)
    args.gel_medium = medium
    progress(ProgressLine("figures", stage="figures"))
    report_result(args, document | {"seconds": time.perf_counter() - started})
    if not report.converged:
        raise ConvergenceError(
            "a fit that the verdict rests on has not converged (see above)."
        )


def _choose_effects(args: Namespace) -> tuple[Effect, ...]:
    """The library less what was left out.

    An effect that was asked for by name must fit the base model.
    """
    try:
        material(args.base)
    except InputDataError as error:
        raise InputDataError(f"--base: {error}") from None
    chosen = library(args.effects, without=args.without or [], base=args.base)
    lost = set(args.effects or ()) - {effect.name for effect in chosen}
    if lost:
        raise InputDataError(
            f"--effects: {min(lost)!r} cannot be put on the base model {args.base!r}, which has it "
            "or lacks what it acts on."
        )
    if not chosen:
        raise InputDataError(
            "--without leaves no effect that could be the cause; leave fewer out."
        )
    return chosen


def _beside_medium(
    effects: tuple[Effect, ...], medium: GelMedium, args: Namespace
) -> tuple[Effect, ...]:
    """The effects less those whose parameter is inferred already, as a property of the medium with
    a standard deviation.
    """
    held = [effect.name for effect in effects if set(effect.names) & set(medium.priors)]
    if held and held[0] in (args.effects or []):
        raise InputDataError(
            f"--effects: {held[0]!r} is inferred already, since its value is stated with a "
            "standard deviation; leave one out."
        )
    return tuple(effect for effect in effects if effect.name not in held)


def _load_experiments(
    args: Namespace, simulator: Simulator
) -> tuple[list[Experiment], GelMedium, TraceSet]:
    """Sets or curves as experiments, their medium, and the records of curves; what was read and
    left out is printed.
    """
    assumed = simulator.conditions.surroundings
    if not _holds_sets(args):
        traces = load_traces(*args.files, layout=args.layout, sort=args.sort)
        print(traces.report() + "\n")
        medium = medium_of(traces, args.medium, assumed)
        prepared = prepare(
            traces,
            medium.surroundings,
            collapses=args.collapses,
            rest_radius=args.rest_radius,
        )
        print(prepared.report() + "\n")
        return list(prepared.experiments), medium, traces
    refuse_options(
        args,
        ("layout", "rest_radius", "collapses"),
        "is about files of curves, and has no effect on sets; leave it out.",
    )
    medium = medium_of(TraceSet(()), args.medium, assumed)
    loaded = {name: load_set(name, surroundings=medium.surroundings) for name in args.files}
    named = [
        replace(e, label=f"{Path(name).stem} {e.label}") if len(loaded) > 1 else e
        for name, experiments in loaded.items()
        for e in experiments
    ]
    return named, medium, TraceSet(())


def _select_named(
    experiments: Sequence[Experiment], chosen: Sequence[str], option: str
) -> list[Experiment]:
    """The experiments of given labels."""
    labels = [e.label for e in experiments]
    for name in chosen:
        if name not in labels:
            raise InputDataError(
                f"{option}: no experiment {name!r} among the {len(labels)} loaded: "
                f"{', '.join(labels)}."
            )
    return [e for e in experiments if e.label in chosen]
