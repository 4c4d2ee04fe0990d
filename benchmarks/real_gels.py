"""What the program says of measured gels: every set of a folder by one code, and the controls that
the answers must pass.

  python benchmarks/real_gels.py run FOLDER --json real_gels.jsonl
  python benchmarks/real_gels.py table --json real_gels.jsonl --page real_gels.md

FOLDER holds a CSV file a gel and a JSON file beside it. `run` appends a line a set and task, and
passes over what has a line. Of each set at most `--max-curves` are taken (default 4), evenly spread
over those that can be fitted and whose tail does not grow again. Curves that figures show go into a
file of their own beside the record. The medium is stated (`SETS`); models with heat and vapour
transport. Tasks:

- `characterize`: Newtonian, NHKV and generalised QKV.
- `diagnose`: additions selected stepwise on every second curve, at most four, judged on the other
  curves, which no fit saw. Two curves have two halves of one, one curve has none and its additions
  are judged in sample.
- `other half`: the first addition of those other curves.
- `halves`: the first addition of either half of all curves, of 20 at most.

`table` writes one page, with the controls (`real_gels_controls.py`) and a figure a set
(`real_gels_page.py`).
"""

import argparse
import json
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from real_data import REST, chosen_files, some

from imr_torch import characterize, load_traces
from imr_torch.assimilate import SearchOptions
from imr_torch.characterization import medium_of
from imr_torch.errors import ImrError
from imr_torch.gap import GapReport, diagnose, library
from imr_torch.gap.attribute import Inquiry
from imr_torch.gap.document import differing_document, selection_document
from imr_torch.gap.parts import closed_by
from imr_torch.gap.stepwise import select_stepwise
from imr_torch.material import Effect, ModelBelief, wide_prior
from imr_torch.observe import (
    Experiment,
    ExperimentBatch,
    GelMedium,
    TraceSet,
    find_landmarks,
    prepare,
)
from imr_torch.random import child
from imr_torch.simulate import ACCURACIES, Simulator, TransportSimulator

SETS: dict[str, str] = {
    "gel03_histotripsy": "agarose_0.5,density=1002:5",
    "gel03_laser": "agarose_0.5,density=1002:5",
    "gel25_histotripsy": "agarose_5,density=1024:10",
    "gel25_laser": "agarose_5,density=1024:10",
    "water_histotripsy": "water",
    "water_laser": "water",
    "pa_stiff_estrada": "polyacrylamide_10",
    "pa_soft_A_E2_002": "polyacrylamide",
    "pa_estrada_PA1": "polyacrylamide",
    "pegda_s5": "density=1064:21",
    "pegda_s1": "density=1064:21",
    "pegda_s3": "density=1064:21",
    "gelatin_10pct": "gelatin_10",
    "peg8k_80pct_liquid": "peg8k_80",
    "peg8k_20pct_liquid": "peg8k_20",
    "agarose_5pct": "agarose_5",
    "pegda_s2": "density=1064:21",
    "pegda_s4": "density=1064:21",
    "peg8k_60pct_liquid": "peg8k_60",
    "peg8k_40pct_liquid": "peg8k_40",
    "agarose_0p5pct": "agarose_0.5",
}
"""Set -> stated medium, in the order in which they run. PEGDA: 1064 kg/m^3 is the default of the sources' scripts, not a
measured value; gel03 and gel25 are agarose of .3 and 2.5 % by inference, and lie between the two that are stated."""

TASKS = ("characterize", "diagnose", "other half", "halves")
BASE = "nhkv"
MOST = 4
SEED = 0
HALVED = 20  # curves that are divided into halves, at most
_DROP_BEHIND = 50.0  # nats by which a model must be behind to be left there


def traces_of(file: Path, most: int) -> tuple[TraceSet, tuple[float, float] | None]:
    """The curves that are used, and the R_inf/Rmax that is assumed where one of them holds none."""
    about = json.loads(file.with_suffix(".json").read_text(encoding="utf-8"))
    grows = {row["experiment_id"] for row in about["experiments"] if row.get("late_regrowth")}
    traces = load_traces(file)
    names = [trace.experiment_id for trace in traces if trace.experiment_id not in grows]
    traces = some(traces.select(names), most)
    tail = all(find_landmarks(trace).rest_radius_m is not None for trace in traces)
    return traces, None if tail else REST


def characterized(file: Path, most: int, medium: str) -> dict[str, Any]:
    """Parameters, model probabilities and noise of one gel."""
    traces, rest = traces_of(file, most)
    result = characterize(
        traces,
        simulator=TransportSimulator(accuracy=ACCURACIES["search"], threads=1),
        options=SearchOptions(drop_behind=_DROP_BEHIND),
        medium=medium,
        rest_radius=rest,
        seed=SEED,
    )
    document = result.to_dict()
    for name in ("belief", "prior", "weighted_draws", "population"):
        document.pop(name)
    document["cautions"] = [text.replace(f"{file.parent}/", "") for text in document["cautions"]]
    return document | {"best": result.posterior.best.model, "rest_assumed": rest is not None}


@dataclass(frozen=True)
class Asked:
    """The curves of a set in their halves, with the medium stated: what a diagnosis is asked."""

    halves: tuple[Sequence[Experiment], Sequence[Experiment]]
    base: ModelBelief
    effects: tuple[Effect, ...]
    simulator: Simulator
    rest_assumed: bool

    @classmethod
    def of(cls, file: Path, most: int, medium: str) -> "Asked":
        """At most so many curves of a file."""
        traces, rest = traces_of(file, most)
        simulator = TransportSimulator(accuracy=ACCURACIES["search"], threads=1)
        stated = medium_of(traces, medium, simulator.conditions.surroundings)
        experiments = prepare(traces, stated.surroundings, rest_radius=rest).experiments
        base = stated.believed_of(wide_prior((BASE,)).models[0])
        return cls(
            (experiments[::2], experiments[1::2]),
            base,
            _effects(stated),
            stated.applied(simulator),
            rest is not None,
        )

    def diagnosis(self, half: int, most: int) -> GapReport:
        """Of one half."""
        fitted = self.halves[half]
        return diagnose(
            fitted,
            base=self.base,
            effects=self.effects,
            estimate_noise=True,
            simulator=self.simulator,
            most=min(most, 2),
            seed=_seed(half),
            progress=_progress,
        )


def _seed(half: int) -> int:
    return child(SEED, ("first", "other")[half])


def halved(file: Path, most: int, medium: str) -> dict[str, Any]:
    """What either half of all curves, ``most`` at most, adds first."""
    asked = Asked.of(file, most, medium)
    if min(map(len, asked.halves)) < 2:
        return {"skipped": "a half has fewer than two curves"}
    found = []
    for half in (0, 1):
        report = asked.diagnosis(half, 1)
        row = {
            "curves": [e.label for e in report.batch.experiments],
            "gap": report.found,
            "p_gap": report.gap.p_value,
        }
        row |= {"converged": report.converged, "ladder": None}
        if report.found:
            inquiry = Inquiry(report.null.prior, asked.effects, report.batch, asked.simulator)
            tested = {step.winner: step.left for step in report.steps if step.left}
            here = (inquiry, report.null, report.gap, report.fits)
            selection = select_stepwise(
                *here, tested=tested, most=1, seed=_seed(half), progress=_progress
            )
            row |= {"ladder": selection_document(selection), "unsettled": list(selection.unsettled)}
        found.append(row)
    return {"halves": found}


def diagnosed(file: Path, most: int, medium: str, *, other: bool) -> dict[str, Any]:
    """Verdict and selection of every second curve, judged on the others.

    Of the ``other`` half its first addition only.
    """
    asked = Asked.of(file, most, medium)
    fitted, unseen = asked.halves[::-1] if other else asked.halves
    if not fitted:
        return {"skipped": "one curve has no other half"}
    additions, half = (1, 1) if other else (MOST, 0)
    report = asked.diagnosis(half, additions)
    noise = report.batch.noise
    simulator = asked.simulator
    effects = asked.effects
    seed = _seed(half)
    row = {
        "curves": [e.label for e in fitted],
        "unseen": [e.label for e in unseen],
        "rest_assumed": asked.rest_assumed,
        "effects": [effect.name for effect in effects],
        "noise": vars(noise),
        "verdict": report.verdict,
        "cause": list(report.cause),
        "reason": report.reason,
        "p_gap": report.gap.p_value,
        "posterior": None if report.attribution is None else report.attribution.posterior,
        "seconds_diagnose": time.process_time() - _started[-1],
    }
    if not report.found:
        return row | {
            "converged": report.converged,
            "ladder": None,
            "shown": _shown(report.batch, {"none": report.null}),
        }
    selection = closed_by(report, simulator, unseen, most=additions, seed=seed, progress=_progress)[
        0
    ]
    fits = {step.name: step.fit for step in (selection.steps[0], selection.steps[-1])}
    said = {
        "converged": report.converged,
        "ladder": selection_document(selection),
        "sentence": str(selection),
    }
    said |= {"differing": differing_document(selection)}
    return row | said | {"shown": _shown(report.batch, fits)}


def _effects(medium: GelMedium) -> tuple[Any, ...]:
    """The library less what is inferred with the medium."""
    return tuple(
        effect for effect in library(base=BASE) if not set(effect.names) & set(medium.priors)
    )


def _shown(batch: ExperimentBatch, fits: dict[str, Any]) -> list[dict[str, Any]]:
    """Curves, their noise under the base model, and predictions, for figures and residuals."""
    sd = batch.sd(next(iter(fits.values())).prediction)
    base = []
    for e, experiment in enumerate(batch.experiments):
        seen = batch.mask[e]
        values = {"t": batch.times[e], "R": batch.mean[e], "sd": sd[e]}
        values |= {name: fit.prediction[e] for name, fit in fits.items()}
        rounded = {name: [round(x, 5) for x in row[seen].tolist()] for name, row in values.items()}
        base.append(
            {"id": experiment.label, "We": experiment.design[0], "R_inf*": experiment.design[1]}
            | rounded
        )
    return base


_started = [0.0]


def _progress(text: str) -> None:
    if not text.startswith("assimilation"):
        print(f"  {time.process_time() - _started[-1]:6.1f} s  {text}", flush=True)


def run(args: argparse.Namespace) -> None:
    """Append what is missing to the record."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    path = Path(args.json)
    files = {f.stem: f for f in chosen_files(args.folder, None)}
    names = [
        name
        for name in SETS
        if name in files and (args.sets is None or name.startswith(tuple(args.sets.split(","))))
    ]
    done = {(row["set"], row["task"]) for row in rows(path)}
    tasks: dict[str, Callable[[Path, int, str], dict[str, Any]]] = {
        "characterize": characterized,
        "diagnose": partial(diagnosed, other=False),
        "other half": partial(diagnosed, other=True),
        "halves": lambda file, _, medium: halved(file, HALVED, medium),
    }
    with path.open("a", encoding="utf-8") as stream:
        for name, task in ((name, task) for name in names for task in args.tasks.split(",")):
            if (name, task) in done:
                continue
            print(f"{name}: {task}", flush=True)
            _started.append(time.process_time())
            row: dict[str, Any] = {
                "set": name,
                "task": task,
                "stated": SETS[name],
                "max_curves": args.max_curves,
            }
            try:
                row |= tasks[task](files[name], args.max_curves, SETS[name])
            except (
                ImrError,
                RuntimeError,
            ) as error:  # torch reports a singular matrix as the latter
                row["failure"] = f"{type(error).__name__}: {error}".replace(
                    f"{files[name].parent}/", ""
                )
            row["cpu"] = time.process_time() - _started[-1]
            if shown := row.pop("shown", None):
                with curves_file(path).open("a", encoding="utf-8") as drawn:
                    drawn.write(json.dumps({"set": name, "task": task, "shown": shown}) + "\n")
            stream.write(json.dumps(row) + "\n")
            stream.flush()
            print(
                f"  done in {row['cpu']:.1f} s{': ' + row['failure'] if 'failure' in row else ''}",
                flush=True,
            )


def rows(path: Path) -> list[dict[str, Any]]:
    """The lines of a record; none where there is no file."""
    return (
        [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        if path.exists()
        else []
    )


def curves_file(record: Path) -> Path:
    """Beside a record: the measured curves and predictions that figures show; most data may not be
    passed on with results.
    """
    return record.with_suffix(".curves.jsonl")


def table(args: argparse.Namespace) -> None:
    """Write the page."""
    from real_gels_page import write_page

    record = Path(args.json)
    curves = {
        row["set"]: row["shown"] for row in rows(curves_file(record)) if row["task"] == "diagnose"
    }
    write_page(rows(record), curves, Path(args.page))
    print(f"wrote {args.page}")


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    work = commands.add_parser("run")
    work.add_argument("folder", type=Path)
    work.add_argument(
        "--sets", help="only sets whose names begin with one of these, comma-separated"
    )
    work.add_argument("--tasks", default=",".join(TASKS), help="comma-separated")
    work.add_argument("--max-curves", type=int, default=4, help="most curves of a set; 0 for all")
    work.set_defaults(function=run)
    show = commands.add_parser("table")
    show.add_argument(
        "--page", default="real_gels.md", help="figures go into a folder of that name beside it"
    )
    show.set_defaults(function=table)
    for command in (work, show):
        command.add_argument(
            "--json", default="real_gels.jsonl", help="the record, one JSON line a set and task"
        )
    args = parser.parse_args()
    args.function(args)


if __name__ == "__main__":
    main()
