"""Estimators of the information gain: what they cost, how few draws rank designs, and whether cheap
bubbles can stand in.

  python benchmarks/eig.py [--part estimators|ranking|fidelity|searching|cost|model|differences]
  [--json OUT]

The part `model` takes half a CPU hour; each design is a line of
`benchmarks/records/eig_model.jsonl`, and designs that have one are not run again.

Prior of the stiff-PA reference case, designs from a Sobol sequence over We 100-1000 and R_inf*
.14-.30, 81 frames to t* = 4 cut at the second collapse. CPU times are of the process, one thread.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from botorch.utils.sampling import draw_sobol_samples
from scipy.stats import spearmanr
from torch import Tensor

from imr_torch.design import (
    AdaptiveContrastive,
    DesignSpace,
    ExpectedInformationGain,
    ImportanceSampling,
    InformationEstimator,
    InformationGain,
    Laplace,
    NestedMonteCarlo,
    Plan,
    PriorContrastive,
    PublishedEstimator,
    expected_information_gain,
    search_design,
    separate_errors,
)
from imr_torch.design.likelihood import Data, infer
from imr_torch.design.response import Shot, respond
from imr_torch.files import write_json
from imr_torch.material import reference_case
from imr_torch.random import child, generator
from imr_torch.simulate import (
    ACCURACIES,
    PolytropicSimulator,
    Simulator,
    Solution,
    TransportSimulator,
    coarser,
)

PRIOR = reference_case("stiff-pa").prior
MODEL_RECORD = Path(__file__).parent / "records" / "eig_model.jsonl"
PLANS = {1: Plan(repeats=1), 100: Plan(repeats=100)}


def designs(count: int) -> Tensor:
    """``count x 2`` space-filling designs."""
    return draw_sobol_samples(DesignSpace().bounds, n=count, q=1, seed=7)[:, 0]


def surface(
    points: Tensor,
    repeats: int,
    estimator: InformationEstimator,
    *,
    seed: int,
    common: bool = False,
) -> Tensor:
    """Gains at designs, ``n``, of polytropic bubbles.

    ``common`` shares draws and noise between designs.
    """
    seeds = [child(seed, "common" if common else i) for i in range(len(points))]
    values = [
        expected_information_gain(
            PRIOR, X[None], PolytropicSimulator(), PLANS[repeats], estimator=estimator, seed=s
        ).value
        for X, s in zip(points, seeds, strict=True)
    ]
    return torch.tensor(values, dtype=torch.float64)


def figures(gain: InformationGain) -> dict[str, Any]:
    """A gain without the influence of each draw."""
    return {key: value for key, value in vars(gain).items() if key != "influence"}


def estimators() -> list[dict[str, Any]]:
    """Every method at one design."""
    wanted: list[InformationEstimator] = [
        Laplace(),
        Laplace(rivals=64),
        ImportanceSampling(),
        ImportanceSampling(inner=64),
        AdaptiveContrastive(inner=64),
        PriorContrastive(draws=200, inner=1000),
        NestedMonteCarlo(draws=200, inner=1000),
        PublishedEstimator(500),
    ]
    rows = []
    for repeats, plan in PLANS.items():
        for estimator in wanted:
            started = time.process_time()
            X = torch.tensor([[900.0, 0.28]], dtype=torch.float64)
            gain = expected_information_gain(
                PRIOR, X, PolytropicSimulator(), plan, estimator=estimator, seed=1
            )
            taken = time.process_time() - started
            rows.append(
                {"estimator": repr(estimator), "repeats": repeats, "cpu": taken} | figures(gain)
            )
            print(
                f"{repeats:4d} repeats  {estimator!r}: {gain.value:8.3f} "
                f"+- {gain.variance**0.5:.3f}  parameters {gain.parameters:8.3f}  model "
                f"{gain.model:7.3f}  CPU {taken:.2f} s",
                flush=True,
            )
    return rows


def ranking() -> list[dict[str, Any]]:
    """Spearman correlation of small samples' surfaces over 16 designs with one of 500 draws of each
    model.
    """
    points = designs(16)
    rows = []
    wanted: list[tuple[InformationEstimator, bool]] = [
        (Laplace(draws=n), common) for n in (32, 64, 128) for common in (False, True)
    ]
    wanted += [(Laplace(draws=32, rivals=32), True), (Laplace(draws=32, refinements=0), True)]
    wanted += [(ImportanceSampling(draws=50), True), (PublishedEstimator(500), False)]
    for repeats in PLANS:
        truth = surface(points, repeats, Laplace(draws=500, rivals=500), seed=0, common=True)
        print(
            f"{repeats} repeats: gains {float(truth.min()):.2f} to {float(truth.max()):.2f} nats",
            flush=True,
        )
        for estimator, common in wanted:
            seeds = 4 if isinstance(estimator, Laplace) else 1
            started = time.process_time()
            found = []
            for seed in range(1, 1 + seeds):
                values = surface(points, repeats, estimator, seed=seed, common=common)
                regret = float(truth.max() - truth[values.argmax()])
                found.append(
                    (
                        float(spearmanr(values, truth)[0]),
                        regret,
                        float(values.mean() - truth.mean()),
                    )
                )
            taken = (time.process_time() - started) / seeds / len(points)
            rho, regret, offset = torch.tensor(found, dtype=torch.float64).mean(0).tolist()
            rows.append(
                {
                    "estimator": repr(estimator),
                    "repeats": repeats,
                    "common": common,
                    "spearman": rho,
                    "regret": regret,
                }
            )
            print(
                f"  {estimator!r} {'common' if common else 'own'} draws: "
                f"Spearman {rho:.3f}  regret {regret:.3f}  mean offset {offset:+.3f}  CPU "
                f"{taken:.2f} s",
                flush=True,
            )
    return rows


def informations(simulator: Simulator, X: Tensor, draws: int) -> dict[int, Tensor]:
    """``1/2 log det(1 + J^T J)`` of each draw of each model at one design.

    NaN where a bubble failed.
    """
    found: dict[int, list[Tensor]] = {repeats: [] for repeats in PLANS}
    for part in PRIOR.models:
        v = torch.randn(draws, len(part.names), generator=generator(5), dtype=torch.float64)
        seen = respond(Shot(PRIOR, X[None], simulator, PLANS[1]), part, v)
        window = PLANS[1].window(seen.radius)
        for repeats, plan in PLANS.items():
            each = torch.full((draws,), torch.nan, dtype=torch.float64)
            each[seen.good] = infer(
                Data(seen.radius, window)[seen.good], seen[seen.good], plan
            ).information
            found[repeats].append(each)
    return {repeats: torch.stack(rows) for repeats, rows in found.items()}


def fidelity() -> list[dict[str, Any]]:
    """Correlation of the polytropic gain with that of the full physics, over designs and over draws
    at one design.
    """
    points = designs(16)
    draws = 32
    rows = []
    cheap, full = [
        [informations(s, X, draws) for X in points]
        for s in (PolytropicSimulator(), TransportSimulator())
    ]
    for repeats in PLANS:
        a, b = (
            torch.stack([entry[repeats] for entry in runs]) for runs in (cheap, full)
        )  # designs x models x draws
        good = torch.isfinite(a) & torch.isfinite(b)
        a = torch.where(good, a, torch.nan)
        b = torch.where(good, b, torch.nan)
        over_designs = torch.corrcoef(torch.stack((a.nanmean((1, 2)), b.nanmean((1, 2)))))[0, 1]
        within = []
        for x, y, keep in zip(a.flatten(0, 1), b.flatten(0, 1), good.flatten(0, 1), strict=True):
            within.append(float(torch.corrcoef(torch.stack((x[keep], y[keep])))[0, 1]))
        rank = float(spearmanr(a.nanmean((1, 2)), b.nanmean((1, 2)))[0])
        left = float((1.0 - torch.tensor(within).square()).median())
        best = int(a.nanmean((1, 2)).argmax())
        regret = float(b.nanmean((1, 2)).max() - b.nanmean((1, 2))[best])
        row = {
            "repeats": repeats,
            "over_designs": float(over_designs),
            "spearman": rank,
            "median_variance_left": left,
            "within": within,
            "regret": regret,
            "offset": float((a - b).nanmean()),
        }
        rows.append(row)
        print(
            f"{repeats:4d} repeats: over designs r = {row['over_designs']:.3f}, Spearman "
            f"{rank:.3f}, regret of the polytropic "
            f"choice {regret:.3f} nats, offset {row['offset']:+.3f}; a control variate leaves "
            f"{left:.2f} of the variance",
            flush=True,
        )
    return rows


def searching() -> list[dict[str, Any]]:
    """Regret of the design that a whole search recommends, against a grid and all designs found."""
    variants = [(16, False, 1), (16, True, 1), (16, True, 5), (64, True, 5)]
    seeds = 4
    runs = []
    for variant in variants:
        draws, common, batch = variant
        for seed in range(seeds):
            started = time.process_time()
            acquisition = ExpectedInformationGain(
                PRIOR, PolytropicSimulator(), Laplace(draws=draws), plan=PLANS[100]
            )
            best = search_design(
                acquisition, seed=seed, common=common, batch=batch
            ).recommendation.design
            runs.append((variant, best, time.process_time() - started))
    points = torch.cat((torch.stack([run[1] for run in runs]), designs(32)))
    truth = surface(points, 100, Laplace(draws=500, rivals=500), seed=0, common=True)
    rows = []
    for draws, common, batch in variants:
        mine = torch.tensor([run[0] == (draws, common, batch) for run in runs])
        regrets = truth.max() - truth[: len(runs)][mine]
        cpu = sum(run[2] for run in runs if run[0] == (draws, common, batch)) / seeds
        rows.append(
            {
                "draws": draws,
                "common": common,
                "batch": batch,
                "regrets": regrets.tolist(),
                "cpu": cpu,
            }
        )
        print(
            f"laplace N = {2 * draws:4d} {'common' if common else 'own':6s} draws, {batch} at a "
            "time: regret mean "
            f"{float(regrets.mean()):.3f} worst {float(regrets.max()):.3f} nats, CPU of a search "
            f"{cpu:.0f} s",
            flush=True,
        )
    return rows


def cost() -> list[dict[str, Any]]:
    """What the refinement of rivals costs with heat and vapour transport: median CPU of an estimate
    and of a whole search.
    """
    simulator = coarser(TransportSimulator(accuracy=ACCURACIES["search"], threads=1))
    rows = []
    for repeats, plan in PLANS.items():
        row: dict[str, Any] = {"repeats": repeats}
        for name, estimator in (
            ("refined", Laplace(draws=16)),
            ("at a draw", Laplace(draws=16, refinements=0)),
        ):
            estimates = []
            searches = []
            for point in designs(8):
                started = time.process_time()
                expected_information_gain(
                    PRIOR, point[None], simulator, plan, estimator=estimator, seed=1
                )
                estimates.append(time.process_time() - started)
            for seed in range(3):
                started = time.process_time()
                search_design(
                    ExpectedInformationGain(PRIOR, simulator, estimator, plan=plan), seed=seed
                )
                searches.append(time.process_time() - started)
            row[name] = {
                "estimate": statistics.median(estimates),
                "search": statistics.median(searches),
            }
            taken = ", ".join(f"{what} {cpu:.3f} s" for what, cpu in row[name].items())
            print(f"{repeats:4d} repeats, {name}: {taken}", flush=True)
        rows.append(row)
    return rows


TEN = (
    (150.0, 0.15),
    (100.0, 0.14),
    (1000.0, 0.30),
    (100.0, 0.30),
    (1000.0, 0.14),
    (750.0, 0.14),
    (300.0, 0.20),
    (550.0, 0.22),
    (900.0, 0.28),
    (200.0, 0.25),
)


class Recalled:
    """A simulator that remembers its last solutions, since both brute bounds simulate the same
    gels.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.conditions = simulator.conditions
        self.solved: list[tuple[tuple[Tensor, ...], Solution]] = []

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        """See :class:`~imr_torch.simulate.Simulator`."""
        return self._recall(self.simulator, (parameters, designs, times))

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        """See :class:`~imr_torch.simulate.Simulator`."""
        return self._recall(self.simulator.bundle, (parameters, designs, times))

    def _recall(self, solve: Callable[..., Solution], asked: tuple[Tensor, ...]) -> Solution:
        for arguments, solution in self.solved:
            if all(torch.equal(one, other) for one, other in zip(arguments, asked, strict=True)):
                return solution
        self.solved = [*self.solved[-3:], (asked, solve(*asked))]
        return self.solved[-1][1]


def model_at(point: tuple[float, float]) -> dict[str, Any]:
    """The gain about the model at one design by each estimator, as ``[value, error]`` in nats."""
    simulator = TransportSimulator(accuracy=ACCURACIES["search"], threads=1)
    recalled = Recalled(simulator)
    X = torch.tensor([point], dtype=torch.float64)

    def part(
        estimator: InformationEstimator, seeds: int, used: Simulator = simulator
    ) -> tuple[float, float]:
        gains = [
            expected_information_gain(
                PRIOR, X, used, PLANS[1], estimator=estimator, seed=child(11, s)
            )
            for s in range(seeds)
        ]
        return sum(g.model for g in gains) / seeds, (
            sum(g.model_variance for g in gains)
        ) ** 0.5 / seeds

    started = time.process_time()
    found = {
        "nested": part(NestedMonteCarlo(600, 15000), 1, recalled),
        "contrastive": part(PriorContrastive(600, 15000), 1, recalled),
        "importance": part(ImportanceSampling(draws=256, inner=64), 1),
        "refined": part(Laplace(32, 32), 16),
        "at a draw": part(Laplace(32, 32, refinements=0), 16),
    }
    return {"design": point, "cpu": time.process_time() - started} | found


def model() -> list[dict[str, Any]]:
    """The gain about the model at ten designs, full physics, one repeat: cheap estimators between
    brute bounds.

    Nested Monte Carlo is too low about the model where no draw of the prior explains a datum, and
    too high with the datum's own gel among the draws; the truth is between, within the error of the
    data, which all estimators here draw for themselves.
    """
    rows = (
        [json.loads(line) for line in MODEL_RECORD.read_text().splitlines()]
        if MODEL_RECORD.exists()
        else []
    )
    for point in TEN[len(rows) :]:
        rows.append(json.loads(json.dumps(model_at(point))))
        with MODEL_RECORD.open("a") as stream:
            stream.write(json.dumps(rows[-1]) + "\n")
    names = ("nested", "contrastive", "importance", "refined", "at a draw")
    for row in rows:
        print(
            row["design"],
            "  ".join(f"{name} {row[name][0]:.3f} +- {row[name][1]:.3f}" for name in names),
            flush=True,
        )
    return rows


def differences() -> list[dict[str, Any]]:
    """Error of a difference between designs: as independent draws would have it, as stated, and as
    scattered over seeds.
    """
    points = designs(8)
    seeds = 40
    rows = []
    for repeats, plan in PLANS.items():
        acquisition = ExpectedInformationGain(
            PRIOR, PolytropicSimulator(), Laplace(draws=32), plan=plan
        )
        runs = [acquisition.estimate_each(points, seed=child(3, s)) for s in range(seeds)]
        values = torch.tensor([[gain.value for gain in run] for run in runs], dtype=torch.float64)
        true = (values[:, :, None] - values[:, None]).var(0)
        own = torch.stack([separate_errors(run).own for run in runs]).mean(0)
        whole = torch.tensor(
            [[gain.variance for gain in run] for run in runs], dtype=torch.float64
        ).mean(0)
        pairs = torch.triu_indices(len(points), len(points), 1)
        sds = {
            name: float(matrix[pairs[0], pairs[1]].mean().sqrt())
            for name, matrix in (
                ("true", true),
                ("stated", own[:, None] + own),
                ("independent", whole[:, None] + whole),
            )
        }
        rows.append({"repeats": repeats} | sds)
        print(
            f"{repeats:4d} repeats: sd of a difference "
            + ", ".join(f"{k} {v:.3f}" for k, v in sds.items()),
            flush=True,
        )
    return rows


PARTS = {
    "estimators": estimators,
    "ranking": ranking,
    "fidelity": fidelity,
    "searching": searching,
    "cost": cost,
    "model": model,
    "differences": differences,
}


def main() -> None:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=tuple(PARTS), help="only this part")
    parser.add_argument("--json", metavar="OUT", help="write the figures")
    args = parser.parse_args()
    torch.set_num_threads(1)
    results = {name: work() for name, work in PARTS.items() if args.part in (None, name)}
    if args.json:
        write_json(args.json, results)


if __name__ == "__main__":
    main()
