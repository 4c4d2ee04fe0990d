"""Speed-up by worker processes: wall time of one batch, full physics, pool already running.

  python benchmarks/parallel.py [--count 2000] [--workers 1,2] [--json OUT]

Bubbles as in `benchmarks/solver.py`. Times are medians of three, beside the simulator in this process; the results of all
runs must be the same bit for bit, which is checked. Only on an idle machine do the figures mean anything.
"""

import argparse
import json
import time

import numpy as np
import torch
from solver import TIMES, draws

from imr_torch.files import write_json
from imr_torch.simulate import ParallelSimulator, Simulator, TransportSimulator, process_pool


def wall_seconds(simulator: Simulator, count: int) -> tuple[float, torch.Tensor]:
    """Median wall time of a batch of ``count``, and its radii."""
    parameters, designs = draws(count, "cpu")
    taken, radius = [], torch.empty(0)
    for _ in range(3):
        started = time.perf_counter()
        radius = simulator(parameters, designs, TIMES).radius
        taken.append(time.perf_counter() - started)
    return float(np.median(taken)), radius


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--workers", default="1,2", metavar="N,...")
    parser.add_argument("--json", metavar="OUT")
    args = parser.parse_args()
    torch.set_num_threads(1)
    simulator, results = TransportSimulator(), []
    result = {"here_s": wall_seconds(simulator, args.count)[0]}
    for workers in map(int, args.workers.split(",")):
        with process_pool(workers) as pool:
            parallel = ParallelSimulator(simulator, pool)
            parallel(*draws(250 * workers, "cpu"), TIMES[:2])  # processes start and import
            result[f"workers_{workers}_s"], radius = wall_seconds(parallel, args.count)
        results.append(radius)
    if any(not torch.equal(radius, results[0]) for radius in results):
        raise SystemExit("results depend on the number of workers")
    print(json.dumps(result, indent=1))
    if args.json:
        write_json(args.json, result)


if __name__ == "__main__":
    main()
