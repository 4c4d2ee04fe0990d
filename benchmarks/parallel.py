"""What worker processes cost and gain: one batch with full physics, here and on pools that are
already running.

  python benchmarks/parallel.py [--count 2000] [--workers 1,2] [--chunk 500] [--json OUT]

Bubbles as in `benchmarks/solver.py`. CPU time is that of all processes, less what they took to
start; wall time means something on an idle machine only. That results are the same bit for bit on
every pool is checked.
"""

import argparse
import json
import resource
import time
from functools import partial

import torch
from solver import TIMES, draws

from imr_torch.files import write_json
from imr_torch.simulate import ParallelSimulator, Simulator, TransportSimulator, process_pool


def cpu_seconds() -> float:
    """CPU time of this process and of its children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def run(simulator: Simulator, count: int) -> tuple[float, torch.Tensor]:
    """Wall time of a batch of ``count``, and its radii."""
    started = time.perf_counter()
    radius = simulator(*draws(count, "cpu"), TIMES).radius
    return time.perf_counter() - started, radius


def run_on(workers: int, count: int, chunk: int) -> tuple[float, float, torch.Tensor]:
    """Wall and CPU time of a batch of ``count`` on running ``workers``, and its radii."""
    used = []
    wall = 0.0
    radius = torch.empty(0)
    for work in (False, True):
        before = cpu_seconds()
        with ParallelSimulator(
            TransportSimulator(), partial(process_pool, workers), chunk=chunk
        ) as parallel:
            parallel(*draws(chunk * workers, "cpu"), TIMES[:2])  # processes start and import
            if work:
                wall, radius = run(parallel, count)
        used.append(cpu_seconds() - before)
    return wall, used[1] - used[0], radius


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--workers", default="1,2", metavar="N,...")
    parser.add_argument("--chunk", type=int, default=500)
    parser.add_argument("--json", metavar="OUT")
    args = parser.parse_args()
    torch.set_num_threads(1)
    started = cpu_seconds()
    wall, _ = run(TransportSimulator(), args.count)
    result = {"here_wall_s": wall, "here_cpu_s": cpu_seconds() - started}
    radii = []
    for workers in map(int, args.workers.split(",")):
        wall, used, radius = run_on(workers, args.count, args.chunk)
        result |= {f"workers_{workers}_wall_s": wall, f"workers_{workers}_cpu_s": used}
        radii.append(radius)
    if any(not torch.equal(radius, radii[0]) for radius in radii):
        raise SystemExit("results depend on the number of workers")
    print(json.dumps(result, indent=1))
    if args.json:
        write_json(args.json, result)


if __name__ == "__main__":
    main()
