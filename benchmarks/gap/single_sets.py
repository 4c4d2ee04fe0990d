"""Sets of single curves as a laboratory stores them, whose gel, effect and noise are known.

Three shots of a random gel, a curve each, are simulated with 24 + 28 modes and steps of 1e-6 (fits
have 18 + 18), with errors of Rmax, time zero and R_inf, and filmed by a camera of one of the kinds
of noise in ``NOISES``; or they are curves of a separate program (:func:`read_labelled`).
:mod:`benchmarks.gap.single_curves` judges what is said of them.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.gap.sets import GEL, SHARP, draw_designs, draw_effect
from benchmarks.gap.shares import FURTHER
from benchmarks.records import Line
from imr_torch.errors import ImrError
from imr_torch.float64 import linspace, ones, randn, tensor, zeros
from imr_torch.gap import library
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import (
    Experiment,
    ExperimentBatch,
    Given,
    Noise,
    RadiusTrace,
    TraceSet,
    predict,
    prepare,
)
from imr_torch.observe.nuisance import FLOOR
from imr_torch.random import child, generator
from imr_torch.simulate import ACCURACIES, TransportSimulator
from imr_torch.units import Surroundings

TRUTH = TransportSimulator(accuracy=SHARP, threads=1)
FITS = TransportSimulator(accuracy=ACCURACIES["search"], threads=1)
SHOTS = 3
LENGTH = 4.0
_DENSE = 801
ACTED = ("effect", "withheld")

Curve = tuple[Tensor, Tensor, Noise]
"""Times, noisy radius and the law of its noise in single frames, dimensionless."""


def white(
    law: Noise, frames: int = 81
) -> Callable[[Tensor, Tensor, int, torch.Generator], Curve]:
    """Independent frames by a law."""

    def noisy(times: Tensor, radius: Tensor, shot: int, source: torch.Generator) -> Curve:
        step = (len(times) - 1) // (frames - 1)
        times = times[::step]
        radius = radius[::step]
        return times, law.draw(radius, times, 1, generator=source)[0], law

    return noisy


def noisy_shot(times: Tensor, radius: Tensor, shot: int, source: torch.Generator) -> Curve:
    """The published law, in the second shot three times as large."""
    return white(Noise(scale=3.0 if shot == 1 else 1.0))(times, radius, shot, source)


def pixels(times: Tensor, radius: Tensor, shot: int, source: torch.Generator) -> Curve:
    """Noise of .4 pixels, rounded to pixels, of which Rmax has 80."""
    times, radius, law = white(_constant(0.4 / 80.0))(times, radius, shot, source)
    return (
        times,
        (80.0 * radius).round() / 80.0,
        replace(law, scale=math.sqrt(0.4**2 + 1.0 / 12.0) / 80.0),
    )


def slow(times: Tensor, radius: Tensor, shot: int, source: torch.Generator) -> Curve:
    """The published law, and deviations of .003 to .012 in R* that last .14 to .4 in t*, other ones
    in each shot.
    """
    times, seen, single = white(Noise())(times, radius, shot, source)
    lag, size = (
        low * (high / low) ** float(torch.rand((), generator=source))
        for low, high in ((0.14, 0.4), (0.003, 0.012))
    )
    law = replace(_constant(size), correlation_time=lag)
    return times, law.draw(seen, times, 1, generator=source)[0], single


def _constant(sd: float) -> Noise:
    """The same at every radius, R*."""
    return Noise(scale=sd, slope=0.0, drift=0.0, floor=1.0)


NOISES = {
    "published": white(Noise()),
    "constant": white(_constant(0.006)),
    "other slopes": white(Noise(slope=0.03, drift=0.0, floor=0.001)),
    "small": white(Noise(scale=0.3)),
    "41 frames": white(Noise(), 41),
    "201 frames": white(Noise(), 201),
    "noisy shot": noisy_shot,
    "pixels": pixels,
    "slow": slow,
}


def simulate_set(
    number: int, kind: str, *, stated: bool, seed: int
) -> tuple[TraceSet, list[Noise], Line]:
    """Three curves of a random gel, the law of each one's noise, and the truth.

    What cannot be simulated is drawn again.
    """
    source = generator(child(seed, "single curves", kind, number))
    names = [effect.name for effect in library()]
    while True:
        values = {
            name: low * (high / low) ** float(torch.rand((), generator=source))
            for name, (low, high) in GEL.items()
        }
        truth: Line = {"effect": "none", **values}
        if kind in ACTED:
            name = names[int(torch.randint(len(names), (), generator=source))]
            effect, drawn = draw_effect(LIBRARY[name], source)
            values |= drawn
            truth |= {"effect": effect.name, "values": drawn}
        designs = draw_designs(SHOTS, source)
        filmed = _film(kind, values, designs, source, stated=stated)
        if filmed is not None:
            return *filmed, truth


def film_further(
    number: int, kind: str, truth: Line, *, stated: bool, seed: int
) -> tuple[Experiment, ...]:
    """Further curves of the same gel and effect at designs of their own, as they are read; drawn
    anew where one is refused.
    """
    source = generator(child(seed, "further curves", kind, number))
    values = {name: truth[name] for name in GEL} | truth.get("values", {})
    while True:
        filmed = _film(kind, values, draw_designs(FURTHER, source), source, stated=stated)
        with suppress(ImrError):
            if filmed is not None:
                return prepare(filmed[0]).experiments


def _film(
    kind: str,
    values: dict[str, float],
    designs: Tensor,
    source: torch.Generator,
    *,
    stated: bool,
) -> tuple[TraceSet, list[Noise]] | None:
    """A curve of each design, and the law of its noise; None where one cannot be simulated."""
    count = len(designs)
    times = linspace(0.0, LENGTH, _DENSE)
    blank = ones(1, _DENSE)
    pairs = designs.tolist()
    plan = [Experiment(f"{k}", tuple(d), times, blank, FLOOR) for k, d in enumerate(pairs)]
    draws = randn(count, 3, generator=source)
    logs = zeros(count, len(GEL))
    if kind == "gels":
        logs = 0.3 * randn(count, len(GEL), generator=source)
    clean = _solve_shots(plan, values, draws, logs)
    if not bool(torch.isfinite(clean).all()):
        return None
    acted = dict.fromkeys(ACTED, white(Noise(scale=0.4)))
    camera = (NOISES | acted | {"gels": NOISES["published"]})[kind]
    traces = []
    laws = []
    for shot, (weber, rest) in enumerate(pairs):
        t, r, law = camera(times, clean[shot], shot, source)
        traces.append(trace(f"shot {shot}", t, r, weber, rest if stated else None))
        laws.append(law)
    return TraceSet(tuple(traces)), laws


def _solve_shots(
    plan: Sequence[Experiment], values: dict[str, float], draws: Tensor, logs: Tensor
) -> Tensor:
    """True curves of shots of gels whose properties differ by logarithms ``SHOTS x 2``."""
    rows = []
    for experiment, draw, factors in zip(plan, draws, logs.exp().tolist(), strict=True):
        own = {name: values[name] * x for name, x in zip(GEL, factors, strict=True)}
        gel = PARAMETERS.pack(values | own)[None]
        batch = ExperimentBatch((experiment,))
        rows.append(predict(TRUTH, gel, batch, draw[None, None] * batch.nuisance_sds)[0, 0])
    return torch.stack(rows)


def trace(
    name: str, times: Tensor, radius: Tensor, weber: float, rest: float | None
) -> RadiusTrace:
    """A dimensionless curve as a laboratory stores it, perhaps with R_inf, impossible frames left
    out as the reader does.
    """
    size = float(Surroundings().max_radius(tensor(weber)))
    seen = radius * size > 1e-7
    given = (
        Given()
        if rest is None
        else Given(rest_radius_m=rest * size, rest_radius_sd_m=0.01 * rest * size)
    )
    time_s = times * float(Surroundings().time_scale(size))
    return RadiusTrace(name, time_s[seen], radius[seen] * size, "simulated", given)


def read_labelled(
    folder: Path, *, stated: bool
) -> Iterator[tuple[str, TraceSet, list[Noise], Line]]:
    """Sets of a separate program: key, curves, their noise and the truth; the second repeat, then
    the mean of all.
    """
    for name, label in json.loads((folder / "labels.json").read_text()).items():
        loaded = np.load(folder / f"{name}.npz")
        truth = {"effect": label["effect"], "G": label["G_pa"], "mu": label["mu_pa_s"]}
        radii = torch.tensor(loaded["radius_m"])
        law = Noise(scale=radii.shape[1] ** -0.5)
        for kind, curves, noise in (
            ("one repeat", radii[:, 1], Noise()),
            ("mean of repeats", radii.mean(1), law),
        ):
            traces = []
            for shot, (t, r, rest) in enumerate(
                zip(loaded["time_s"], curves, loaded["rinf_star"], strict=True)
            ):
                seen = r > 1e-7
                known = rest * float(radii[shot].mean(0).max())
                given = (
                    Given(rest_radius_m=known, rest_radius_sd_m=0.01 * known)
                    if stated
                    else Given()
                )
                traces.append(
                    RadiusTrace(f"shot {shot}", torch.tensor(t)[seen], r[seen], name, given)
                )
            yield f"{kind}/{name}", TraceSet(tuple(traces)), [noise] * SHOTS, truth
