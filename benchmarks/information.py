"""Is the information about the model right, how few draws rank designs, and what do estimates cost?

  python -m benchmarks.information model|ranking|searching|cost|coarse [--out OUT.jsonl]

Prior of the stiff-PA reference case, 81 frames to t* = 4 cut at the second collapse; `ranking` and
`searching` have polytropic bubbles, the others full physics. Designs of `ranking` are a
Sobol sequence over We 100-1000 and R_inf* .14-.30. CPU times are of the process, one thread. A run
goes on where it stopped.

`model`: nested Monte Carlo is too low about the model where no draw of the prior explains a datum,
and too high with the datum's own gel among the draws (contrastive); the truth is between, within the
error of the data, which all estimators here draw for themselves.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from botorch.utils.sampling import draw_sobol_samples
from scipy.stats import spearmanr
from torch import Tensor

from benchmarks.nested import NestedMonteCarlo, PriorContrastive
from benchmarks.records import Job, Line, run_missing_jobs, start_parser, write_table
from imr_torch.design import (
    DesignSpace,
    ExpectedInformationGain,
    InformationEstimator,
    Laplace,
    Plan,
    expected_information_gain,
    search_design,
)
from imr_torch.float64 import tensor
from imr_torch.material import reference_case
from imr_torch.random import child
from imr_torch.simulate import (
    ACCURACIES,
    PolytropicSimulator,
    Simulator,
    Solution,
    TransportSimulator,
    coarser,
)

PRIOR = reference_case("stiff-pa").prior
RECORD = Path(__file__).parent / "records" / "information_model.jsonl"
PLANS = {1: Plan(repeats=1), 100: Plan(repeats=100)}
TRUTH = Laplace(draws=500, rivals=500)
RANKED: tuple[tuple[InformationEstimator, bool], ...] = (
    *((Laplace(draws=n), common) for n in (32, 64, 128) for common in (False, True)),
    (Laplace(draws=32, refinements=0), True),
)
"""Estimators, and whether designs share draws and noise."""
SEARCHES = ((16, 1), (16, 5))
"""Draws of a model, and designs at a time."""
DESIGNS = (
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
SEEDS = 4
SEARCH = TransportSimulator(accuracy=ACCURACIES["search"], threads=1)


def space_designs(count: int) -> Tensor:
    """``count x 2`` space-filling designs."""
    return draw_sobol_samples(DesignSpace().bounds, n=count, q=1, seed=7)[:, 0]


def estimate_surface(
    points: Tensor,
    repeats: int,
    estimator: InformationEstimator,
    seed: int,
    *,
    common: bool,
) -> Tensor:
    """Gains at designs, ``n``, of polytropic bubbles."""
    values = [
        expected_information_gain(
            PRIOR,
            X[None],
            PolytropicSimulator(),
            PLANS[repeats],
            estimator=estimator,
            seed=child(seed, "common" if common else i),
        ).value
        for i, X in enumerate(points)
    ]
    return tensor(values)


def rank_designs(repeats: int) -> Line:
    """Spearman correlation of small samples' surfaces over 16 designs with one of 500 draws of each
    model, and the gain that the design loses which is best by the estimate.
    """
    points = space_designs(16)
    truth = estimate_surface(points, repeats, TRUTH, 0, common=True)
    rows = []
    for estimator, common in RANKED:
        started = time.process_time()
        found = []
        seeds = SEEDS if isinstance(estimator, Laplace) else 1
        for seed in range(1, 1 + seeds):
            values = estimate_surface(points, repeats, estimator, seed, common=common)
            loss = float(truth.max() - truth[values.argmax()])
            found.append((float(spearmanr(values, truth)[0]), loss))
        cpu = (time.process_time() - started) / seeds / len(points)
        means = tensor(found).mean(0).tolist()
        rows.append((repr(estimator), common, *means, cpu))
    return {
        "head": ("estimator", "common draws", "Spearman", "loss", "CPU a design"),
        "rows": rows,
    }


def search_designs() -> Line:
    """What the designs lose that whole searches recommend, against a grid and all designs found."""
    best = []
    seconds = []
    for draws, batch in SEARCHES:
        started = time.process_time()
        for seed in range(SEEDS):
            acquisition = ExpectedInformationGain(
                PRIOR, PolytropicSimulator(), Laplace(draws=draws), plan=PLANS[100]
            )
            found = search_design(acquisition, seed=seed, batch=batch)
            best.append(found.recommendation.design)
        seconds.append((time.process_time() - started) / SEEDS)
    points = torch.cat((torch.stack(best), space_designs(32)))
    truth = estimate_surface(points, 100, TRUTH, 0, common=True)
    losses = (truth.max() - truth[: len(best)]).reshape(len(SEARCHES), SEEDS)
    rows = [
        (*own, float(loss.mean()), float(loss.max()), cpu)
        for own, loss, cpu in zip(SEARCHES, losses, seconds, strict=True)
    ]
    head = ("draws", "designs at a time", "mean loss", "largest loss", "CPU")
    return {"head": head, "rows": rows}


def time_estimates(repeats: int) -> Line:
    """What the refinement of rivals costs with heat and vapour transport: median CPU of an estimate
    and of a whole search.
    """
    simulator = coarser(SEARCH)
    rows = []
    for name, estimator in (
        ("refined", Laplace(draws=16)),
        ("at a draw", Laplace(draws=16, refinements=0)),
    ):
        acquisition = ExpectedInformationGain(
            PRIOR, simulator, estimator, plan=PLANS[repeats]
        )
        estimates = [
            _seconds_of(partial(acquisition.estimate, point[None], seed=1))
            for point in space_designs(8)
        ]
        searches = [
            _seconds_of(partial(search_design, acquisition, seed=s)) for s in range(3)
        ]
        rows.append((name, statistics.median(estimates), statistics.median(searches)))
    return {"head": ("rivals", "an estimate, s", "a search, s"), "rows": rows}


def compare_coarse_bubbles(case: str) -> Line:
    """How far the coarse bubbles of searches move the gain of five designs, 32 draws."""
    rows = []
    for design in DESIGNS[::2]:
        X = tensor([design])
        fine, coarse = (
            expected_information_gain(
                reference_case(case).prior,
                X,
                s,
                PLANS[1],
                estimator=Laplace(draws=32),
                seed=1,
            )
            for s in (SEARCH, coarser(SEARCH))
        )
        rows.append((design, fine.value, fine.variance**0.5, coarse.value - fine.value))
    return {
        "head": ("We, R_inf*", "gain", "its Monte Carlo error", "coarse less fine"),
        "rows": rows,
    }


def _seconds_of(work: Callable[[], object]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started


class Recalled:
    """A simulator that remembers its solutions, since both brute bounds simulate the same gels."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.conditions = simulator.conditions
        self.solved: dict[object, Solution] = {}

    def __call__(self, *asked: Tensor) -> Solution:
        """See :class:`~imr_torch.simulate.Simulator`."""
        return self._recall(self.simulator, asked)

    def bundle(self, *asked: Tensor) -> Solution:
        """See :class:`~imr_torch.simulate.Simulator`."""
        return self._recall(self.simulator.bundle, asked)

    def _recall(
        self, solve: Callable[..., Solution], asked: tuple[Tensor, ...]
    ) -> Solution:
        key = solve, *(x.numpy().tobytes() for x in asked)
        if key not in self.solved:
            self.solved[key] = solve(*asked)
        return self.solved[key]


def bound_model_gain(design: tuple[float, float]) -> Line:
    """The gain about the model at one design by each estimator, as ``[value, error]`` in nats."""
    recalled = Recalled(SEARCH)
    X = tensor([design])
    line: Line = {"design": design}
    for name, estimator, seeds, used in (
        ("nested", NestedMonteCarlo(600, 15000), 1, recalled),
        ("contrastive", PriorContrastive(600, 15000), 1, recalled),
        ("refined", Laplace(32, 32), 16, SEARCH),
        ("at a draw", Laplace(32, 32, refinements=0), 16, SEARCH),
    ):
        gains = [
            expected_information_gain(
                PRIOR, X, used, PLANS[1], estimator=estimator, seed=child(11, s)
            )
            for s in range(seeds)
        ]
        error = sum(g.of_target("model").variance for g in gains) ** 0.5 / seeds
        line[name] = (statistics.fmean(g.model for g in gains), error)
    return line


def write_bounds(lines: Sequence[Line]) -> str:
    """The gains about the model at each design."""
    names = ("nested", "contrastive", "refined", "at a draw")
    rows = [
        (line["design"], *(f"{line[n][0]:.3f} +- {line[n][1]:.3f}" for n in names))
        for line in lines
    ]
    return write_table(("We, R_inf*", *names), rows)


def main() -> None:
    """Measure and tabulate."""
    parser = start_parser(__doc__)
    parser.add_argument("part", choices=("model", "ranking", "searching", "cost", "coarse"))
    parser.add_argument("--out", type=Path, default=RECORD, metavar="OUT.jsonl")
    parser.add_argument("--workers", type=int, default=1, help="processes, one thread each")
    args = parser.parse_args()
    jobs: dict[str, dict[str, Job]] = {
        "model": {
            f"model/{design}": partial(bound_model_gain, design) for design in DESIGNS
        },
        "ranking": {f"ranking/{n} curves": partial(rank_designs, n) for n in PLANS},
        "searching": {"searching": search_designs},
        "cost": {f"cost/{n} curves": partial(time_estimates, n) for n in PLANS},
        "coarse": {
            f"coarse/{c}": partial(compare_coarse_bubbles, c)
            for c in ("stiff-pa", "soft-pa")
        },
    }
    lines = run_missing_jobs(args.out, jobs[args.part], workers=args.workers)
    if args.part == "model":
        print(write_bounds(lines))
        return
    for line in lines:
        print(f"{line['key']}\n\n{write_table(line['head'], line['rows'])}\n")


if __name__ == "__main__":
    main()
