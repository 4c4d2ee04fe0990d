"""How the cost of a characterisation grows with the number of shots: process CPU time, and the same
in full-physics bubbles, whose cost is measured in the same run.

  python -m benchmarks.many_shots OUT.jsonl [--shots 4,20] [--frames 60]

Curves are simulated in full physics with the gel of soft PA, Rmax from 150 to 400 um and R_inf/Rmax
from .16 to .26, with .003 in R* of noise. The model is NHKV with the wide prior, all else as by
default.
"""

import time
from functools import partial
from pathlib import Path

import torch

from benchmarks.records import Line, run_missing_jobs, start_parser, write_table
from benchmarks.solver import TIMES, draws, seconds_of
from imr_torch import characterize, wide_prior
from imr_torch.float64 import linspace, rand, tensor
from imr_torch.material import reference_case
from imr_torch.observe import TraceSet
from imr_torch.random import generator
from imr_torch.simulate import TransportSimulator
from tests.filmed import film

NOISE = 0.003
BUBBLES = 200
UNSTATED = "density=1060"


def simulate_curves(shots: int, frames: int) -> TraceSet:
    """Curves of one gel at random designs."""
    source = generator(shots)
    gel = reference_case("soft-pa").truth
    times = linspace(0.0, 4.0, frames)
    rows = tensor([150e-6, 0.16]) + tensor([250e-6, 0.1]) * rand(shots, 2, generator=source)
    simulator = TransportSimulator()
    return TraceSet(
        tuple(
            film(
                gel,
                size,
                rest,
                times,
                source,
                noise=NOISE,
                name=f"shot {number}",
                simulator=simulator,
            )
            for number, (size, rest) in enumerate(rows.tolist())
        )
    )


def measure_cost(shots: int, frames: int) -> Line:
    """CPU of one characterisation, and that of a bubble before and after it."""
    curves = simulate_curves(shots, frames)
    simulator = TransportSimulator()
    seeds = iter(range(8))

    def make_bubbles() -> None:
        simulator(*draws(BUBBLES, "cpu", next(seeds)), TIMES)

    before = seconds_of(make_bubbles, 2)
    started = time.process_time()
    result = characterize(
        curves, prior=wide_prior(["nhkv"]), simulator=simulator, medium=UNSTATED
    )
    spent = time.process_time() - started
    bubble = 0.5 * (before + seconds_of(make_bubbles, 2)) / BUBBLES
    fit = result.assimilation.fits[0]
    return {
        "shots": shots,
        "fitted_frames": int(result.assimilation.batch.mask.sum()),
        "cpu": spent,
        "bubble_ms": 1e3 * bubble,
        "in_bubbles": spent / bubble,
        "verdict": fit.verdict.value,
        "explained": result.fit_test is not None and result.fit_test.explained,
    }


def main() -> None:
    """Run and tabulate."""
    parser = start_parser(__doc__)
    parser.add_argument("out", type=Path, metavar="OUT.jsonl")
    parser.add_argument("--shots", default="4,20", help="comma-separated")
    parser.add_argument("--frames", type=int, default=60, help="of each simulated curve")
    args = parser.parse_args()
    torch.set_num_threads(1)
    what = f"{args.frames} frames"
    jobs = {
        f"{what}/{shots}": partial(measure_cost, shots, args.frames)
        for shots in map(int, args.shots.split(","))
    }
    lines = run_missing_jobs(args.out, jobs)
    columns = (
        "shots",
        "fitted_frames",
        "cpu",
        "bubble_ms",
        "in_bubbles",
        "verdict",
        "explained",
    )
    rows = [[what, *(line[column] for column in columns)] for line in lines]
    print(write_table(("curves", *columns), rows))


if __name__ == "__main__":
    main()
