"""Records that the camera or the set-up has spoilt: one bad shot of eight, and frames of which
nobody says that they are blurred, late or misjudged at their edges.

  python -m benchmarks.spoilt_records run OUT.jsonl [--sets 40] [--fits 40] [--only wall,scale=.01]
  python -m benchmarks.spoilt_records table OUT.jsonl ...

Bubbles are those of `tests/record/bubbles.py` (SciPy; a polytropic gas, which the fits have too),
from growth to four units of time after the maximum, in a gel of 2 to 20 kPa and .04 to .2 Pa s.

In sets of eight shots (noise .003 in R*) the fourth has one of the errors of `SHOTS`, of that size
or the one that `--only` says; `good` sets have none. Their first `--fits` sets are fitted too. In
sets of three shots (noise .002) all frames have the errors of `FRAMES`. What they mean says
:func:`film_bubble`; what R_inf is read as has those of lengths too.
"""

import argparse
from functools import partial

import numpy as np
import torch

from benchmarks.gap.single_curves import characterize_traces
from benchmarks.records import (
    Figure,
    Job,
    Line,
    read_record,
    run_missing_jobs,
    start_commands,
    write_figures,
)
from imr_torch import PolytropicSimulator
from imr_torch.observe import Given, RadiusTrace, TraceSet
from imr_torch.record import describe_record
from imr_torch.simulate import Conditions, PolytropicGas
from tests.record.bubbles import LIQUID, paths

SHOTS = {
    "good": 0.0,
    "wall": 0.05,
    "ellipse": 0.02,
    "scale": 0.02,
    "focus": 0.03,
    "noisier": 2.0,
}
FRAMES = {
    "exact": {},
    "jitter": {"jitter": 0.15},
    "exposure": {"exposure": 0.2},
    "threshold": {"threshold": 0.0005},
    "all": {"jitter": 0.15, "exposure": 0.2, "threshold": 0.0005},
}
FITS = PolytropicSimulator(
    Conditions(gas=PolytropicGas(exponent=1.4, reference="rest")), threads=1
)
GOOD = ("good", "noisier")
"""In which no shot is bad."""
BAD = 3
"""Which shot is the bad one."""


def film_bubble(
    name: str,
    bubble: tuple[float, float, float, float],
    rng: np.random.Generator,
    *,
    noise: float,
    wall: float = 0.0,
    ellipse: float = 0.0,
    scale: float = 0.0,
    focus: float = 0.0,
    noisier: float = 0.0,
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
        wall: Rmax over twice its distance.
        ellipse: shape mode 2, at rest at the maximum; the radius is that of a circle as large as
            the outline, and there so much too large.
        scale: error of the size of a pixel.
        focus: by how much of Rmax edges are read too far out; if at all, noise is three times as
            large.
        noisier: how many times as large noise is, less one: no bad shot.
        jitter: standard deviation of the time of a frame, over the spacing.
        exposure: over the spacing.
        threshold: standard deviation of the radius, over Rmax/R, in R*.
        spacing: of frames, t*.
        last: end of the record, t*.
    """
    top, rest = bubble[:2]
    unit = float(LIQUID.time_scale(top))
    growth, later = paths(*bubble, near=wall, last=last)
    begin = growth.t[-1] / unit
    times = np.arange(begin + (jitter + rng.uniform()) * spacing, last - spacing, spacing)
    late = jitter * rng.standard_normal(len(times)).clip(-3.0, 3.0)
    opened = late[:, None] + exposure * np.linspace(-0.5, 0.5, 21)
    opened = (times[:, None] + spacing * opened).clip(begin, last)

    def see_radius(t: np.ndarray) -> np.ndarray:
        # the shape is taken to be even in time
        radius, _, shape, _ = later.sol(np.abs(t) * unit)
        shape = 4.0 * ellipse * (shape / radius).clip(-4.0, 4.0)
        radius = np.where(t < 0.0, growth.sol(np.minimum(t, 0.0) * unit)[0], radius)
        return radius / top * np.sqrt(1.0 + 0.5 * shape + 11.0 / 32.0 * shape**2)

    clean = see_radius(opened.ravel()).reshape(opened.shape).mean(1)
    sd = np.hypot(noise * (3.0 if focus else 1.0 + noisier), threshold / clean)
    seen = clean + focus + sd * rng.standard_normal(len(times))
    size = top * (1.0 + scale)
    at_rest = rest * float(see_radius(np.array([last]))[0]) / later.y[0, -1] + focus
    known = size * at_rest * (1.0 + 0.01 * rng.standard_normal())
    kept = seen > 0.01
    return RadiusTrace(
        name,
        torch.tensor(unit * times[kept]),
        torch.tensor(size * seen[kept]),
        "simulated",
        Given(rest_radius_m=known, rest_radius_sd_m=0.01 * known),
    )


def simulate_shots(kind: str, size: float, seed: int) -> tuple[TraceSet, Line]:
    """Records of one gel, one or all of them spoilt, and its properties."""
    rng = np.random.default_rng(seed)
    count = 3 if kind in FRAMES else 8
    gel = np.exp(rng.uniform(np.log([2e3, 0.04]), np.log([2e4, 0.2]))).tolist()
    sizes = 2e-4 * np.exp(0.12 * rng.standard_normal(count))
    rests = 0.2 * sizes * np.exp(0.05 * rng.standard_normal(count))
    errors = [FRAMES.get(kind, {})] * count
    if size:
        errors[BAD] = {kind: size}
    noise = 0.002 if kind in FRAMES else 0.003
    traces = (
        film_bubble(f"shot {i}", (top, rest, *gel), rng, noise=noise, **own)
        for i, (top, rest, own) in enumerate(
            zip(sizes.tolist(), rests.tolist(), errors, strict=True)
        )
    )
    return TraceSet(tuple(traces)), dict(zip(("G", "mu"), gel, strict=True))


def judge_shots(kind: str, size: float, seed: int, *, fit: bool) -> Line:
    """Which of the shots stand out, and what the fit says."""
    traces, truth = simulate_shots(kind, size, seed)
    line: Line = {"truth": truth}
    if kind in SHOTS:
        line["odd"] = [shot.stands_out for shot in describe_record(traces).shots]
    return line | (characterize_traces(traces, truth, 0, simulator=FITS) if fit else {})


def list_jobs(args: argparse.Namespace) -> dict[str, Job]:
    """Every set that was asked for."""
    jobs: dict[str, Job] = {}
    for text in args.only.split(","):
        kind, _, size = text.partition("=")
        for number in range(args.sets):
            jobs[f"{text}/{args.seed + number}"] = partial(
                judge_shots,
                kind,
                float(size or SHOTS.get(kind, 0.0)),
                args.seed + number,
                fit=number < args.fits or kind in FRAMES,
            )
    return jobs


def write_page(lines: list[Line]) -> str:
    """Figures of each kind."""
    figures = []
    for kind in dict.fromkeys(line["key"].split("/")[0] for line in lines):
        own = [line for line in lines if line["key"].startswith(f"{kind}/")]
        odd = [line["odd"] for line in own if "odd" in line]
        if odd:
            bad = [] if kind in GOOD else [row.pop(BAD) for row in odd]
            figures.append(Figure.of_share(f"{kind}: found", bad, (0.9, 1.0)))
            good = [x for row in odd for x in row]
            figures.append(Figure.of_share(f"{kind}: good called bad", good, (0.0, 0.03)))
        fits = [line for line in own if "held" in line]
        for name in ("G", "mu") if fits else ():
            held = [line["held"][name] for line in fits]
            figures.append(Figure.of_share(f"{kind}: holds {name}", held, (0.85, 0.95)))
            errors = [abs(line["error"][name]) for line in fits]
            figures.append(
                Figure.of_quantile(f"{kind}: error of ln {name}, median", errors, 0.5)
            )
        low = [line["p_fit"] < 0.05 for line in fits if line["p_fit"] is not None]
        figures.append(Figure.of_share(f"{kind}: p below .05", low, (0.0, 0.05)))
    return write_figures(figure for figure in figures if figure.count)


def main() -> None:
    """Run or tabulate."""
    parser, _, runs = start_commands(__doc__)
    runs.add_argument("--sets", type=int, default=40)
    runs.add_argument("--fits", type=int, default=40)
    runs.add_argument("--seed", type=int, default=53000)
    runs.add_argument("--only", default=",".join((*SHOTS, *FRAMES)))
    args = parser.parse_args()
    if args.what == "run":
        run_missing_jobs(args.out, list_jobs(args), workers=args.workers)
    print(write_page(read_record(*(args.files if args.what == "table" else [args.out]))))


if __name__ == "__main__":
    main()
