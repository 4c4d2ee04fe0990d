"""What measured curves say of their gels: every file of a folder through `characterize`, and what
looks wrong.

  python benchmarks/real_data.py FOLDER [--sets gelatin,pa] [--curves 2] [--scores] [--out
  out/real_data]

FOLDER holds one CSV file a gel, as `load_traces` reads them. Heat and vapour transport, wide prior
over three models, Rmax, time zero and R_inf of each curve uncertain, noise estimated, window of two
collapses. Records without a tail are given R_inf/Rmax = .2 +- .08. Each result is appended as it
comes, so a run that was cut off continues. `--scores` adds held-out log densities, for which fits
are made again.
"""

import argparse
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch

from imr_torch import characterize, load_traces
from imr_torch.assimilate import ModelFit, SearchOptions, Verdict
from imr_torch.characterization import Characterization, predictive_band
from imr_torch.errors import ImrError, InputDataError
from imr_torch.observe import NUISANCES, TraceSet, collapse_time, find_landmarks, prepare
from imr_torch.results.plot import plot_experiment
from imr_torch.simulate import (
    Conditions,
    PolytropicSimulator,
    Simulator,
    Solution,
    TransportSimulator,
)

REST = (0.2, 0.08)
SEED = 0
SIMULATORS = {"full": TransportSimulator, "polytropic": PolytropicSimulator}
_DROP_BEHIND = 50.0  # nats by which a model must be behind to be left there
_LARGE_RMSE = 0.03
_LARGE_NOISE = 2.0
_FAR = 2.5
_ODD = 2.0
# relative scatter of the first collapse times above which curves are unlikely to be of one gel
_ONE_GEL = 0.2


@dataclass
class Counting:
    """A simulator that counts what it is asked for: the cost of a fit."""

    simulator: Simulator
    bubbles: int = 0

    @property
    def conditions(self) -> Conditions:
        """Those of the simulator."""
        return self.simulator.conditions

    def __call__(
        self, parameters: torch.Tensor, designs: torch.Tensor, times: torch.Tensor
    ) -> Solution:
        """Simulate and count."""
        return self._counted(self.simulator(parameters, designs, times))

    def bundle(
        self, parameters: torch.Tensor, designs: torch.Tensor, times: torch.Tensor
    ) -> Solution:
        """Simulate and count."""
        return self._counted(self.simulator.bundle(parameters, designs, times))

    def _counted(self, solution: Solution) -> Solution:
        self.bubbles += solution.status.numel()
        return solution


@dataclass(frozen=True)
class Task:
    """One gel.

    Args:
        file: its curves.
        curves: most that are fitted, evenly spread over the file; 0 for all.
        scores: whether to hold curves out.
        options: how the assimilation searches.
        figures: folder of the figures.
    """

    file: Path
    curves: int
    scores: bool
    figures: Path
    options: SearchOptions = field(default_factory=SearchOptions)

    def __call__(self, simulator: Simulator) -> dict[str, Any]:
        """The row of this gel, JSON-ready."""
        counting = Counting(simulator)
        print_ = partial(print, f"{self.file.stem}:", flush=True)
        name = {"set": self.file.stem}
        try:
            traces = some(load_traces(self.file), self.curves)
            tail = all(find_landmarks(trace).rest_radius_m is not None for trace in traces)
            scores = self.scores and len(traces) > 1
            fit = partial(
                characterize,
                traces,
                simulator=counting,
                options=self.options,
                scores=scores,
                seed=SEED,
                progress=print_,
            )
            result = fit() if tail else fit(rest_radius=REST)
            self._draw(result, simulator)
        except ImrError as error:
            return name | {
                "failure": f"{type(error).__name__}: {error}",
                "bubbles": counting.bubbles,
            }
        return name | _row(result, rest_assumed=not tail) | {"bubbles": counting.bubbles}

    def _draw(self, result: Characterization, simulator: Simulator) -> None:
        """Curves with the predictive band of the most probable model."""
        best = result.posterior.best.model
        band = predictive_band(
            result.assimilation, result.posterior, simulator, best, draws=64, seed=SEED
        )
        count = min(3, len(result.experiments))
        figure, axes = plt.subplots(
            1, count, figsize=(4.2 * count, 3.2), layout="constrained", squeeze=False
        )
        for e, ax in enumerate(axes[0]):
            plot_experiment(result.experiments[e], (band[0][e], band[1][e], band[2][e]), ax=ax)
        figure.suptitle(f"{self.file.stem}: {best}", fontsize=10)
        self.figures.mkdir(parents=True, exist_ok=True)
        figure.savefig(self.figures / f"{self.file.stem}.png", dpi=80)
        plt.close(figure)


def some(traces: TraceSet, most: int) -> TraceSet:
    """At most so many traces (0: any number), evenly spread over those long enough; all if none is,
    to learn why.
    """
    names = [
        name
        for name in (trace.experiment_id for trace in traces)
        if _long_enough(traces.select([name]))
    ]
    kept = (
        [names[(2 * i + 1) * len(names) // (2 * most)] for i in range(most)]
        if 0 < most < len(names)
        else names
    )
    return traces.select(kept) if kept else traces


def _long_enough(trace: TraceSet) -> bool:
    try:
        prepare(trace, rest_radius=REST)
    except InputDataError:
        return False
    return True


def _row(result: Characterization, *, rest_assumed: bool) -> dict[str, Any]:
    """Everything the table shows."""
    document = result.to_dict()
    best = result.assimilation[result.posterior.best.model]
    return {
        "curves": len(result.experiments),
        "rest_assumed": rest_assumed,
        "best": best.model,
        "model_probabilities": document["model_probabilities"],
        "models": document["models"],
        "noise": document["noise"],
        "scores": document["scores"],
        "remarks": remarks(result, best),
    }


def remarks(result: Characterization, best: ModelFit) -> list[str]:
    """What looks wrong about the most probable model."""
    found = []
    batch = result.assimilation.batch
    rmse = result.assimilation.rmse(best.model)
    if not best.certificate.converged:
        found.append("not converged")
    if best.verdict is Verdict.REFUSED:
        found.append("Gaussian answer refused")
    if rmse > _LARGE_RMSE:
        found.append(f"misses the data (RMSE {rmse:.3f})")
    if batch.noise.scale > _LARGE_NOISE:
        found.append(f"residuals {batch.noise.scale:.1f} x the published noise")
    for name, value in zip(best.prior.names, best.mean.tolist(), strict=True):
        if abs(value) > _FAR:
            found.append(f"{name} {value:+.1f} prior sd")
    for e, row in enumerate(best.nuisances.tolist()):
        found += [
            f"{batch.experiments[e].label}: {n} {w:+.1f} sd"
            for n, w in zip(NUISANCES, row, strict=True)
            if abs(w) > _FAR
        ]
    return found + _odd_curves(result, best) + _where(result, best)


def _odd_curves(result: Characterization, best: ModelFit) -> list[str]:
    """Curves that are not like the others: in their residual, or in when they collapse."""
    each = result.assimilation.rmse_by_experiment(best.model)
    middle = sorted(each.values())[len(each) // 2]
    found = [
        f"{label}: RMSE {value:.3f}"
        for label, value in each.items()
        if len(each) > 2 and value > _ODD * middle
    ]
    collapses = torch.tensor([collapse_time(e.times, e.radius[0], 1) for e in result.experiments])
    collapses = collapses[torch.isfinite(collapses)]
    if len(collapses) > 1 and float(collapses.amax() / collapses.amin()) > 1.0 + _ONE_GEL:
        found.append(
            f"first collapses at t* {float(collapses.amin()):.2f} to {float(collapses.amax()):.2f}"
        )
    return found


def _where(result: Characterization, best: ModelFit) -> list[str]:
    """Whether residuals crowd before or after the first collapse, in units of the noise."""
    batch = result.assimilation.batch
    before = []
    after = []
    square = ((batch.mean - best.prediction) / batch.sd(best.prediction)).square()
    for e, experiment in enumerate(result.experiments):
        first = collapse_time(experiment.times, experiment.radius[0], 1)
        early = batch.mask[e] & (batch.times[e] < first)
        before.append(square[e][early])
        after.append(square[e][batch.mask[e] & ~early])
    early, late = (torch.cat(rows).mean().sqrt() for rows in (before, after))
    if (
        not float(torch.maximum(early / late, late / early)) > _ODD
    ):  # nor where one of them holds no frame
        return []
    return [
        f"residuals {float(early):.1f} sd before the first collapse, {float(late):.1f} sd after"
    ]


def table(rows: Iterable[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| set | curves | model, probability | G (kPa) | mu (Pa s) | alpha | RMSE in R* "
        "| noise: x published, least in R*, corr. time | trust | held out, nats over the next | "
        "bubbles | what looks wrong |",
        "|" + "---|" * 12,
    ]
    return "\n".join(lines + [_line(row) for row in rows])


def _line(row: dict[str, Any]) -> str:
    if "failure" in row:
        return f"| {row['set']} | | {row['failure']} |" + " |" * 9
    model = row["models"][row["best"]]
    noise = row["noise"]
    answer = model["draws"].removeprefix("intervals ")
    cells = [
        row["set"],
        f"{row['curves']}{', R_inf assumed' if row['rest_assumed'] else ''}",
        ", ".join(
            f"{key} {p:.3f}"
            for key, p in sorted(row["model_probabilities"].items(), key=lambda kv: -kv[1])
            if p > 0.02
        ),
        *(
            _interval(model["intervals"].get(name), scale)
            for name, scale in (("G", 1e-3), ("mu", 1.0), ("alpha", 1.0))
        ),
        f"{model['rmse']:.3f}",
        f"{noise['scale']:.2f}, {noise['scale'] * noise['floor']:.4f}, "
        f"{noise['correlation_time']:g}",
        answer.removesuffix(")") + ")",
        _score(row["scores"]),
        str(row["bubbles"]),
        "; ".join(row["remarks"]),
    ]
    return "| " + " | ".join(cells) + " |"


def _interval(values: list[float] | None, scale: float) -> str:
    if values is None:
        return ""
    low, middle, high = (scale * x for x in values)
    return f"{middle:.3g} ({low:.3g}-{high:.3g})"


def _score(scores: dict[str, Any] | None) -> str:
    if scores is None:
        return ""
    order = sorted(scores.items(), key=lambda item: -item[1]["value"])
    gap = order[0][1]["value"] - order[1][1]["value"]
    error = (order[0][1]["error"] ** 2 + order[1][1]["error"] ** 2) ** 0.5
    return f"{order[0][0]} by {gap:.1f} +- {error:.1f}"


def chosen_files(folder: Path, begin_with: str | None) -> list[Path]:
    """CSV files of a folder.

    Those whose names begin with one of some words, comma-separated, in the order of the words.
    """
    files = sorted(folder.glob("*.csv"))
    return (
        [f for begin in begin_with.split(",") for f in files if f.stem.startswith(begin)]
        if begin_with
        else files
    )


def run_missing(
    tasks: Mapping[str, Callable[[Simulator], dict[str, Any]]],
    path: Path,
    simulator: Simulator,
    *,
    line: Callable[[dict[str, Any]], str],
) -> list[dict[str, Any]]:
    """Run the tasks that have no row in a file yet, and append theirs.

    Args:
        tasks: name of a set -> what makes its row.
        path: the file, one JSON row a line.
        simulator: makes the bubbles of all.
        line: a row as a line of the table, printed as it comes.

    Returns:
        Rows of all tasks, in their order.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = (
        {row["set"]: row for row in map(json.loads, path.read_text().splitlines())}
        if path.exists()
        else {}
    )
    missing = [task for name, task in tasks.items() if name not in rows]
    with path.open("a") as stream:
        for task in missing:
            row = task(simulator)
            stream.write(json.dumps(row) + "\n")
            stream.flush()
            rows[row["set"]] = row
            print(line(row), flush=True)
    return [rows[name] for name in tasks]


def main() -> None:
    """Fit what is missing and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--sets",
        help="only files whose names begin with one of these, comma-separated, in this order",
    )
    parser.add_argument(
        "--curves", type=int, default=2, help="most curves of a file, evenly spread; 0 for all"
    )
    parser.add_argument("--scores", action="store_true", help="also hold curves out")
    parser.add_argument("--physics", choices=tuple(SIMULATORS), default="full")
    parser.add_argument(
        "--starts", type=int, default=SearchOptions.starts, help="searches per model"
    )
    parser.add_argument(
        "--raw-samples",
        type=int,
        default=SearchOptions.raw_samples,
        help="prior draws from which searches start",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/real_data"), help="folder of results and figures"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    path = args.out / f"rows-{args.physics}-{args.curves}{'-scores' if args.scores else ''}.jsonl"
    options = SearchOptions(
        starts=args.starts, raw_samples=args.raw_samples, drop_behind=_DROP_BEHIND
    )
    tasks = {
        f.stem: Task(f, args.curves, args.scores, args.out, options)
        for f in chosen_files(args.folder, args.sets)
    }
    rows = run_missing(tasks, path, SIMULATORS[args.physics](threads=1), line=_line)
    print("\n" + table(rows))


if __name__ == "__main__":
    main()
