"""The sequential campaigns of the reproduction, and the table that is computed from their journals.

Truth and inference have full physics. Searches take 25 evaluations of the Laplace gain with 16
common draws of each model, the later ones five at a time (``mode`` exact), or are the published
ones with 1000 draws (``mode`` paper).
"""

import json
import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from imr_torch.campaign import (
    Campaign,
    CampaignSettings,
    DesignPolicy,
    Optimal,
    PaperLearner,
    Random,
    Step,
    Study,
    run_campaigns,
)
from imr_torch.design import Laplace, Plan
from imr_torch.design.likelihood import Data, infer
from imr_torch.design.response import Shot, respond
from imr_torch.files import write_json
from imr_torch.material import CASES, PARAMETERS, Belief, ModelBelief, ReferenceCase, reference_case
from imr_torch.observe import SimulatedLaboratory
from imr_torch.simulate import Accuracy, Simulator, TransportSimulator, process_pool

PLAN = Plan(repeats=100)
SIMULATOR = TransportSimulator(
    accuracy=Accuracy(max_steps=20000)
)  # named, so that journals outlive a change of defaults
SEARCH = Optimal(Laplace(draws=16), batch=5)
POLICIES: dict[str, DesignPolicy] = {"optimal": SEARCH, "random": Random()}
MODES = ("exact", "paper")
WITHIN = 0.01
SURE = 0.99
LEVEL = 0.9
PRECISE = 0.02  # relative sd; an error below 1 % is chance while the sd is of that size
COMPARED_AT = 3


@dataclass(frozen=True)
class Row:
    """What one design of one seed led to, for the true model.

    Args:
        design: (We, R_inf*).
        gain: expected information gain, nats; None where the policy estimates none.
        probability: of the true model.
        errors: relative error of the posterior mean of each parameter.
        sds: relative posterior standard deviation of each parameter.
        ratios: posterior standard deviation of each control over its Cramer-Rao bound with the
            prior.
        covered: whether the 90 % interval of each parameter holds the truth.
        volume: log of the posterior's volume over the prior's (determinant of standard deviations
            of the controls).
        entropy: of the whole belief, nats (SI units).
    """

    design: tuple[float, float]
    gain: float | None
    probability: float
    errors: list[float]
    sds: list[float]
    ratios: list[float]
    covered: list[bool]
    volume: float
    entropy: float


def study(folder: Path, case: ReferenceCase, policy: str, mode: str) -> Study:
    """Campaigns of one case, policy and mode."""
    laboratory = SimulatedLaboratory(
        SIMULATOR, PARAMETERS.pack(case.truth), noise=PLAN.noise, repeats=PLAN.repeats
    )
    settings = CampaignSettings(plan=PLAN, policy=POLICIES[policy])
    if mode == "paper":
        published = CampaignSettings.paper()
        chosen = published.policy if policy == "optimal" else POLICIES[policy]
        settings = CampaignSettings(plan=PLAN, policy=chosen, learner=PaperLearner())
    name = f"{case.key}_{policy}_{mode}"
    return Study(
        folder / "campaigns" / name, case.prior, SIMULATOR, laboratory, settings, {"case": case.key}
    )


def run(
    folder: Path,
    case: str,
    policy: str,
    mode: str,
    seeds: Sequence[int],
    designs: int,
    *,
    workers: int = 1,
    quiet: bool = False,
) -> None:
    """Continue campaigns, a design of all seeds after the other, and keep the CPU time of each."""
    work = study(folder, reference_case(case), policy, mode)
    pool = process_pool(workers) if workers > 1 else None
    for count in range(1, designs + 1):
        waiting = [seed for seed in seeds if len(work.open(seed).steps) < count]
        outcomes = run_campaigns(
            waiting, work, count, executor=pool, progress=None if quiet else print
        )
        for outcome in outcomes:
            with (Path(work.folder) / "cpu.jsonl").open("a") as stream:
                stream.write(json.dumps(asdict(outcome)) + "\n")
    if pool:
        pool.shutdown()


def informations(case: ReferenceCase, designs: Tensor, simulator: Simulator) -> Tensor:
    """Fisher information of the controls of the true gel in each design: ``E x d x d``."""
    part = case.prior[case.truth_model]
    belief = Belief((part,), torch.zeros(1, dtype=torch.float64))
    shot = Shot(belief, designs, simulator, PLAN)
    with torch.no_grad():
        seen = respond(shot, part, true_controls(case)[None])
    each = (seen.of_design(number) for number in range(len(designs)))
    chols = torch.stack(
        [infer(Data(one.radius, PLAN.window(one.radius)), one, PLAN).chol[0] for one in each]
    )
    return chols @ chols.mT - torch.eye(chols.shape[-1], dtype=torch.float64)


def true_controls(case: ReferenceCase) -> Tensor:
    """``d`` tensor, controls of the true gel under its own model."""
    part = case.prior[case.truth_model]
    return part.to_controls(
        torch.tensor([case.truth[name] for name in part.names], dtype=torch.float64)
    )


def bounds(case: ReferenceCase, designs: Tensor, simulator: Simulator) -> Tensor:
    """Cramer-Rao bounds with the prior of the controls' standard deviations after each design: ``E
    x d``.
    """
    each = informations(case, designs, simulator)
    known = torch.eye(each.shape[-1], dtype=torch.float64) + each.cumsum(0)
    return torch.linalg.inv(known).diagonal(dim1=-2, dim2=-1).sqrt()


def _row(campaign: Campaign, step: Step, case: ReferenceCase, bound: Tensor) -> Row:
    part: ModelBelief = step.belief[case.truth_model]
    truth = torch.tensor([case.truth[name] for name in part.names], dtype=torch.float64)
    low, high = part.quantile([0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    asked = campaign.journal.find("ask", step.number)
    return Row(
        design=campaign.experiments[step.number - 1].design,
        gain=asked["gain"] if asked else None,
        probability=step.belief.probabilities[case.truth_model],
        errors=(part.means / truth - 1.0).abs().tolist(),
        sds=(part.sds / part.means).tolist(),
        ratios=(torch.linalg.norm(part.chol, dim=1) / bound).tolist(),
        covered=((low < truth) & (truth < high)).tolist(),
        volume=float(part.chol.diagonal().log().sum()),
        entropy=float(step.belief.entropy()),
    )


def read(folder: Path, case: ReferenceCase, policy: str, mode: str) -> dict[int, list[Row]]:
    """All finished designs of all seeds; bounds are computed once and kept beside each journal."""
    work = study(folder, case, policy, mode)
    found = {}
    for path in sorted(Path(work.folder).glob("seed_*")):
        campaign = work.open(int(path.name.removeprefix("seed_")))
        if not campaign.steps:
            continue
        kept = path / "bounds.json"
        designs = [list(e.design) for e in campaign.experiments]
        known = json.loads(kept.read_text()) if kept.exists() else {"designs": []}
        if known["designs"] != designs:
            bound = bounds(case, torch.tensor(designs, dtype=torch.float64), work.simulator)
            known = {"designs": designs, "bounds": bound.tolist()}
            write_json(kept, known)
        bound = torch.tensor(known["bounds"], dtype=torch.float64)
        found[campaign.seed] = [
            _row(campaign, step, case, bound[step.number - 1]) for step in campaign.steps
        ]
    return found


def _mean(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean and its standard error; None of one value."""
    error = statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None
    return statistics.fmean(values), error


def _close(row: Row) -> bool:
    return max(row.errors) <= WITHIN


def _precise(row: Row) -> bool:
    return max(row.sds) <= PRECISE


def _first(rows: Sequence[Row], reached: Any) -> float:
    """Number of the first design at which something is reached; infinite when none."""
    return next((float(n) for n, row in enumerate(rows, start=1) if reached(row)), math.inf)


def _for_good(rows: Sequence[Row]) -> float:
    """Number of the first design from which on every parameter stays within 1 %.

    Infinite when the last is not.
    """
    beyond = [n for n, row in enumerate(rows, start=1) if not _close(row)]
    last = max(beyond, default=0)
    return last + 1.0 if last < len(rows) else math.inf


def _known(numbers: Sequence[float]) -> list[float | None]:
    """Sorted, with None for never so far."""
    return [None if math.isinf(n) else n for n in sorted(numbers)]


def _covered(seeds: Sequence[list[bool]]) -> dict[str, float | None]:
    """Share of intervals that cover.

    Its error is over seeds, since the parameters of one seed err together.
    """
    share, error = _mean([statistics.fmean(covered) for covered in seeds])
    return {"share": share, "error": error, "intervals": sum(map(len, seeds))}


def summary(seeds: dict[int, list[Row]], cpu: Path) -> dict[str, Any]:
    """The figures of one case, policy and mode."""
    rows = list(seeds.values())
    longest = max(len(r) for r in seeds.values())
    until = [_first(r, _close) for r in rows]
    stays = [_for_good(r) for r in rows]
    precise = [_first(r, _precise) for r in rows]
    sure = [_first(r, lambda row: row.probability > SURE) for r in rows]
    at = {n: [r[n - 1] for r in rows if len(r) >= n] for n in range(1, longest + 1)}
    timed = [json.loads(line) for line in cpu.read_text().splitlines()] if cpu.exists() else []
    seconds = {
        n: [t["cpu_seconds"] for t in timed if t["designs"] == n and t["made"] == 1] for n in at
    }
    return {
        "seeds": len(rows),
        "designs_of_each": sorted(len(r) for r in rows),
        "until_within_1_percent": _known(until),
        "until_within_1_percent_for_good": _known(stays),
        "until_sd_below_2_percent": _known(precise),
        "until_sure": _known(sure),
        "wrong_model_sure": sum(any(row.probability < 1.0 - SURE for row in r) for r in rows),
        "by_design": {
            n: {
                "seeds": len(group),
                "worst_error_median": statistics.median(max(row.errors) for row in group),
                "errors_median": [
                    statistics.median(e) for e in zip(*(row.errors for row in group), strict=True)
                ],
                "sds_median": [
                    statistics.median(e) for e in zip(*(row.sds for row in group), strict=True)
                ],
                "ratio_to_bound_median": [
                    statistics.median(e) for e in zip(*(row.ratios for row in group), strict=True)
                ],
                "probability_mean": statistics.fmean(row.probability for row in group),
                "coverage": _covered([row.covered for row in group]),
                "volume": _mean([row.volume for row in group]),
                "cpu_seconds_mean": statistics.fmean(seconds[n]) if seconds[n] else None,
            }
            for n, group in at.items()
        },
    }


def _against(
    first: dict[int, list[Row]], second: dict[int, list[Row]], value: Any
) -> dict[str, float] | None:
    """Difference of means over seeds with its standard error, of seeds that have the value."""
    groups = [
        [v for rows in seeds.values() if (v := value(rows)) is not None]
        for seeds in (first, second)
    ]
    if min(map(len, groups)) < 2:
        return None
    difference = statistics.fmean(groups[0]) - statistics.fmean(groups[1])
    error = math.sqrt(sum(statistics.variance(g) / len(g) for g in groups))
    return {"difference": difference, "error": error, "seeds": [len(g) for g in groups]}


def _policies(optimal: dict[int, list[Row]], random: dict[int, list[Row]]) -> dict[str, Any]:
    """What optimal designs save.

    Where the longest campaigns were not enough, one design more is counted.
    """
    longest = max(len(rows) for seeds in (optimal, random) for rows in seeds.values())

    def against(value: Any, least: int) -> dict[str, Any] | None:
        return _against(optimal, random, lambda rows: value(rows) if len(rows) >= least else None)

    def designs(until: Any) -> dict[str, Any] | None:
        return against(lambda rows: min(until(rows), longest + 1.0), longest)

    def worst(rows: list[Row]) -> float:
        return math.log(max(rows[COMPARED_AT - 1].sds))

    volumes = {
        f"log volume after {n}": against(lambda rows, n=n: rows[n - 1].volume, n)
        for n in range(1, longest + 1)
    }
    return volumes | {
        f"log worst relative sd after {COMPARED_AT}": against(worst, COMPARED_AT),
        "designs until within 1 %": designs(lambda rows: _first(rows, _close)),
        "designs until within 1 % for good": designs(_for_good),
        "designs until every sd is below 2 %": designs(lambda rows: _first(rows, _precise)),
    }


def table(folder: Path) -> dict[str, Any]:
    """All figures of the table, of whatever campaigns there are, and what differs between optimal
    and random designs.
    """
    document: dict[str, Any] = {}
    for case in CASES.values():
        for mode in MODES:
            found = {policy: read(folder, case, policy, mode) for policy in POLICIES}
            for policy, seeds in found.items():
                if seeds:
                    name = f"{case.key}_{policy}_{mode}"
                    document[name] = summary(seeds, folder / "campaigns" / name / "cpu.jsonl")
            if all(found.values()):
                document[f"{case.key}_{mode}: optimal minus random"] = _policies(
                    found["optimal"], found["random"]
                )
    return document
