"""How often the diagnosis of repeated shots is right: simulated sets with none, one or a withheld
effect.

  python -m benchmarks.gap.repeats run OUT.jsonl [--sets 67] [--physics transport]
      [--truths reference] [--seed 0] [--workers 2] [--parts]
  python -m benchmarks.gap.repeats labelled FOLDER OUT.jsonl [--workers 2]
  python -m benchmarks.gap.repeats table OUT.jsonl ...

`labelled` takes sets of a separate program (``*.npz`` beside ``labels.json``). With `--parts` shares
and intervals are judged too (:mod:`benchmarks.gap.shares`).
Rmax, time zero and R_inf of each experiment are uncertain. Probabilities are those at even prior
odds of an unknown effect, so sets with an effect of the library and sets whose effect was withheld
count evenly, whatever their numbers. Bins have equal numbers of sets; a bin is calibrated if what
was stated lies within two standard errors of what was found. A run goes on where it stopped.
"""

import argparse
import json
import math
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from benchmarks.gap.sets import (
    GEL,
    PHYSICS,
    TRUTHS,
    Task,
    draw_designs,
    film,
    make_plan,
    make_set,
)
from benchmarks.gap.shares import FURTHER, judge_parts, score_parts
from benchmarks.gap.verdicts import families, is_in_class, is_named, posterior_of, summarise
from benchmarks.records import (
    Figure,
    Line,
    add_out,
    read_record,
    run_missing_jobs,
    start_commands,
    write_figures,
)
from imr_torch.errors import ConvergenceWarning
from imr_torch.gap import diagnose
from imr_torch.observe import Experiment, load_set
from imr_torch.random import child, generator
from imr_torch.simulate import ACCURACIES, TransportSimulator

KINDS = ("none", "effect", "withheld")
BINS = 5
_STATED = 0.1  # chance of an unknown effect from which on a verdict says so
_SURE = 0.9


def diagnose_set(task: Task, *, parts: bool = False) -> Line:
    """Make a set, diagnose it and judge the diagnosis, with ``parts`` what stands beside it too."""
    warnings.simplefilter("ignore", ConvergenceWarning)  # certificates are in the line
    data = make_set(task)
    seed = child(task.seed, "diagnosis", task.key)
    report = diagnose(
        data.experiments, effects=data.offered, simulator=task.simulator(), seed=seed
    )
    line = {"truth": data.truth, "values": data.values, "signal": data.signal}
    line |= summarise(report)
    if parts:
        further = partial(film_further, task, data.values)
        truth = {name: data.values[name] for name in GEL}
        line["truth_names"] = data.truth
        line |= judge_parts(
            report, task.simulator(), further, truth, seed=child(seed, "parts")
        )
    return line


def film_further(task: Task, values: dict[str, float]) -> tuple[Experiment, ...]:
    """Shots of the same gel and effect at designs of their own."""
    source = generator(child(task.seed, "further", task.key))
    while True:
        plan = make_plan(draw_designs(FURTHER, source), task)
        shots = film(values, plan, task, source)
        if shots is not None:
            return shots


def diagnose_labelled_set(file: Path, effect: str) -> Line:
    """Diagnose a set of a separate program."""
    report = diagnose(
        load_set(file), simulator=TransportSimulator(accuracy=ACCURACIES["search"])
    )
    return {"truth": () if effect == "none" else (effect,)} | summarise(report)


def run_labelled(folder: Path, out: Path, workers: int) -> list[Line]:
    """Lines of all sets of a separate program."""
    labels = json.loads((folder / "labels.json").read_text())
    jobs = {
        name: partial(diagnose_labelled_set, folder / f"{name}.npz", label["effect"])
        for name, label in labels.items()
    }
    about = {
        name: {
            "kind": "none" if label["effect"] == "none" else "effect",
            "physics": "transport",
            "truths": "labelled",
        }
        for name, label in labels.items()
    }
    return run_missing_jobs(out, jobs, about=about, workers=workers)


def score_causes(lines: Sequence[Line]) -> list[Figure]:
    """All figures of a run."""
    known = [line for line in lines if line["kind"] == "effect"]
    found = [line for line in known if line.get("gap")]
    hidden = [line for line in lines if line["kind"] == "withheld" and line.get("gap")]
    named = [line for line in lines if is_named(line)]
    sizes = [float(len(set(line["cause"]) - set(line["selected"]))) for line in named]
    sure = [line for line in lines if line["kind"] != "none" and _top(line)[1] > _SURE]
    seconds = [line["seconds"] for line in lines if line.get("seconds") is not None]
    asked = [x for x in lines if x["kind"] != "none" and posterior_of(x)]
    alike = [x for x in hidden if (x.get("first") or {}).get("chance") is not None]
    alarms = [bool(line.get("gap")) for line in lines if line["kind"] == "none"]
    right = [is_in_class(line) for line in known if is_named(line)]
    wrong = [_top(line)[0] != families(line["truth"]) for line in sure]
    return [
        Figure.of_share("false alarm", alarms, (0.0, 0.05)),
        Figure.of_share(
            "an effect of the library is found", [bool(x.get("gap")) for x in known]
        ),
        Figure.of_share("one that is found is named", [is_named(x) for x in found]),
        Figure.of_share(
            "truth in the named class, effect of the library", right, (0.92, 1.0)
        ),
        Figure.of_mean("mean size of a class, where one is named", sizes, (1.0, 2.0)),
        Figure.of_share("names with a stated probability > .9, wrong", wrong, (0.0, 0.03)),
        Figure.of_share(
            'withheld and found: "other", or "or an unknown one" with probability > .1',
            [_says_unknown(line) for line in hidden],
            (0.90, 1.0),
        ),
        Figure.of_share(
            "withheld and found: a name and no word of an unknown effect",
            [is_named(line) and not _says_unknown(line) for line in hidden],
        ),
        *_calibrate(
            "withheld, where P(other) is stated as",
            [(posterior_of(x)["other"], x["kind"] == "withheld") for x in asked],
            [x["kind"] for x in asked],
        ),
        *_calibrate(
            "best known effect adequate, where the chance of a look-alike is stated as",
            [(x["first"]["chance"], x["first"]["adequate"]) for x in alike],
            [x["kind"] for x in alike],
        ),
        Figure.of_quantile("seconds of a diagnosis, median", seconds, 0.5, (0.0, 30.0)),
    ]


def _top(line: Line) -> tuple[frozenset[str], float]:
    """The most probable class of known effects, and its probability.

    0 where no cause was asked for.
    """
    total: Counter[frozenset[str]] = Counter()
    for name, probability in posterior_of(line).items():
        if name not in ("none", "other"):
            total[families(name.split("+"))] += probability
    return total.most_common(1)[0] if total else (frozenset(), 0.0)


def _says_unknown(line: Line) -> bool:
    if line["verdict"] == "other":
        return True
    return (line.get("members") or {}).get("other", 0.0) > _STATED


def _calibrate(
    name: str, stated: Sequence[tuple[float, bool]], kinds: Sequence[str]
) -> list[Figure]:
    """Stated probabilities against frequencies in bins of equal numbers; sets of each kind count
    evenly in all.
    """
    count = Counter(kinds)
    weighted = sorted(
        ((p, hit, 1.0 / count[kind]) for (p, hit), kind in zip(stated, kinds, strict=True)),
        key=lambda own: own[0],
    )
    figures = []
    for number in range(BINS):
        own = weighted[
            number * len(weighted) // BINS : (number + 1) * len(weighted) // BINS
        ]
        if not own:
            continue
        total = sum(w for *_, w in own)
        mean = sum(w * p for p, _, w in own) / total
        found = sum(w * hit for _, hit, w in own) / total
        # the variance is that of the stated probabilities, so that a bin of 0 or 1 has an error too
        error = math.sqrt(sum(w * w * max(p * (1.0 - p), 1e-4) for p, _, w in own)) / total
        head = f"{name} {mean:.3f} ({own[0][0]:.3f} to {own[-1][0]:.3f})"
        low, high = (
            min(1.0, max(0.0, found + sign * 1.645 * error)) for sign in (-1.0, 1.0)
        )
        must = (max(0.0, mean - 2.0 * error), min(1.0, mean + 2.0 * error))
        figures.append(Figure(head, found, len(own), low, high, must))
    return figures


def write_scores(lines: Sequence[Line]) -> str:
    """The figures in Markdown, a table for each physics and truth."""
    pages = []
    for physics, truths in sorted({(line["physics"], line["truths"]) for line in lines}):
        own = [x for x in lines if (x["physics"], x["truths"]) == (physics, truths)]
        failed = sum("error" in line for line in own)
        head = f"Physics {physics}, truths by {truths}: {len(own)} sets, {failed} failed."
        pages.append(f"{head}\n\n{write_figures([*score_causes(own), *score_parts(own)])}")
    return "\n\n".join(pages)


def add_task_arguments(parser: argparse.ArgumentParser) -> None:
    """What says which sets are made."""
    parser.add_argument("--sets", type=int, default=67, help="of each kind (default 67)")
    parser.add_argument("--physics", choices=PHYSICS, default="transport")
    parser.add_argument(
        "--truths", choices=TRUTHS, default=TRUTHS[0], help="how truths are solved"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of the first set; others count up"
    )


def run_tasks(
    args: argparse.Namespace, kinds: Sequence[str], work: Callable[[Task], Line]
) -> list[Line]:
    """Lines of the sets asked for, in an order in which a run that is stopped has as many of each
    kind.
    """
    tasks = [
        Task(kind, 3, 10, args.physics, seed, args.truths)
        for seed in range(args.seed, args.seed + args.sets)
        for kind in kinds
    ]
    names = ("kind", "size", "physics", "seed", "truths")
    about = {task.key: {name: getattr(task, name) for name in names} for task in tasks}
    jobs = {task.key: partial(work, task) for task in tasks}
    return run_missing_jobs(args.out, jobs, about=about, workers=args.workers)


def main() -> None:
    """Run or tabulate."""
    parser, commands, runs = start_commands(__doc__)
    add_task_arguments(runs)
    runs.add_argument("--parts", action="store_true", help="judge shares and intervals too")
    labelled = commands.add_parser("labelled", help="diagnose sets of a separate program")
    labelled.add_argument("folder", type=Path)
    add_out(labelled)
    args = parser.parse_args()
    if args.what == "table":
        lines = read_record(*args.files)
    elif args.what == "labelled":
        lines = run_labelled(args.folder, args.out, args.workers)
    else:
        lines = run_tasks(args, KINDS, partial(diagnose_set, parts=args.parts))
    print(write_scores(lines))


if __name__ == "__main__":
    main()
