"""Are differences between curves found where there are some, and not where there are none? Do
halves of a gel's curves agree?

  python benchmarks/differing_curves.py run --sets 120 --json differing_curves.jsonl
  python benchmarks/differing_curves.py halves --sets 90 --json differing_curves.jsonl
  python benchmarks/differing_curves.py table --json differing_curves.jsonl

`run` simulates shots of one curve each, three that are fitted and two that no fit sees, by the
polytropic simulator, at Weber numbers of 250 to 600 and R_inf* of .18 to .28 with uncertain Rmax,
time zero and R_inf. Each set has an effect of the library at a draw of its prior. A third of the
sets are of one gel with the effect in the library (`alike`), a third of one gel with the effect
withheld (`withheld`), and in a third G, mu and the strength of the effect scatter by 30 % between
shots (`differing`). The stepwise selection of up to four additions says whether curves differ, what
its steps close on the unseen curves, and whether an effect of the best one is unusually strong.
`halves` asks two of these shots, and two others, for their first addition, as measured gels are
asked. A line a set is appended, so a run that was cut off continues.
"""

import argparse
import json
import math
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.errors import ImrError
from imr_torch.gap import GapReport, diagnose, library
from imr_torch.gap.hypotheses import GEL_SCATTER, SCALE
from imr_torch.gap.parts import closed_by
from imr_torch.gap.strengths import unusual_strengths
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import Experiment, Noise, Nuisance, SimulatedLaboratory
from imr_torch.random import child, generator
from imr_torch.threads import one_torch_thread

KINDS = ("alike", "withheld", "differing")
GEL = {"G": 8e3, "mu": 0.09}
CAUSES = (
    "gas_loss",
    "sound_speed",
    "surface_tension",
    "strain_stiffening",
    "stress_relaxation",
    "edge_error",
    "pulse",
    "wall",
)
"""One of these acts in each set; the library of the diagnosis is whole, less the effect where it is withheld."""
FITTED = 3
UNSEEN = 2
UNCERTAIN = Nuisance(max_radius=0.005, time_zero=0.008, rest_radius=0.02)
NOISE = Noise(scale=0.5)
SIMULATOR = PolytropicSimulator(threads=1)


def shots_of(number: int, kind: str) -> tuple[str, dict[str, float], list[Experiment]]:
    """Cause, its parameters and the shots of a set.

    One whose bubbles cannot be simulated is drawn again.
    """
    source = generator(child(0, "set", number))
    effect = LIBRARY[CAUSES[int(torch.randint(len(CAUSES), (), generator=source))]]
    while True:
        controls = torch.randn(len(effect.names), generator=source, dtype=torch.float64)
        drawn = {
            name: float(prior.to_physical(z))
            for (name, prior), z in zip(effect.priors.items(), controls, strict=True)
        }
        shots = []
        for i in range(FITTED + UNSEEN):
            own = GEL | drawn
            if kind == "differing":
                factors = torch.exp(
                    SCALE * torch.randn(3, generator=source, dtype=torch.float64)
                ).tolist()
                own |= {
                    name: own[name] * f
                    for name, f in zip(("G", "mu", effect.names[0]), factors, strict=True)
                }
            design = torch.rand(2, generator=source, dtype=torch.float64) * torch.tensor(
                [350.0, 0.1]
            ) + torch.tensor([250.0, 0.18])
            try:
                laboratory = SimulatedLaboratory(
                    SIMULATOR, PARAMETERS.pack(own), repeats=1, noise=NOISE, nuisance=UNCERTAIN
                )
                shots.append(
                    laboratory.shoot(design, seed=child(0, "shot", number, i), label=f"shot {i}")
                )
            except ImrError:
                break
        else:
            return effect.name, drawn, shots


def diagnosed(
    shots: Sequence[Experiment], kind: str, cause: str, most: int, seed: int
) -> GapReport:
    """The diagnosis of some shots of a set."""
    effects = tuple(
        effect
        for effect in library(base="nhkv")
        if kind != "withheld" or effect.family != LIBRARY[cause].family
    )
    base = wide_prior(("nhkv",)).models[0]
    return diagnose(
        shots, base=base, effects=effects, noise=NOISE, simulator=SIMULATOR, seed=seed, most=most
    )


@one_torch_thread()
def halved(number: int) -> dict[str, Any]:
    """The line of two halves of a set: what each adds first, and what is not clearly worse; nothing
    where it has no gap.
    """
    kind = KINDS[number % len(KINDS)]
    begun = time.process_time()
    cause, values, shots = shots_of(number, kind)
    found = []
    for half in (shots[0:4:2], shots[1:4:2]):
        report = diagnosed(half, kind, cause, 1, number)
        steps = (
            closed_by(report, SIMULATOR, most=1, seed=number)[0].steps[1:2] if report.found else ()
        )
        found.append([name for step in steps for name in (step.added, *step.alternatives)])
    row = {"task": "halves", "number": number, "kind": kind, "cause": cause, "values": values}
    return row | {"first": found, "seconds": time.process_time() - begun}


@one_torch_thread()
def judged(number: int) -> dict[str, Any]:
    """The line of a set."""
    kind = KINDS[number % len(KINDS)]
    cause, values, shots = shots_of(number, kind)
    fitted = shots[:FITTED]
    unseen = shots[FITTED:]
    begun = time.process_time()
    report = diagnosed(fitted, kind, cause, 2, number)
    row = {"task": "run", "number": number, "kind": kind, "cause": cause, "values": values}
    row |= {"found": report.found, "verdict": report.verdict}
    if report.found:
        selection = closed_by(report, SIMULATOR, unseen, seed=number)[0]
        best = selection.best
        row |= {
            "steps": [list(step.effects) for step in selection.steps],
            "best": list(best.effects),
            "closed": best.closed,
            "unusual": unusual_strengths(best.fit, report.null.prior),
            "adequate": selection.steps[-1].adequate,
            "converged": all(step.converged for step in selection.judged),
        }
    return row | {"seconds": time.process_time() - begun}


def run(args: argparse.Namespace) -> None:
    """Append what is missing."""
    warnings.simplefilter("ignore")
    path = Path(args.json)
    of_set = judged if args.task == "run" else halved
    done = {row["number"] for row in rows(path, args.task)}
    with path.open("a", encoding="utf-8") as stream:
        for number in range(args.sets):
            if number not in done:
                row = of_set(number)
                stream.write(json.dumps(row) + "\n")
                stream.flush()
                said = row.get("first") or row.get("steps", [[]])[-1]
                print(
                    number, row["kind"], row["cause"], said, f"{row['seconds']:.0f} s", flush=True
                )


def rows(path: Path, task: str) -> list[dict[str, Any]]:
    """The lines of a task in a record; none where there is no file."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [row for row in map(json.loads, lines) if row["task"] == task]


def table(args: argparse.Namespace) -> None:
    """Shares by kind of set, with their standard errors."""
    print(
        "| sets | with a gap | said that curves differ | closed: median, 10th percentile | "
        "certified | unusually strong |"
    )
    print("|---|---|---|---|---|---|")
    for kind in KINDS:
        own = [row for row in rows(Path(args.json), "run") if row["kind"] == kind]
        gaps = [row for row in own if row["found"]]
        if not gaps:
            continue
        share = sum(any(GEL_SCATTER in step for step in row["steps"]) for row in gaps) / len(gaps)
        error = math.sqrt(max(share * (1.0 - share), 1.0 / len(gaps)) / len(gaps))
        closed = torch.tensor([row["closed"][1] if row["closed"] else 0.0 for row in gaps])
        sure, strong = (sum(bool(row[name]) for row in gaps) for name in ("converged", "unusual"))
        print(
            f"| {kind} | {len(gaps)} of {len(own)} | {share:.2f} +- {error:.2f} | "
            f"{float(closed.median()):.2f}, "
            f"{float(closed.quantile(0.1)):.2f} | {sure} of {len(gaps)} | {strong} |"
        )
    print(
        "\n| halves of sets | an addition in both | the same first | the same, or no addition in "
        "both | one in common (*) |"
    )
    print("|---|---|---|---|---|")
    for kind in KINDS:
        pairs = [row["first"] for row in rows(Path(args.json), "halves") if row["kind"] == kind]
        both = [(one, two) for one, two in pairs if one and two]
        same = sum(one[0] == two[0] for one, two in both)
        common = sum(bool({*one} & {*two}) for one, two in both)
        neither = sum(not one and not two for one, two in pairs)
        print(
            f"| {kind} | {len(both)} of {len(pairs)} | {same} | {same + neither} of {len(pairs)} "
            f"| {common} |"
        )
    print("\n(*) Additions that are not clearly worse included.")


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    for task, count in (("run", 120), ("halves", 90)):
        work = commands.add_parser(task)
        work.add_argument("--sets", type=int, default=count)
        work.set_defaults(function=run, task=task)
    show = commands.add_parser("table")
    show.set_defaults(function=table)
    for command in commands.choices.values():
        command.add_argument(
            "--json", default="differing_curves.jsonl", help="the record, one JSON line a set"
        )
    args = parser.parse_args()
    args.function(args)


if __name__ == "__main__":
    main()
