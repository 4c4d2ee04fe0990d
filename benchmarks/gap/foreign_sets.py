"""Sets whose effect the library does not hold, or where nothing is missing or each shot has a pressure
of its own.

Truths are those of :mod:`benchmarks.gap.closures`, simulated by finer steps (``transport``: 24 + 28
modes as well) in a process of their own, so that no fit can find their laws. ``repeats`` are three
designs x 10 repeats whose noise is known, a fault of the camera being that of all repeats;
``single`` are three curves of .4 times the published noise, read as a laboratory's, the noise
inferred. The strength of an effect is moved until a refit of gel and nuisances leaves, by the true
noise, what was drawn between 8 and 40 standard deviations (within a factor 1.3).
"""

import math
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor

from benchmarks.gap import closures
from benchmarks.gap.sets import draw_designs, draw_gel, draw_log_uniform
from benchmarks.gap.signals import refit
from benchmarks.gap.single_sets import FITS, TRUTH, trace
from imr_torch.float64 import arange, ones, rand, randn, zeros
from imr_torch.observe import Experiment, ExperimentBatch, Noise, TraceSet, prepare
from imr_torch.observe.nuisance import FLOOR
from imr_torch.simulate import (
    STEPPINGS,
    Conditions,
    PolytropicGas,
    PolytropicSimulator,
    Simulator,
    process_pool,
)

PATHS = {"repeats": (10, Noise()), "single": (1, Noise(scale=0.4))}
"""Repeats of a design, and the law of one's noise."""
STARTS = {
    "surface_viscosity": 4.0,
    "darcy": 3.0,
    "dropped_frame": 12.0,
    "drifting_edge": 10.0,
    "no_sphere": 0.1,
    "two_times": 4.0,
    "own_drive": 0.03,
    "none": 0.0,
}
"""Effects and placebos, and the strength at which a search begins."""
RESTING = Conditions(gas=PolytropicGas(exponent=1.4, reference="rest"))
"""Gas that comes to rest at R_inf, which is then what the end of a record shows."""


def _polytropic(conditions: Conditions) -> tuple[Simulator, Simulator]:
    default = PolytropicSimulator(conditions, threads=1)
    return default, replace(default, stepping=STEPPINGS["reference"])


SIMULATORS: dict[str, tuple[Simulator, Simulator]] = {
    "polytropic": _polytropic(Conditions(gas=PolytropicGas())),
    "resting": _polytropic(RESTING),
    "transport": (FITS, TRUTH),
}
"""Simulators of the diagnosis and of the truth."""
SIGNALS = (8.0, 40.0)
SHOTS = 3
_UNSEEN = 2
_CLOSE = 1.3


@dataclass(frozen=True)
class Truth:
    """What was filmed, the designs of the last ``_UNSEEN`` shots being kept back.

    Args:
        effect: one of ``STARTS``.
        gels: true parameters of each shot beside it, SI.
        designs: of all shots.
        every: samples of a frame.
        repeats: of each design.
        noise: of one repeat.
        fits: the simulator of the diagnosis.
        finer: that of the truth.
        strength: of the effect.
        signal: what a refit leaves of it, in standard deviations.
    """

    effect: str
    gels: tuple[dict[str, float], ...]
    designs: tuple[tuple[float, float], ...]
    every: int
    repeats: int
    noise: Noise
    fits: Simulator
    finer: Simulator
    strength: float = 0.0
    signal: float = 0.0

    @property
    def times(self) -> Tensor:
        """Of the frames, t*."""
        return closures.STEP * arange(
            0.0, closures.FRAMES * closures.SAMPLES + 1.0, self.every
        )

    @property
    def plan(self) -> ExperimentBatch:
        """The diagnosed shots before they are filmed."""
        blank = ones(self.repeats, len(self.times))
        shots = self.designs[:SHOTS]
        made = [
            Experiment(f"shot {i}", d, self.times, blank, FLOOR)
            for i, d in enumerate(shots)
        ]
        return ExperimentBatch(tuple(made), self.noise)

    def film(self, simulator: Simulator, shifts: Tensor, first: int = 0) -> Tensor:
        """Frames without noise of as many shots as there are shifts."""
        shots = slice(first, first + len(shifts))
        of_shots = (self.gels[shots], self.designs[shots], shifts, self.every, simulator)
        return run_apart(closures.film_shots, self.effect, self.strength, *of_shots)


@cache
def _start_process() -> ProcessPoolExecutor:
    return process_pool(1)


def run_apart(work: Callable, *given: object):
    """Work in the process in which the closures are registered."""
    return _start_process().submit(work, *given).result()


def draw_truth(path: str, effect: str, physics: str, source: torch.Generator) -> Truth:
    """A random truth that shows as much as it should."""
    while True:
        gel = draw_gel(source)
        designs = tuple((w, r) for w, r in draw_designs(SHOTS + _UNSEEN, source).tolist())
        fine = effect == "dropped_frame" and float(rand((), generator=source)) < 0.5
        every = closures.SAMPLES // (2 if fine else 1)
        gels = (gel,) * len(designs)
        truth = Truth(effect, gels, designs, every, *PATHS[path], *SIMULATORS[physics])
        pulses = [_draw_pulse(source) for _ in designs]
        target = draw_log_uniform(SIGNALS, source)
        if effect == "none":
            return truth
        strength = STARTS[effect]
        for _ in range(8):
            if effect == "dropped_frame":
                strength = float(min(max(round(strength), 1), 60))
            if effect == "own_drive":
                gels = tuple(
                    gel | own | {"pulse": own["pulse"] * strength} for own in pulses
                )
            truth = replace(truth, strength=strength, gels=gels)
            curve = truth.film(truth.fits, zeros(SHOTS, 3))
            signal = refit(gel, curve, truth.plan, truth.fits)
            if math.isnan(signal):
                break
            away = target / max(signal, 1e-9)
            if max(away, 1.0 / away) < _CLOSE and SIGNALS[0] <= signal <= SIGNALS[1]:
                return replace(truth, signal=signal)
            strength *= min(max(away, 0.2), 5.0)


def _draw_pulse(source: torch.Generator) -> dict[str, float]:
    """A pulse of a shot's own, of about unit size and either sign."""
    size, sign, moment, width = rand(4, generator=source).tolist()
    amplitude = math.copysign(0.5 + size, sign - 0.5)
    return {
        "pulse": amplitude,
        "pulse_time": 0.3 + 3.0 * moment,
        "pulse_width": -2.0 + width,
    }


def make_foreign_set(
    path: str, effect: str, physics: str, source: torch.Generator
) -> tuple[Truth, tuple[Experiment, ...], Tensor]:
    """A truth, its shots as they are diagnosed, and true curves of the designs kept back."""
    while True:
        truth = draw_truth(path, effect, physics, source)
        plan = truth.plan
        shifts = randn(SHOTS, 3, generator=source) * plan.nuisance_sds
        curves = truth.film(truth.finer, shifts)
        unseen = truth.film(truth.finer, zeros(_UNSEEN, 3), SHOTS)
        if bool(torch.isfinite(torch.cat((curves, unseen))).all()):
            break
    shots = [
        replace(
            shot, radius=plan.noise.draw(curve, shot.times, truth.repeats, generator=source)
        )
        for shot, curve in zip(plan.curves, curves, strict=True)
    ]
    if path == "single":
        traces = [trace(x.label, x.times, x.radius[0], x.design[0], None) for x in shots]
        shots = prepare(TraceSet(tuple(traces))).experiments
    return truth, tuple(shots), unseen
