"""Records that the camera or the set-up has spoilt: one bad shot of eight, and frames of which
nobody says that they are blurred, late or misjudged at their edges.

  python -m benchmarks.spoilt_records run OUT.jsonl [--sets 40] [--seed 53000] [--only wall,jitter]
  python -m benchmarks.spoilt_records table OUT.jsonl

Bubbles are those of `tests/record/bubbles.py` (SciPy; a polytropic gas, which the fits have too),
from growth to four units of time after the maximum. A kind may have a size: `--only scale=.03`.

One shot of eight, noise .003 in R*: `wall` is Rmax over twice its distance; an `ellipse` is a shape
mode 2 at rest at the maximum, and the radius is that of a circle of the same area as its outline,
so many times too large at the maximum; `scale` is an error of the pixel size; out of `focus` every
edge is read so much of Rmax too far out, with three times the noise. What the shot's R_inf is read
as has the same errors. `good` sets have none. Detection is counted in all sets, and fits in the
first of them (`--fits`).

Frames of three shots, noise .002 in R*: `jitter` of frame times and the `exposure` are in frames,
the error of a `threshold` is normal, of a standard deviation over R*.
"""

import argparse
import math
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.records import Figure, Job, Line, read_record, run_missing_jobs, write_figures
from imr_torch import PolytropicSimulator, characterize, wide_prior
from imr_torch.observe import Given, RadiusTrace, TraceSet
from imr_torch.record import describe_record
from imr_torch.simulate import Conditions, PolytropicGas
from tests.record.bubbles import LIQUID, paths

SHOTS = {"good": 0.0, "wall": 0.05, "ellipse": 0.02, "scale": 0.02, "focus": 0.03}
FRAMES = {
    "exact": {},
    "jitter": {"jitter": 0.15},
    "exposure": {"exposure": 0.2},
    "threshold": {"threshold": 0.0005},
    "all": {"jitter": 0.15, "exposure": 0.2, "threshold": 0.0005},
}
BAD = 3
"""Which shot is the bad one."""


def film_bubble(
    name: str,
    bubble: tuple[float, float, float, float],
    rng: np.random.Generator,
    *,
    noise: float,
    near: float = 0.0,
    elongated: float = 0.0,
    magnified: float = 1.0,
    widened: float = 0.0,
    jitter: float = 0.0,
    exposure: float = 0.0,
    threshold: float = 0.0,
    spacing: float = 0.04,
    last: float = 4.0,
) -> RadiusTrace:
    """A record, whose R_inf is known to 1 %.

    Args:
        name: of the shot.
        bubble: maximum radius (m), R_inf (m), G (Pa), mu (Pa s).
        rng: of noise and errors.
        noise: R*.
        near: a wall, Rmax over twice its distance.
        elongated: by how much an ellipse is seen too large at the maximum.
        magnified: factor on all lengths.
        widened: added to all radii, R*.
        jitter: frames.
        exposure: frames.
        threshold: error of the radius times R*, in R*.
        spacing: of frames, t*.
        last: end of the record, t*.
    """
    top, rest = bubble[:2]
    unit = float(LIQUID.time_scale(top))
    growth, later = paths(*bubble, near=near, last=last)
    begin = growth.t[-1] / unit + (jitter + rng.uniform()) * spacing
    times = np.arange(begin, last - spacing, spacing)
    within = exposure * np.linspace(-0.5, 0.5, 21)
    late = jitter * rng.standard_normal(len(times)).clip(-3.0, 3.0)
    opened = (times[:, None] + spacing * (late[:, None] + within)).clip(growth.t[-1] / unit, last)

    def see(t: np.ndarray) -> np.ndarray:
        # the shape mode is even in time about its rest at the maximum: not followed into growth
        radius, _, shape, _ = later.sol(np.abs(t) * unit)
        shape = 4.0 * elongated * (shape / radius).clip(-4.0, 4.0)
        radius = np.where(t < 0.0, growth.sol(np.minimum(t, 0.0) * unit)[0], radius)
        return radius / top * np.sqrt(1.0 + 0.5 * shape + 11.0 / 32.0 * shape**2)

    clean = see(opened.ravel()).reshape(opened.shape).mean(1)
    seen = clean + widened + np.hypot(noise, threshold / clean) * rng.standard_normal(len(times))
    at_rest = rest / top * see(np.array([last]))[0] / (later.y[0, -1] / top) + widened
    known = magnified * top * at_rest * (1.0 + 0.01 * rng.standard_normal())
    given = Given(rest_radius_m=known, rest_radius_sd_m=0.01 * known)
    kept = seen > 0.01
    return RadiusTrace(
        name,
        torch.tensor(unit * times[kept]),
        torch.tensor(magnified * top * seen[kept]),
        "simulated",
        given,
    )


def draw_bubbles(rng: np.random.Generator, count: int) -> list[tuple[float, float, float, float]]:
    """Bubbles in one gel, of 2 to 20 kPa and .04 to .2 Pa s."""
    modulus, viscosity = np.exp(rng.uniform(np.log([2e3, 0.04]), np.log([2e4, 0.2]))).tolist()
    sizes = 2e-4 * np.exp(0.12 * rng.standard_normal(count))
    rests = 0.2 * sizes * np.exp(0.05 * rng.standard_normal(count))
    both = zip(sizes.tolist(), rests.tolist(), strict=True)
    return [(top, rest, modulus, viscosity) for top, rest in both]


def spoil(kind: str, size: float) -> Line:
    """Errors of :func:`film_bubble` of a bad shot."""
    return {
        "good": {},
        "wall": {"near": size},
        "ellipse": {"elongated": size},
        "scale": {"magnified": 1.0 + size},
        "focus": {"widened": size, "noise": 0.009},
    }[kind]


def simulate_shots(kind: str, size: float, seed: int) -> tuple[TraceSet, Line]:
    """Eight records of a gel, one of them spoilt, and its properties."""
    rng = np.random.default_rng(seed)
    bubbles = draw_bubbles(rng, 8)
    errors = [{"noise": 0.003} | (spoil(kind, size) if i == BAD else {}) for i in range(8)]
    traces = (
        film_bubble(f"shot {i}", bubble, rng, **own)
        for i, (bubble, own) in enumerate(zip(bubbles, errors, strict=True))
    )
    return TraceSet(tuple(traces)), dict(zip(("G", "mu"), bubbles[0][2:], strict=True))


def simulate_frames(kind: str, seed: int) -> tuple[TraceSet, Line]:
    """Three records of a gel whose frames have unstated errors, and its properties."""
    rng = np.random.default_rng(seed)
    bubbles = draw_bubbles(rng, 3)
    traces = (
        film_bubble(f"shot {i}", bubble, rng, noise=0.002, **FRAMES[kind])
        for i, bubble in enumerate(bubbles)
    )
    return TraceSet(tuple(traces)), dict(zip(("G", "mu"), bubbles[0][2:], strict=True))


def fit_traces(traces: TraceSet, truth: Line, *, weigh: bool = True) -> Line:
    """Intervals of ``characterize`` with the truth's own gas, and the p-value of its fit test."""
    gas = PolytropicGas(exponent=1.4, reference="rest")
    result = characterize(
        traces,
        prior=wide_prior(["nhkv"]),
        simulator=PolytropicSimulator(Conditions(gas=gas), threads=1),
        medium="density=1060",
        weigh_odd_shots=weigh,
    )
    found = result.to_dict()["models"]["nhkv"]["intervals"]  # type: ignore[index,call-overload]
    test = result.fit_test
    return {
        "p": None if test is None else test.p_value,
        "held": {name: found[name][0] <= truth[name] <= found[name][2] for name in truth},
        "error": {name: math.log(found[name][1] / value) for name, value in truth.items()},
        "width": {name: math.log(found[name][2] / found[name][0]) for name in truth},
        "law": str(result.assimilation.batch.noise),
    }


def judge_shots(kind: str, size: float, seed: int, *, fit: bool) -> Line:
    """Which shots stand out, and what the fit says."""
    traces, truth = simulate_shots(kind, size, seed)
    odd = [shot.stands_out for shot in describe_record(traces).shots]
    line: Line = {"kind": kind, "size": size, "truth": truth, "odd": odd}
    return line | (fit_traces(traces, truth) if fit else {})


def judge_frames(kind: str, seed: int) -> Line:
    """What the fit says of frames with errors."""
    traces, truth = simulate_frames(kind, seed)
    return {"kind": kind, "truth": truth} | fit_traces(traces, truth)


def list_jobs(sets: int, fits: int, seed: int, only: list[str]) -> dict[str, Job]:
    """Every set that was asked for."""
    jobs: dict[str, Job] = {}
    for text in only or [*SHOTS, *FRAMES]:
        kind, _, size = text.partition("=")
        for number in range(sets):
            own = seed + number
            jobs[f"{text}/{own}"] = (
                partial(judge_frames, kind, own)
                if kind in FRAMES
                else partial(judge_shots, kind, float(size or SHOTS[kind]), own, fit=number < fits)
            )
    return jobs


def write_page(lines: list[Line]) -> str:
    """Figures of each kind."""
    figures = []
    for text in dict.fromkeys(line["key"].split("/")[0] for line in lines):
        own = [line for line in lines if line["key"].startswith(f"{text}/")]
        odd = [line["odd"] for line in own if "odd" in line]
        bad = [] if text == "good" else [BAD]
        good = [x for row in odd for i, x in enumerate(row) if i not in bad]
        if bad and odd:
            figures.append(Figure.of_share(f"{text}: found", [row[BAD] for row in odd], (0.9, 1.0)))
        if odd:
            figures.append(Figure.of_share(f"{text}: good called bad", good, (0.0, 0.03)))
        fits = [line for line in own if "held" in line]
        for name in ("G", "mu") if fits else ():
            held = [line["held"][name] for line in fits]
            figures.append(Figure.of_share(f"{text}: holds {name}", held, (0.85, 0.95)))
            errors = np.square([line["error"][name] for line in fits]).mean() ** 0.5
            figures.append(Figure(f"{text}: error of ln {name}", float(errors), len(fits)))
        tested = [line["p"] < 0.05 for line in fits if line["p"] is not None]
        if tested:
            figures.append(Figure.of_share(f"{text}: p below .05", tested, (0.0, 0.05)))
    return write_figures(figures)


def main() -> None:
    """Run or tabulate."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="what", required=True)
    runs = commands.add_parser("run")
    runs.add_argument("out", type=Path)
    runs.add_argument("--sets", type=int, default=40)
    runs.add_argument("--fits", type=int, default=40)
    runs.add_argument("--seed", type=int, default=53000)
    runs.add_argument("--only", default="", help="comma-separated")
    commands.add_parser("table").add_argument("out", type=Path)
    args = parser.parse_args()
    if args.what == "table":
        lines = read_record(args.out)
    else:
        only = args.only.split(",") if args.only else []
        lines = run_missing_jobs(args.out, list_jobs(args.sets, args.fits, args.seed, only))
    print(write_page(lines))


if __name__ == "__main__":
    main()
