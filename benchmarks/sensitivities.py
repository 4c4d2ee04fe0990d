"""Cost and accuracy of sensitivities: process CPU time, one thread, medians over repeats.

  python benchmarks/sensitivities.py [--repeats 3] [--largest 1000]

The bubbles of `benchmarks/solver.py`. Cost: time of a solve with k columns over that of the solve
alone. Accuracy: against the same at a step tolerance (polytropic: a step) far below, as shares of
the largest sensitivity over time. Beside the columns, what autograd takes for the gradient of one
sum of squares over all parameters and the design.
"""

import argparse
from dataclasses import replace

import torch
from solver import TIMES, cpu_seconds, draws

from imr_torch.material import PARAMETERS
from imr_torch.simulate import (
    Accuracy,
    PolytropicSimulator,
    Simulator,
    Stepping,
    TransportSimulator,
    sensitivities,
)

NAMES = ("G", "mu", "alpha", "weber", "rest_radius")


def cost(simulator: Simulator, count: int, repeats: int) -> None:
    """Print the seconds of a solve, and its multiples with columns."""
    parameters, designs = draws(count, "cpu")
    alone = cpu_seconds(lambda: simulator(parameters, designs, TIMES), repeats)
    words = []
    for k in (2, 4, 8):
        names = (NAMES * 2)[:k]
        columns = cpu_seconds(
            lambda names=names: sensitivities(simulator, parameters, designs, TIMES, names=names),
            repeats,
        )
        words.append(f"{columns / alone:.2f} with {k}")
    print(
        f"{type(simulator).__name__:20s} batch {count:5d}: {1e3 * alone / count:8.2f} ms alone, "
        "times " + ", ".join(words)
    )


def accuracy(simulator: Simulator, reference: Simulator, count: int) -> None:
    """Print the error of each column."""
    parameters, designs = draws(count, "cpu")
    column = PARAMETERS.index(["alpha"])[0]
    parameters[:, column] = parameters[:, column].clamp_min(0.01)
    found, exact = (
        sensitivities(s, parameters, designs, TIMES, names=NAMES)[1] for s in (simulator, reference)
    )
    error = (found - exact).abs().amax(1) / exact.abs().amax(1)
    shares = zip(NAMES, error.median(0).values.tolist(), error.amax(0).tolist(), strict=True)
    print(f"{type(simulator).__name__:20s} error, median and worst of {count}:", end=" ")
    print(", ".join(f"{name} {median:.1e} {worst:.1e}" for name, median, worst in shares))


def gradient(simulator: Simulator, count: int, repeats: int) -> None:
    """Print the time of one gradient by autograd as a multiple of the solve."""
    parameters, designs = draws(count, "cpu")
    inputs = (parameters.requires_grad_(), designs.requires_grad_())
    with torch.no_grad():
        alone = cpu_seconds(lambda: simulator(*inputs, TIMES), repeats)
    work = cpu_seconds(
        lambda: torch.autograd.grad(simulator(*inputs, TIMES).radius.square().sum(), inputs),
        repeats,
    )
    print(
        f"{type(simulator).__name__:20s} batch {count:5d}: one gradient by autograd "
        f"{work / alone:.2f}"
    )


def main() -> None:
    """Run everything."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--largest", type=int, default=1000)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    transport = TransportSimulator()
    polytropic = PolytropicSimulator()
    for simulator in (transport, polytropic):
        for count in (1, 48, arguments.largest):
            cost(simulator, count, arguments.repeats)
        gradient(simulator, 48, arguments.repeats)
    accuracy(transport, replace(transport, accuracy=Accuracy(1e-6)), 100)
    accuracy(polytropic, PolytropicSimulator(stepping=Stepping(0.03)), 100)


if __name__ == "__main__":
    main()
