"""How many shots a target is predicted to need, against what simulated campaigns needed.

  python -m benchmarks.shots OUT.jsonl [--setting soft] [--seeds 20] [--workers 2]

The gel of each seed is drawn from the belief; polytropic bubbles, one curve a design with uncertain
Rmax, time zero and R_inf. A campaign of searched designs ends by the rule of the target, or after
20 shots. The prediction is made once, before any shot, from 128 other draws; and again for the gel
of each seed, in the place of draws of the belief, where the target is not about several models.
"""

import math
from dataclasses import dataclass
from functools import partial
from tempfile import TemporaryDirectory

from torch import Tensor

from benchmarks.records import (
    Figure,
    Line,
    add_out,
    run_missing_jobs,
    start_parser,
    write_figures,
    write_table,
)
from imr_torch.campaign import (
    Campaign,
    CampaignSettings,
    ExactLearner,
    Optimal,
    forecast_shots,
    stopping_rule,
)
from imr_torch.design import Laplace, Plan, choose_sequence
from imr_torch.float64 import tensor
from imr_torch.material import PARAMETERS, Belief, Cloud, even_belief, reference_case
from imr_torch.observe import Experiment, Nuisance, SimulatedLaboratory
from imr_torch.random import child
from imr_torch.simulate import PolytropicSimulator

MOST = 20
DRAWS = 128
UNCERTAIN = Nuisance(max_radius=0.01, time_zero=0.01, rest_radius=0.03)
SIMULATOR = PolytropicSimulator()
SEARCH = Optimal(Laplace(draws=16), evaluations=15)


@dataclass(frozen=True)
class Setting:
    """A belief, how shots are observed, and the target."""

    belief: Belief
    target: str
    plan: Plan


SETTINGS = {
    "soft": Setting(
        even_belief((reference_case("soft-pa").prior["nhkv"],)),
        "G:5%,mu:5%",
        Plan(repeats=1, nuisance=UNCERTAIN),
    ),
    "model": Setting(
        reference_case("stiff-pa").prior, "model:.99", Plan(repeats=1, nuisance=UNCERTAIN)
    ),
}


def count_shots(name: str, seed: int) -> Line:
    """Shots of one simulated campaign; more than ``MOST`` if that many were not enough."""
    setting = SETTINGS[name]
    gel = setting.belief.sample(1, seed=child(seed, "gel")).parameters[0]
    laboratory = SimulatedLaboratory(
        SIMULATOR,
        gel,
        noise=setting.plan.noise,
        repeats=setting.plan.repeats,
        nuisance=setting.plan.nuisance,
    )
    settings = CampaignSettings(
        plan=setting.plan,
        policy=SEARCH,
        learner=ExactLearner(samples=128),
        stop=stopping_rule(setting.target),
    )

    def shoot(design: Tensor, number: int) -> Experiment:
        return laboratory.shoot(design, seed=child(seed, "shoot", number))

    with TemporaryDirectory() as folder:
        campaign = Campaign(folder, setting.belief, SIMULATOR, settings=settings, seed=seed)
        campaign.run(shoot, MOST)
        reason = campaign.reason_to_stop()
        return {"shots": len(campaign.experiments), "reached": reason is not None}


def predict_shots(name: str) -> Line:
    """The prediction of a setting: shots of the draws, by chosen designs and by one repeated."""
    setting = SETTINGS[name]
    designs = choose_sequence(setting.belief, SIMULATOR, MOST, plan=setting.plan)
    rule = stopping_rule(setting.target)
    assert rule is not None
    line: Line = {"designs": designs.tolist()}
    for way, sequence in (("chosen", designs), ("repeated", designs[:1].expand(MOST, 2))):
        found = forecast_shots(
            setting.belief, sequence, SIMULATOR, setting.plan, rule, draws=DRAWS, seed=1
        )
        line[way] = [found.quantile(level / 100) for level in (5, 10, 25, 50, 75, 90, 95)]
        line[f"{way} reached"] = found.to_dict()["reached"]
    return line


def predict_gel(name: str, designs: Tensor, seed: int) -> Line:
    """The prediction for the gel of a seed, in the place of draws of the belief."""
    setting = SETTINGS[name]
    drawn = setting.belief.sample(1, seed=child(seed, "gel"))
    part = setting.belief.models[int(drawn.model_index)]
    at = part.to_controls(drawn.parameters[:, PARAMETERS.index(part.names)])
    cloud = Cloud(at, part.precision[None], at.expand(len(Cloud.SCORES), -1))
    rule = stopping_rule(setting.target)
    assert rule is not None
    sure = even_belief((part.with_cloud(cloud),))
    found = forecast_shots(sure, designs, SIMULATOR, setting.plan, rule, draws=2)
    return {"shots": found.quantile(0.5)}


def read_count(number: float | None) -> float:
    """A number of shots of a record, infinite where it was above ``MOST``."""
    return math.inf if number is None else number


def write_shots(lines: list[Line], predicted: Line, gels: list[Line]) -> str:
    """Predicted and needed shots, and the ratio of each campaign."""
    needed = [x["shots"] if x["reached"] else math.inf for x in lines]
    own = [read_count(x["shots"]) for x in gels]
    rows = []
    for what, counts in (("needed", needed), ("predicted, own gel", own)):
        if not counts:
            continue
        ordered = sorted(counts)
        levels = (ordered[round(level * (len(ordered) - 1))] for level in (0.1, 0.5, 0.9))
        rows.append((what, *levels, sum(map(math.isfinite, counts)) / len(counts)))
    for way in ("chosen", "repeated"):
        levels = map(read_count, predicted[way][1:6:2])
        rows.append((f"predicted, designs {way}", *levels, predicted[f"{way} reached"]))
    pairs = list(zip(own, needed, strict=bool(own)))
    ratios = [1.0 if p == n else p / n for p, n in pairs]
    low, high = (read_count(predicted["chosen"][i]) for i in (0, 6))
    figures = [
        Figure.of_quantile("predicted for the gel over needed, median", ratios, 0.5),
        Figure.of_share(
            "ratio within .8 to 1.25", [0.8 <= ratio <= 1.25 for ratio in ratios]
        ),
        Figure.of_share(
            "one shot off at most", [p == n or abs(p - n) <= 1 for p, n in pairs]
        ),
        Figure.of_share(
            "needed within the predicted 90 %", [low <= n <= high for n in needed]
        ),
    ]
    names = ("shots", "10 %", "median", "90 %", f"reached in {MOST}")
    return f"{write_table(names, rows)}\n\n{write_figures(figures)}"


def main() -> None:
    """Run and tabulate."""
    parser = start_parser(__doc__)
    add_out(parser)
    parser.add_argument("--setting", choices=SETTINGS, default="soft")
    parser.add_argument("--seeds", type=int, default=20)
    args = parser.parse_args()
    name = args.setting
    jobs = {f"{name}/predicted": partial(predict_shots, name)}
    jobs |= {
        f"{name}/{seed}": partial(count_shots, name, seed) for seed in range(args.seeds)
    }
    predicted, *lines = run_missing_jobs(args.out, jobs, workers=args.workers)
    designs = tensor(predicted["designs"])
    done = [seed for seed, line in enumerate(lines) if "error" not in line]
    own = {f"{name}/gel/{seed}": partial(predict_gel, name, designs, seed) for seed in done}
    if "model" in SETTINGS[name].target:
        own = {}
    gels = run_missing_jobs(args.out, own)
    print(write_shots([lines[seed] for seed in done], predicted, gels))


if __name__ == "__main__":
    main()
