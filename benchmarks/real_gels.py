"""What the program says of measured gels: every set of a folder by one code, and the controls that
the answers must pass.

  python -m benchmarks.real_gels run FOLDER OUT.jsonl [--workers 2]
  python -m benchmarks.real_gels table OUT.jsonl PAGE.md

FOLDER holds a CSV file a gel and a JSON file beside it. `run` passes over what has a line in the
record. Of each set at most `--max-curves` are taken (default 8), evenly spread over those that can
be fitted and whose tail does not grow again. The medium is stated (`SETS`); models with heat and
vapour transport. Tasks:

- `characterize`: Newtonian, NHKV and generalised QKV.
- `diagnose`: every second curve, judged on all other curves of the set, which no fit saw, beside
  the placebo; for each of them also the root mean square of what is left, over .004 in R* and .15
  frames of jitter. Two curves have two halves of one, one curve has none.
- `other half`: the diagnosis of those other curves.

`table` writes one page and a figure a set: controls (`real_gels_controls.py`), and every set beside
independent values (`records/real_gels.toml`, which holds the stated media too).
"""

import json
import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.real_gels_controls import KNOWN
from benchmarks.real_gels_page import write_page
from benchmarks.records import Line, add_out, read_record, run_missing_jobs, start_parser
from imr_torch import characterize, load_traces
from imr_torch.assimilate import SearchOptions
from imr_torch.characterization import medium_of
from imr_torch.errors import ImrError, InputDataError, in_one_line
from imr_torch.gap import GapReport, diagnose, examine, library, to_json
from imr_torch.gap.held_out import judge_designs
from imr_torch.material import wide_prior
from imr_torch.observe import (
    Experiment,
    Noise,
    TraceSet,
    collapse_time,
    find_landmarks,
    prepare,
)
from imr_torch.random import child
from imr_torch.simulate import ACCURACIES, Simulator, TransportSimulator
from imr_torch.units import Surroundings

SETS: dict[str, str] = {name: own["medium"] for name, own in KNOWN["sets"].items()}
"""Set -> stated medium, in the order of the page."""

BASE = "nhkv"
SEED = 0
REST = (0.2, 0.08)  # assumed R_inf/Rmax of a record without a tail
SEARCH = TransportSimulator(accuracy=ACCURACIES["search"], threads=1)
JUDGING = Noise(scale=0.004, slope=0.0, drift=0.0, floor=1.0, jitter=0.15 / 0.004)
_DROP_BEHIND = 50.0  # nats by which a model must be behind to be left there


def read_curves(file: Path, most: int) -> tuple[TraceSet, tuple[float, float] | None]:
    """The curves that are used, and the R_inf/Rmax that is assumed where one of them holds none."""
    about = json.loads(file.with_suffix(".json").read_text(encoding="utf-8"))
    grows = {
        row["experiment_id"] for row in about["experiments"] if row.get("late_regrowth")
    }
    traces = load_traces(file)
    names = [trace.experiment_id for trace in traces if trace.experiment_id not in grows]
    able = [name for name in names if _is_long_enough(traces.select([name]))] or names
    if 0 < most < len(able):
        able = [able[(2 * i + 1) * len(able) // (2 * most)] for i in range(most)]
    traces = traces.select(able)
    tail = all(find_landmarks(trace).rest_radius_m is not None for trace in traces)
    return traces, None if tail else REST


def _is_long_enough(trace: TraceSet) -> bool:
    try:
        prepare(trace, rest_radius=REST)
    except InputDataError:
        return False
    return True


def characterize_set(file: Path, most: int, medium: str) -> Line:
    """Parameters, model probabilities and noise of one gel."""
    traces, rest = read_curves(file, most)
    result = characterize(
        traces,
        simulator=SEARCH,
        options=SearchOptions(drop_behind=_DROP_BEHIND),
        medium=medium,
        rest_radius=rest,
        seed=SEED,
    )
    document = result.to_dict()
    for name in ("belief", "prior", "weighted_draws", "population"):
        document.pop(name)
    document["cautions"] = [
        text.replace(f"{file.parent}/", "") for text in document["cautions"]
    ]
    return document | {
        "best": result.posterior.best.model,
        "rest_assumed": rest is not None,
    }


def diagnose_set(file: Path, most: int, medium: str, *, other: bool) -> Line:
    """The diagnosis of every second curve, judged on all others of the set; of the ``other`` half
    unjudged.
    """
    traces, rest = read_curves(file, most)
    stated = medium_of(traces, medium, SEARCH.conditions.surroundings)
    experiments = prepare(traces, stated.surroundings, rest_radius=rest).experiments
    fitted = experiments[int(other) :: 2]
    if not fitted:
        return {"skipped": "one curve has no other half"}
    unseen = further_curves(file, fitted, stated.surroundings, rest)
    simulator = stated.applied(SEARCH)
    effects = [e for e in library(base=BASE) if not set(e.names) & set(stated.priors)]
    seed = child(SEED, "other" if other else "first")
    report = diagnose(
        fitted,
        base=stated.believed_of(wide_prior((BASE,)).models[0]),
        effects=effects,
        estimate_noise=True,
        simulator=simulator,
        seed=seed,
    )
    parts = None if other else examine(report, simulator, unseen=unseen, seed=seed)
    document = to_json(report, parts)
    about: Line = {"curves": [e.label for e in fitted], "unseen": [e.label for e in unseen]}
    about["strengths"] = strengths_of(report)
    if parts is not None and parts.shrinkage is not None:
        about |= left_on(unseen, report, simulator, seed)
    return (
        about | {name: document[name] for name in KEPT} | {"rest_assumed": rest is not None}
    )


def strengths_of(report: GapReport) -> dict[str, float]:
    """Of each selected effect its amplitude, as a normal score of its prior."""
    fit = report.selected_fit
    values = dict(zip(fit.prior.names, fit.prior.physical(fit.mean), strict=True))
    amplitudes = ((effect.names[0], effect) for effect in report.selected.effects)
    return {
        e.name: float(e.priors[name].to_control(values[name])) for name, e in amplitudes
    }


def further_curves(
    file: Path,
    fitted: Sequence[Experiment],
    surroundings: Surroundings,
    rest: tuple[float, float] | None,
) -> tuple[Experiment, ...]:
    """All curves of a set that can be fitted and were not, read as those were."""
    traces, _ = read_curves(file, 0)
    seen = {experiment.label for experiment in fitted}
    names = [
        trace.experiment_id
        for trace in traces
        if trace.experiment_id not in seen
        and (rest is not None or find_landmarks(trace).rest_radius_m is not None)
    ]
    if not names:
        return ()
    return prepare(traces.select(names), surroundings, rest_radius=rest).experiments


def left_on(
    unseen: Sequence[Experiment], report: GapReport, simulator: Simulator, seed: int
) -> dict[str, dict[str, list[float]]]:
    """Root mean square of what each unseen curve leaves, standardised, without what was selected
    and with it: of all frames, and without those next to the first collapse. A curve's own Rmax,
    time zero and R_inf are fitted by the same noise.
    """
    batch = replace(report.batch, experiments=tuple(unseen), noise=JUDGING, noise_laws=None)
    every: dict[str, list[float]] = {"base": [], "selected": []}
    away: dict[str, list[float]] = {"base": [], "selected": []}
    for pair in judge_designs(report, simulator, batch, seed=seed):
        for name, one in (("base", pair.base), ("selected", pair.effect)):
            (shot,) = one.line.batch.curves
            square = standardise(shot, one.line.prediction[0, : len(shot.times)]).square()
            every[name].append(float(square.mean().sqrt()))
            away[name].append(float(square[away_from_first_collapse(shot)].mean().sqrt()))
    return {"left": every, "left_away": away}


def away_from_first_collapse(shot: Experiment) -> Tensor:
    """Frames but those from 1.3 R_inf on the way into the first collapse to .95 R_inf on the way
    out, which the study outside the package left out of gels.
    """
    rest = shot.mean / shot.design[1]
    first = collapse_time(shot.times, shot.mean, 1)
    begin = shot.times[(shot.times < first) & (rest > 1.3)].amax()
    end = shot.times[(shot.times > first) & (rest > 0.95)]
    return (shot.times <= begin) | (shot.times >= (end.amin() if len(end) else math.inf))


def standardise(shot: Experiment, seen: Tensor) -> Tensor:
    """Measured less predicted, over .004 and .15 frames of jitter."""
    speed = torch.gradient(seen, spacing=(shot.times,))[0]
    jitter = 0.15 * float(shot.times.diff().median()) * speed
    return (shot.mean - seen) / torch.hypot(torch.full_like(seen, 0.004), jitter)


KEPT = (
    "gap",
    "p_gap",
    "verdict",
    "cause",
    "headline",
    "reason",
    "members",
    "posterior",
    "selected",
    "adequacy_p",
    "shrinkage",
    "parameters",
    "parameters_with_model_error",
    "gels",
    "noise",
    "converged",
)
"""Of the document of a diagnosis, what a line holds."""


TASKS: dict[str, Callable[[Path, int, str], Line]] = {
    "characterize": characterize_set,
    "diagnose": partial(diagnose_set, other=False),
    "other half": partial(diagnose_set, other=True),
}


def run_task(file: Path, task: str, most: int) -> Line:
    """The line of a set and a task, with its CPU time; paths are left out of what went wrong."""
    warnings.simplefilter("ignore")
    started = time.process_time()
    name = file.stem
    line: Line = {"set": name, "task": task, "stated": SETS[name], "max_curves": most}
    try:
        line |= TASKS[task](file, most, SETS[name])
    except (
        ImrError,
        RuntimeError,
    ) as error:  # torch reports a singular matrix as the latter
        line["error"] = in_one_line(error).replace(f"{file.parent}/", "")
    return line | {"cpu": time.process_time() - started}


def main() -> None:
    """Parse and run."""
    parser = start_parser(__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    work = commands.add_parser("run")
    work.add_argument("folder", type=Path)
    add_out(work)
    work.add_argument(
        "--sets", default="", help="only names that begin so, comma-separated"
    )
    work.add_argument("--tasks", default=",".join(TASKS), help="comma-separated")
    work.add_argument(
        "--max-curves", type=int, default=8, help="most curves of a set; 0 for all"
    )
    show = commands.add_parser("table")
    show.add_argument("out", type=Path, metavar="OUT.jsonl")
    show.add_argument("page", type=Path, metavar="PAGE.md")
    show.add_argument("--figures", type=Path, default=Path("docs/_static/measured"))
    args = parser.parse_args()
    if args.command == "table":
        write_page(read_record(args.out), args.page, args.figures)
        return
    jobs = {
        f"{name}/{task}": partial(
            run_task, args.folder / f"{name}.csv", task, args.max_curves
        )
        for name in SETS
        for task in args.tasks.split(",")
        if name.startswith(tuple(args.sets.split(",")))
    }
    run_missing_jobs(args.out, jobs, workers=args.workers)


if __name__ == "__main__":
    main()
