"""What a bubble costs: against batch size, tolerance and modes, with the error that each setting
leaves.

  python benchmarks/solver_cost.py [--out benchmarks/figures] [--device cpu]

Bubbles as in ``solver.py``. Errors are the largest over time, median and worst over 200 bubbles,
against the `reference` setting. Writes ``solver_cost.png`` and ``solver_cost.json``.
"""

import argparse
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import torch
from solver import errors, seconds_of, simulate

from imr_torch.files import write_json
from imr_torch.simulate import (
    ACCURACIES,
    Accuracy,
    PolytropicSimulator,
    Resolution,
    Simulator,
    TransportSimulator,
)

BATCHES = (1, 3, 10, 30, 100, 300, 1000, 3000, 10000)
TOLERANCES = (3e-3, 1e-3, 3e-4, 1e-4, 3e-5)
MODES = ((8, 8), (12, 12), (16, 16), (20, 24), (26, 32))
COUNT = 200  # bubbles of the error panels


def cost(simulator: Simulator, count: int, device: str) -> float:
    """Milliseconds a bubble in a batch of ``count``."""
    return (
        1e3
        * seconds_of(simulate(simulator, count, device), 1 if count > 1000 else 3, device)
        / count
    )


def accuracy_row(accuracy: Accuracy, device: str) -> tuple[float, float, float]:
    """Milliseconds a bubble, median and worst error of a setting."""
    simulator = TransportSimulator(accuracy=accuracy)
    reference = TransportSimulator(accuracy=ACCURACIES["reference"])
    return cost(simulator, COUNT, device), *errors(simulator, reference, COUNT, device)


def plot(result: dict[str, dict[str, tuple[float, ...]]]) -> plt.Figure:
    """Three panels: batch, tolerance, modes."""
    figure, axes = plt.subplots(1, 3, figsize=(12.0, 3.6), layout="constrained")
    for name in ("full physics", "polytropic"):
        axes[0].loglog(BATCHES, [row[0] for row in result[name].values()], "o-", label=name)
    axes[0].set(xlabel="batch", ylabel="ms a bubble", title="cost against batch")
    axes[0].legend()
    for panel, key in zip(axes[1:], ("tolerance", "modes"), strict=True):
        labels = list(result[key])
        rows = list(result[key].values())
        panel.semilogy(labels, [row[1] for row in rows], "o-", label="median error")
        panel.semilogy(labels, [row[2] for row in rows], "s-", label="worst error")
        panel.set(
            xlabel=key,
            ylabel="largest error in R* over time",
            title=f"cost and error against {key}",
        )
        right = panel.twinx()
        right.plot(labels, [row[0] for row in rows], "^--", color="0.5", label="ms a bubble")
        right.set(ylabel="ms a bubble", ylim=(0.0, None))
        panel.legend(loc="upper right")
    return figure


def main() -> None:
    """Measure, plot, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", metavar="DIR", default="benchmarks/figures")
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    torch.set_num_threads(1)
    mpl.use("agg")
    simulators = {"full physics": TransportSimulator(), "polytropic": PolytropicSimulator()}
    result: dict[str, dict[str, tuple[float, ...]]] = {
        name: {str(count): (cost(solver, count, args.device),) for count in BATCHES}
        for name, solver in simulators.items()
    }
    result["tolerance"] = {
        f"{t:g}": accuracy_row(Accuracy(tolerance=t), args.device) for t in TOLERANCES
    }
    result["modes"] = {
        f"{n}+{m}": accuracy_row(Accuracy(resolution=Resolution(n, m)), args.device)
        for n, m in MODES
    }
    for name, rows in result.items():
        for key, row in rows.items():
            print(f"{name:13} {key:>6}  " + "  ".join(f"{value:9.3g}" for value in row))
    folder = Path(args.out)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "solver_cost.json", result)
    plot(result).savefig(folder / "solver_cost.png", dpi=120)


if __name__ == "__main__":
    main()
