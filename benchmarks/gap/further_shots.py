"""What the choice of shots is worth where a diagnosis leaves several causes: further shots, chosen
to tell these apart or at random, until one is named.

  python -m benchmarks.gap.further_shots run OUT.jsonl [--sets 120] [--physics transport] [--seed 0]
  python -m benchmarks.gap.further_shots table OUT.jsonl ...
  python -m benchmarks.gap.further_shots rivals OUT.jsonl [--physics transport]

Both arms begin with the same data, and each further shot has as many repeats and the same
nuisances. An arm ends when the diagnosis names one cause alone, right or wrong, or after ``SHOTS``
shots. `rivals` says whether any shots could: of each set that was left ambiguous, the gel and one
other effect are refitted to the true curves, at the designs of the set and with 25 further designs
beside them. Where a rival leaves as little as noise there, no shots of this kind tell the two
apart, however they are chosen.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.gap.repeats import add_task_arguments, run_tasks
from benchmarks.gap.sets import (
    FLOOR,
    GEL,
    PHYSICS,
    SyntheticSet,
    Task,
    film,
    make_plan,
    make_set,
)
from benchmarks.gap.signals import beside_rival
from benchmarks.gap.verdicts import families, is_named_alone
from benchmarks.records import Figure, Line, read_record, start_commands, write_figures
from imr_torch.campaign import DesignPolicy, Random, Situation
from imr_torch.design import DesignSpace, Plan
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import linspace, tensor
from imr_torch.gap import CauseLearner, GapReport, TellCausesApart
from imr_torch.material import LIBRARY, wide_prior
from imr_torch.observe import Experiment, ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator, fewer_steps

SHOTS = 3
ARMS = ("chosen", "random")
_PRIOR = wide_prior(("nhkv",))
_NEAREST = 3  # rivals that are refitted to all designs
_ALONG = 5  # further designs along We and R_inf*


def compare_designs(task: Task) -> Line:
    """Further shots at a set whose diagnosis leaves several causes, chosen and random.

    Returns:
        ``ambiguous``: whether a gap was found and no cause named alone; then, by arm, ``named``
        (the shot after which a cause was named alone, None if none), ``right`` (whether it was the
        true one), ``p_true`` after the last shot and ``shots``, the designs.
    """
    simulator = fewer_steps(task.simulator())
    data = make_set(task)
    learner = CauseLearner(tuple(effect.name for effect in data.offered))
    first = _diagnose(learner, data.experiments, task, simulator)
    line: Line = {
        "truth": data.truth,
        "values": data.values,
        "signal": data.signal,
        "ambiguous": first.found and not is_named_alone(first.verdict, first.cause),
        "verdict_first": first.verdict,
        "cause_first": first.cause,
    }
    if not line["ambiguous"]:
        return line
    policies = dict(zip(ARMS, (TellCausesApart(learner), Random()), strict=True))
    arms = {
        name: _shoot_arm(p, data, learner, task, simulator) for name, p in policies.items()
    }
    return line | {key: {a: own[key] for a, own in arms.items()} for key in arms["chosen"]}


def _shoot_arm(
    policy: DesignPolicy,
    data: SyntheticSet,
    learner: CauseLearner,
    task: Task,
    simulator: Simulator,
) -> Line:
    """Shots by one policy until a cause is named alone."""
    source = generator(child(task.seed, task.key, "arm"))
    plan = Plan(repeats=task.repeats, nuisance=FLOOR, collapses=None)
    experiments = list(data.experiments)
    shots = []
    report = _diagnose(learner, experiments, task, simulator)
    named = None
    for shot in range(1, SHOTS + 1):
        number = len(experiments) + 1
        batch = ExperimentBatch(tuple(experiments))
        situation = Situation(
            number,
            _PRIOR,
            simulator,
            DesignSpace(),
            plan,
            task.seed,
            prior=_PRIOR,
            batch=batch,
        )
        design = policy.choose_design(situation).design
        filmed = film(data.values, make_plan(design[None], task), task, source)
        if filmed is None:
            raise ConvergenceError(
                f"The bubble at {design.tolist()} could not be simulated."
            )
        shots.append(design.tolist())
        experiments.append(replace(filmed[0], label=f"shot {shot}"))
        report = _diagnose(learner, experiments, task, simulator)
        if is_named_alone(report.verdict, report.cause):
            named = shot
            break
    posterior = report.attribution.posterior if report.attribution else {}
    return {
        "named": named,
        "right": named is not None and families(report.cause) == families(data.truth),
        "p_true": sum(
            p for x, p in posterior.items() if families([x]) == families(data.truth)
        ),
        "shots": shots,
    }


def _diagnose(
    learner: CauseLearner,
    experiments: Sequence[Experiment],
    task: Task,
    simulator: Simulator,
) -> GapReport:
    return learner.diagnose(
        _PRIOR, ExperimentBatch(tuple(experiments)), simulator, task.seed
    )


def score_shots(lines: Sequence[Line]) -> list[Figure]:
    """How often and after how many shots the truth is named alone, of sets left ambiguous."""
    left = [line for line in lines if line.get("ambiguous")]
    figures = []
    for arm, must in zip(ARMS, ((0.85, 1.0), None), strict=True):
        right = [line["right"][arm] for line in left]
        wrong = [line["named"][arm] is not None and not line["right"][arm] for line in left]
        soon = [line["named"][arm] == 1 and line["right"][arm] for line in left]
        figures += [
            Figure.of_share(f"truth named alone, {arm}", right, must),
            Figure.of_share(f"another named alone, {arm}", wrong),
            Figure.of_share(f"truth named alone after one shot, {arm}", soon),
        ]
        for words, sets in (
            ("", left),
            (" of sets in which both name the truth", _both(left)),
        ):
            spent = sum(line["named"][arm] or SHOTS for line in sets)
            figures.append(Figure(f"shots in all{words}, {arm}", spent, len(sets)))
        figures.append(
            Figure.of_mean(f"P(truth), {arm}", [line["p_true"][arm] for line in left])
        )
    ahead = [x["p_true"]["chosen"] - x["p_true"]["random"] for x in left]
    figures.append(Figure.of_mean("P(truth), chosen less random", ahead))
    return figures


def _both(lines: Sequence[Line]) -> list[Line]:
    return [line for line in lines if all(line["right"].values())]


def measure_rivals(line: Line, physics: str) -> dict[str, tuple[float, float]]:
    """What the most similar effects leave of the true one, sd: at the designs of the set, and with
    25 further ones.

    Args:
        line: of a set that was left ambiguous.
        physics: by which the bubbles are simulated; that of the set or another.
    """
    designs, repeats = map(int, line["size"].split("x"))
    own = (line["kind"], designs, repeats, line["physics"], line["seed"])
    task = Task(*own, line["truths"])
    data = make_set(task)
    simulator = replace(task, physics=physics).simulator()
    gel = {name: data.values[name] for name in GEL}
    truth = {name: value for name, value in data.values.items() if name not in GEL}
    shot = tensor([e.design for e in data.experiments])
    others = [
        effect for effect in data.offered if effect.family not in families(data.truth)
    ]
    few = make_plan(shot, task)
    many = make_plan(torch.cat((shot, _spread_designs())), task)
    left = {
        effect.name: beside_rival(gel, truth, effect, few, simulator) for effect in others
    }
    nearest = sorted(left, key=left.__getitem__)[:_NEAREST]
    more = {
        name: beside_rival(gel, truth, LIBRARY[name], many, simulator) for name in nearest
    }
    # fewer designs cannot leave more
    return {name: (min(left[name], more[name]), more[name]) for name in nearest}


def _spread_designs() -> torch.Tensor:
    """``25 x 2`` designs over the space: We evenly in its logarithm, R_inf* evenly."""
    (weber, rest), (most_weber, most_rest) = DesignSpace().bounds.tolist()
    along = torch.logspace(
        math.log10(weber), math.log10(most_weber), _ALONG, dtype=torch.float64
    )
    return torch.cartesian_prod(along, linspace(rest, most_rest, _ALONG))


def main() -> None:
    """Run, tabulate, or refit rivals."""
    parser, commands, runs = start_commands(__doc__)
    add_task_arguments(runs)
    limits = commands.add_parser("rivals", help="could any shots tell the causes apart?")
    limits.add_argument("file", type=Path, metavar="OUT.jsonl")
    limits.add_argument(
        "--physics", choices=PHYSICS, help="if another than that of the sets"
    )
    args = parser.parse_args()
    if args.what == "rivals":
        for line in read_record(args.file):
            if line.get("ambiguous"):
                left = measure_rivals(line, args.physics or line["physics"])
                words = (f"{x} {few:.1f} to {many:.1f}" for x, (few, many) in left.items())
                print(
                    f"{line['key']}: {line['truth']} beside {', '.join(words)} sd",
                    flush=True,
                )
        return
    table = args.what == "table"
    lines = (
        read_record(*args.files) if table else run_tasks(args, ("next",), compare_designs)
    )
    print(write_figures(score_shots(lines)))


if __name__ == "__main__":
    main()
