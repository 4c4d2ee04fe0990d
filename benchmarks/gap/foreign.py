"""Six effects that the library does not hold: what is said of them, and of sets where nothing is missing
or each shot has a pressure of its own.

  python -m benchmarks.gap.foreign run OUT.jsonl [--sets 4] [--seed 0] [--paths repeats,single]
      [--only darcy,none] [--physics resting]
  python -m benchmarks.gap.foreign table OUT.jsonl ...

Sets, ``--sets`` of each effect and path, are those of :mod:`benchmarks.gap.foreign_sets`. The
default diagnosis and what is missing are asked of each.
Kinds that are right were stated before any set was run (``EFFECTS``): a viscous interface is one of
the contents or a stress of the gel; what a drag in the pores may be taken for, of the sample as well;
a loss by shapes that look larger, of the contents or the camera. Every name of a library effect is
wrong, though of the drag ``size_drag`` comes near (``beside_drag``: what a refit with it leaves).
S of what is missing is judged on two designs that no fit saw, against their true curves: 1 less the
squared error over that of the base model.
"""

import argparse
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import product

from torch import Tensor

from benchmarks.gap import closures
from benchmarks.gap.foreign_sets import (
    PATHS,
    SHOTS,
    SIMULATORS,
    STARTS,
    Truth,
    make_foreign_set,
    run_apart,
)
from benchmarks.gap.sets import GEL
from benchmarks.gap.signals import refit
from benchmarks.gap.unknown import (
    OWN_KINDS,
    SCORES,
    count_words,
    median_of,
    score_group,
    summarise_unknown,
    values_of,
)
from benchmarks.gap.verdicts import is_named, summarise
from benchmarks.records import (
    Line,
    read_record,
    run_missing_jobs,
    start_commands,
    write_table,
)
from imr_torch.design import Plan
from imr_torch.float64 import tensor, zeros
from imr_torch.gap import GapReport, diagnose
from imr_torch.material import LIBRARY
from imr_torch.random import child, generator
from imr_torch.simulate import fewer_steps
from imr_torch.unknown import Unknown, infer_unknown
from imr_torch.unknown.next_shot import plan_shot, predict_curve

EFFECTS = {
    "surface_viscosity": {"contents", "material"},
    "darcy": {"sample", "contents", "material"},
    "dropped_frame": {"camera"},
    "drifting_edge": {"camera"},
    "no_sphere": {"contents", "camera"},
    "two_times": {"material"},
}
"""Effect -> kinds that are right."""
PRESSURES = ("surface_viscosity", "darcy", "two_times")


def judge_set(path: str, effect: str, physics: str, number: int) -> Line:
    """Make a set, diagnose it, infer what is missing, and compare."""
    seed = child(number, "foreign", path, effect, physics)
    truth, experiments, unseen = make_foreign_set(path, effect, physics, generator(seed))
    gel = {name: truth.gels[0][name] for name in GEL}
    line: Line = {
        "strength": truth.strength,
        "signal": truth.signal,
        "frames": len(truth.times),
        "gel": gel,
    }
    if effect == "darcy":
        drag = LIBRARY["size_drag"]
        clean = truth.film(truth.fits, zeros(SHOTS, 3))
        left = [
            refit(gel, clean, truth.plan, truth.fits, rival=(drag, start))
            for start in drag.starts
        ]
        line["beside_drag"] = min(left)
    started = time.process_time()
    report = diagnose(
        experiments, estimate_noise=path == "single", simulator=truth.fits, seed=seed
    )
    line |= {"seconds_diagnosis": time.process_time() - started}
    said = summarise(report)
    likeliest = sorted(said["posterior"] or {}, key=lambda name: -said["posterior"][name])[
        :4
    ]
    said["posterior"] = {name: said["posterior"][name] for name in likeliest}
    return line | said | judge_unknown(truth, report, unseen)


def judge_unknown(truth: Truth, report: GapReport, unseen: Tensor) -> Line:
    """What is inferred to be missing; ``shown`` where a user would see it."""
    started = time.process_time()
    found = None
    if report.null.certificate.usable:
        with suppress(RuntimeError):  # a matrix that is not positive definite
            found = infer_unknown(report.null, report.batch, fewer_steps(truth.fits))
    if found is None:
        return {"explained": None}
    line = summarise_unknown(found) | {
        "shown": report.found and not is_named({"verdict": report.verdict}),
        "seconds_unknown": time.process_time() - started,
        "unseen": judge_unseen(truth, report, found, unseen),
    }
    if truth.effect in PRESSURES and found.shots:
        fitted = values_of(report.null)
        given = (truth.gels[:SHOTS], truth.designs[:SHOTS], fitted, found.shots)
        line |= run_apart(closures.compare_shots, truth.effect, truth.strength, *given)
    return line


def judge_unseen(truth: Truth, report: GapReport, found: Unknown, unseen: Tensor) -> Line:
    """Whitened squared errors on unseen designs, of the base model and of the most probable kind."""
    fewer = fewer_steps(truth.fits)
    errors = {"base": 0.0, found.kind: 0.0}
    for design, curve in zip(truth.designs[SHOTS:], unseen, strict=True):
        plan = Plan(repeats=1, times=truth.times)
        shot = plan_shot(tensor(design), plan, report.null.prior, fewer)
        base = shot.predict(report.null.mean, zeros(3), zeros(len(shot.moments)))
        left = shot.whiten((curve - base)[None], base)[0]
        errors["base"] += float(left.square().mean())
        made = predict_curve(shot, found.rivals[found.kind], base).mean
        errors[found.kind] += float((left - made).square().mean())
    return errors


def list_jobs(args: argparse.Namespace) -> tuple[dict[str, partial[Line]], dict[str, Line]]:
    """Sets asked for, and what they are of, a few of each effect coming first."""
    jobs = {}
    about = {}
    numbers = range(args.seed, args.seed + args.sets)
    for number, path, effect in product(
        numbers, args.paths.split(","), args.only.split(",")
    ):
        own = (path, effect, args.physics, number)
        key = "/".join(map(str, own))
        jobs[key] = partial(judge_set, *own)
        about[key] = dict(zip(("path", "effect", "physics", "seed"), own, strict=True))
    return jobs, about


def write_scores(lines: Sequence[Line]) -> str:
    """A table of each path: by effects, of all effects together, and placebos."""
    head = ("", "sd", "p < .05", "named", "S unseen", "CPU s", *SCORES)
    pages = []
    for path in PATHS:
        own = [
            x
            | {
                "S": score_unseen(x),
                "cpu": x["seconds_diagnosis"] + x.get("seconds_unknown", 0.0),
            }
            for x in lines
            if x["path"] == path and "verdict" in x
        ]
        groups = {effect: [x for x in own if x["effect"] == effect] for effect in STARTS}
        for name, kinds in (("all effects", EFFECTS), ("pressures", PRESSURES)):
            groups[name] = [x for x in own if x["effect"] in kinds]
        rows = []
        for name, some in groups.items():
            seen = f"{sum(x['p_gap'] < 0.05 for x in some)} of {len(some)}"
            named = count_words("+".join(x["cause"]) for x in some if is_named(x))
            sd, share, cost = (median_of(some, x) for x in ("signal", "S", "cpu"))
            rows.append(
                (
                    name,
                    sd,
                    seen,
                    named,
                    share,
                    cost,
                    *score_group(some, OWN_KINDS | EFFECTS),
                )
            )
        pages.append(f"{path}\n\n{write_table(head, rows)}")
    return "\n\n".join(pages)


def score_unseen(line: Line) -> float | None:
    """S of the most probable kind on unseen designs; minus infinity where its bubble failed."""
    if "unseen" not in line:
        return None
    left = line["unseen"][line["kind"]]
    return 1.0 - (math.inf if left is None else left) / line["unseen"]["base"]


def main() -> None:
    """Run or tabulate."""
    parser, _, runs = start_commands(__doc__, sets=4)
    runs.add_argument("--physics", choices=SIMULATORS, default="resting")
    runs.add_argument("--paths", default=",".join(PATHS))
    runs.add_argument("--only", default=",".join(STARTS))
    args = parser.parse_args()
    if args.what == "table":
        lines = read_record(*args.files)
    else:
        jobs, about = list_jobs(args)
        lines = run_missing_jobs(args.out, jobs, about=about, workers=args.workers)
    print(write_scores(lines))


if __name__ == "__main__":
    main()
