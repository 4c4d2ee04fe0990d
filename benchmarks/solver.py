"""Speed and accuracy of both engines: process CPU time (on a GPU wall time), one thread, medians
over repeats.

  python -m benchmarks.solver [--repeats 5] [--device cpu]

Bubbles are drawn from the prior of the stiff-PA reference case, designs uniformly from We 100-1000
and R_inf* .14-.30, with 81 samples of t* in [0, 4]; every call that is timed has bubbles of its
own. Errors of the polytropic solver are against itself at a third of the step, those of the full
physics against its `reference` setting. Beside them, in the same run, SciPy bubble by bubble; other
solvers are those of :mod:`benchmarks.peers`.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from benchmarks.records import start_parser
from imr_torch.float64 import linspace, rand, tensor
from imr_torch.material import reference_case
from imr_torch.random import generator
from imr_torch.simulate import (
    ACCURACIES,
    STEPPINGS,
    PolytropicSimulator,
    Simulator,
    TransportSimulator,
)
from tests.simulate.scipy_reference import solve_by_scipy

TIMES = linspace(0.0, 4.0, 81)


def draws(count: int, device: str, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Parameters ``count x p`` and designs ``count x 2`` of the benchmark."""
    parameters = reference_case("stiff-pa").prior.sample(count, seed=seed).parameters
    unit = rand(count, 2, generator=generator(seed + 1))
    low, high = tensor([[100.0, 0.14], [1000.0, 0.30]])
    return parameters.to(device), (low + (high - low) * unit).to(device)


def seconds_of(work: Callable[[], Any], repeats: int, device: str = "cpu") -> float:
    """Median process CPU time of ``work`` after one warm-up.

    On a GPU wall time until the device is done.
    """

    def now() -> float:
        if device == "cpu":
            return time.process_time()
        torch.cuda.synchronize()
        return time.perf_counter()

    work()
    taken = []
    for _ in range(repeats):
        started = now()
        work()
        taken.append(now() - started)
    return float(np.median(taken))


def simulate(simulator: Simulator, count: int, device: str, seed: int = 0) -> torch.Tensor:
    """The radii of ``count`` bubbles."""
    parameters, designs = draws(count, device, seed)
    return simulator(parameters, designs, TIMES.to(device)).radius


def milliseconds(
    simulator: Simulator, count: int, repeats: int, device: str = "cpu"
) -> float:
    """Median milliseconds a bubble in batches of ``count``.

    New bubbles in each.
    """
    batches = iter([draws(count, device, seed) for seed in range(100, 101 + repeats)])
    times = TIMES.to(device)

    def work() -> None:
        parameters, designs = next(batches)
        simulator(parameters, designs, times)

    return 1e3 * seconds_of(work, repeats, device) / count


def errors(
    simulator: Simulator, reference: Simulator, count: int, device: str = "cpu"
) -> tuple[float, float]:
    """Median and largest over bubbles of the largest error in R*; those of the reference are made
    here.
    """
    radius = simulate(simulator, count, device).cpu()
    error = (radius - simulate(reference, count, "cpu")).abs().amax(1)
    return float(error.median()), float(error.max())


def speedup(count: int, repeats: int) -> float:
    """Wall time of one thread over that of two, median of pairs taken in turn."""
    ratios = []
    for pair in range(repeats):
        taken = []
        for threads in (1, 2):
            bubbles = draws(count, "cpu", 100 + 2 * pair + threads)
            started = time.perf_counter()
            TransportSimulator(threads=threads)(*bubbles, TIMES)
            taken.append(time.perf_counter() - started)
        ratios.append(taken[0] / taken[1])
    return float(np.median(ratios))


def compile_seconds() -> float:
    """Process CPU time of compiling both entry points into an empty folder, in a process of its
    own.
    """
    with tempfile.TemporaryDirectory() as folder:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "imr_torch.simulate.compiled"]
        subprocess.run(
            command,
            env=os.environ | {"IMR_TORCH_CACHE": folder},
            check=True,
            capture_output=True,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def scipy_bdf(count: int) -> None:
    """Bubbles with transport by SciPy, one after the other."""
    parameters, designs = draws(count, "cpu")
    simulator = TransportSimulator()
    for bubble in zip(parameters, designs, strict=True):
        solve_by_scipy(
            (*bubble, TIMES),
            conditions=simulator.conditions,
            resolution=simulator.accuracy.resolution,
        )


def measure_device(device: str) -> dict[str, float]:
    """Milliseconds of wall time a bubble by the tensor engine there, and the largest differences
    from the compiled engine.
    """
    result: dict[str, float] = {}
    simulators: tuple[Simulator, ...] = (TransportSimulator(), PolytropicSimulator())
    for simulator in simulators:
        name = type(simulator).__name__
        result[f"{name}_max_difference"] = errors(simulator, simulator, 1000, device)[1]
        for count in (48, 1000, 10_000, 100_000):
            torch.cuda.reset_peak_memory_stats()
            repeats = 3 if count < 10_000 else 1
            result[f"{name}_{count}_ms"] = milliseconds(simulator, count, repeats, device)
            result[f"{name}_{count}_mib"] = torch.cuda.max_memory_allocated() / 2**20
            print(name, count, result[f"{name}_{count}_ms"], "ms a bubble", flush=True)
    return result


def main() -> None:
    """Measure, print, write."""
    parser = start_parser(__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    torch.set_num_threads(1)
    on_processor = args.device == "cpu"
    result = (
        measure_processor(args.repeats) if on_processor else measure_device(args.device)
    )
    print(json.dumps(result, indent=1))


def measure_processor(repeats: int) -> dict[str, float]:
    """Everything of the compiled engine, and of what it is compared with."""
    full = TransportSimulator(threads=1)
    polytropic = PolytropicSimulator(threads=1)
    finer = replace(
        STEPPINGS["default"], step=STEPPINGS["default"].step / 3.0, max_steps=10**6
    )
    sharp = TransportSimulator(accuracy=ACCURACIES["reference"])
    result = {"compile_s": compile_seconds()}
    for name, simulator, reference, counts in (
        ("full", full, sharp, (1, 8, 48, 1000)),
        ("polytropic", polytropic, PolytropicSimulator(stepping=finer), (1, 48, 1000)),
    ):
        median, largest = errors(simulator, reference, 1000)
        result |= {f"{name}_median_dr": median, f"{name}_max_dr": largest}
        for count in counts:
            many = 9 * repeats if count < 10 else repeats
            result[f"{name}_{count}_ms"] = milliseconds(simulator, count, many)
    tensors = TransportSimulator(engine="torchdiffeq")
    for count in (48, 1000):
        result[f"tensor_{count}_ms"] = milliseconds(tensors, count, 1)
    result["speedup_2_threads"] = speedup(1000, repeats)
    return result | {"scipy_bdf_full_s": seconds_of(lambda: scipy_bdf(3), 1) / 3}


if __name__ == "__main__":
    main()
