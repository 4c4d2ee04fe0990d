"""Speed and accuracy of the simulators: process CPU time (on a GPU wall time), one thread, medians over repeats.

  python benchmarks/solver.py [--json OUT] [--repeats 5] [--device cpu]

Bubbles are drawn from the prior of the stiff-PA reference case, designs uniformly from We 100-1000 and R_inf* .14-.30, with
81 samples of t* in [0, 4]. Errors of the polytropic solver are against itself at a third of the step, those of the full
physics against its `reference` setting. Beside them, in the same run, what a user would do without this
package: torchdiffeq's dopri5 with one step for the batch, and a loop over bubbles with SciPy.
"""

import argparse
import json
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torchdiffeq import odeint

from imr_torch.files import write_json
from imr_torch.material import reference_case
from imr_torch.simulate import (
    ACCURACIES,
    STEPPINGS,
    Conditions,
    PolytropicSimulator,
    ScipySimulator,
    Simulator,
    TransportSimulator,
)
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.polytropic import head_of, rate_of

TIMES = torch.linspace(0.0, 4.0, 81, dtype=torch.float64)


def draws(count: int, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Parameters ``count x p`` and designs ``count x 2`` of the benchmark."""
    parameters = reference_case("stiff-pa").prior.sample(count, seed=0).parameters
    unit = torch.rand(count, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    low, high = torch.tensor([[100.0, 0.14], [1000.0, 0.30]], dtype=torch.float64)
    return parameters.to(device), (low + (high - low) * unit).to(device)


def seconds_of(work: Callable[[], Any], repeats: int, device: str = "cpu") -> float:
    """Median process CPU time of ``work`` after one warm-up; on a GPU wall time until the device is done."""

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


def simulate(simulator: Simulator, count: int, device: str) -> Callable[[], torch.Tensor]:
    """The radii of ``count`` bubbles, when called."""
    parameters, designs = draws(count, device)
    return lambda: simulator(parameters, designs, TIMES.to(device)).radius


def errors(simulator: Simulator, reference: Simulator, count: int, device: str) -> tuple[float, float]:
    """Median and largest over bubbles of the largest error in R*."""
    error = (simulate(simulator, count, device)() - simulate(reference, count, device)()).abs().amax(1)
    return float(error.median()), float(error.max())


def plain_dopri5(count: int) -> Callable[[], Any]:
    """The same bubbles by torchdiffeq with one adaptive step for the whole batch."""
    parameters, designs = draws(count, "cpu")
    bubbles = Bubbles.of(parameters, designs, Conditions())
    one = torch.ones(count, dtype=torch.float64)
    start = torch.stack((one, 0.0 * one, 0.0 * one))

    def rate(_: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        return rate_of(bubbles, head_of(bubbles, state), state)

    return lambda: odeint(rate, start, TIMES, method="dopri5", rtol=1e-5, atol=1e-7)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="OUT")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    torch.set_num_threads(1)
    result: dict[str, float] = {}
    for name, stepping in STEPPINGS.items():
        simulator = PolytropicSimulator(stepping=stepping)
        finer = PolytropicSimulator(stepping=replace(stepping, step=stepping.step / 3.0, max_steps=10**6))
        median, largest = errors(simulator, finer, 1000, args.device)
        result[f"polytropic_1000_ms_{name}"] = seconds_of(simulate(simulator, 1000, args.device), args.repeats, args.device)
        result |= {f"polytropic_median_dr_{name}": median, f"polytropic_max_dr_{name}": largest}
    for count in (1, 48, 10000):
        seconds = seconds_of(simulate(PolytropicSimulator(), count, args.device), args.repeats, args.device)
        result[f"polytropic_{count}_ms"] = 1e3 * seconds / count
    result["polytropic_1000_ms"] = result["polytropic_1000_ms_default"]
    full = TransportSimulator()
    result["full_1000_ms"] = seconds_of(simulate(full, 1000, args.device), args.repeats, args.device)
    result["full_48_ms"] = 1e3 * seconds_of(simulate(full, 48, args.device), args.repeats, args.device) / 48
    result["full_1_s"] = seconds_of(simulate(full, 1, args.device), args.repeats, args.device)
    result["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if args.device != "cpu":
        result["full_100000_ms"] = 1e-2 * seconds_of(simulate(full, 100_000, args.device), 1, args.device)
    reference = TransportSimulator(accuracy=ACCURACIES["reference"])
    result["median_dr"], result["max_dr"] = errors(full, reference, 1000, args.device)
    try:
        result["dopri5_48_ms"] = 1e3 * seconds_of(plain_dopri5(48), 1) / 48
    except AssertionError as error:  # torchdiffeq's word for a step that shrank to nothing
        print(f"plain dopri5 with one step for 48 bubbles fails: {error}")
    loop = ScipySimulator(physics="polytropic", method="LSODA")
    result["scipy_lsoda_ms"] = 1e3 * seconds_of(simulate(loop, 10, "cpu"), 1) / 10
    stiff = ScipySimulator(method="BDF", rtol=1e-5, atol=1e-7)
    result["scipy_bdf_full_s"] = seconds_of(simulate(stiff, 3, "cpu"), 1) / 3
    result["scipy_bdf_full_max_dr"] = errors(stiff, reference, 3, "cpu")[1]
    print(json.dumps(result, indent=1))
    if args.json:
        write_json(args.json, result)


if __name__ == "__main__":
    main()
