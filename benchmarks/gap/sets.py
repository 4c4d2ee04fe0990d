"""Synthetic sets whose truth is known: a random gel and designs, with no effect or one, as a camera
would film them.

Effects act through the library, so this tests the diagnosis where its closures are right; whether
it survives those of another hand is for data from elsewhere. Truths are simulated by another
setting than the diagnosis simulates by: finer in time and with more modes (``reference``: 32 + 40),
or with another number of them (``modes``: 24 + 28).
"""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from benchmarks.gap.signals import signals
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import linspace, ones, rand, randn
from imr_torch.gap import Effect, library
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Noise, predict
from imr_torch.observe.nuisance import FLOOR
from imr_torch.random import child, generator
from imr_torch.simulate import (
    ACCURACIES,
    STEPPINGS,
    Accuracy,
    PolytropicSimulator,
    Resolution,
    TransportSimulator,
)

KINDS = ("none", "effect", "withheld", "next")
PHYSICS = ("polytropic", "transport")
TRUTHS = ("reference", "modes")
SHARP = Accuracy(1e-6, Resolution(24, 28), max_steps=100000)
_BESIDE = 2  # designs drawn and filmed beside those diagnosed, so that a seed's set stays the same

GEL = {"G": (2e3, 15e3), "mu": (0.03, 0.3)}
_WEBER = (100.0, 1000.0)
_REST = (0.14, 0.30)
_APART = 0.1  # least distance of two designs, both coordinates scaled to 1
_AMPLITUDE = (0.2, 2.0)  # in prior standard deviations
_ACTS = 0.1  # least sd: what acts less does nothing in this physics
_SEEN = 4.0  # sd beside a refit at which an effect counts as detectable
_DRAWS = 4  # effects drawn, of which the first that is detectable acts
_ATTEMPTS = 20


@dataclass(frozen=True)
class Task:
    """One set of the benchmark; all that it depends on. Each experiment has errors of Rmax, time zero
    and R_inf, which the diagnosis knows about.

    Args:
        kind: one of ``KINDS``.
        designs: how many are diagnosed.
        repeats: curves a design.
        physics: one of ``PHYSICS``.
        seed: of the set and of its diagnosis.
        truths: one of ``TRUTHS``, by what the truth is simulated; polytropic ones are by finer
            steps in either case.
    """

    kind: str
    designs: int
    repeats: int
    physics: str
    seed: int
    truths: str = "reference"

    @property
    def size(self) -> str:
        """Designs x repeats."""
        return f"{self.designs}x{self.repeats}"

    @property
    def key(self) -> str:
        """What tells it from every other set."""
        own = "" if self.truths == TRUTHS[0] else f"/{self.truths}"
        return f"{self.kind}/{self.size}/{self.physics}/nuisances/{self.seed}{own}"

    def simulator(self, *, fine: bool = False) -> PolytropicSimulator | TransportSimulator:
        """The simulator of the diagnosis, or that of the truth, which has another discretisation
        error.
        """
        if self.physics == "polytropic":
            return PolytropicSimulator(
                stepping=STEPPINGS["reference" if fine else "default"]
            )
        if not fine:
            return TransportSimulator(accuracy=ACCURACIES["search"])
        return TransportSimulator(
            accuracy=SHARP if self.truths == "modes" else ACCURACIES["reference"]
        )


@dataclass(frozen=True)
class SyntheticSet:
    """Data and what is behind them.

    Args:
        experiments: what the diagnosis sees.
        truth: name of the effect that acts, in a tuple; empty without one.
        offered: the library of the diagnosis.
        values: true parameters beside neutral ones, SI.
        signal: sd that a refit of G, mu and nuisances leaves of each effect in the data that are
            diagnosed.
    """

    experiments: tuple[Experiment, ...]
    truth: tuple[str, ...]
    offered: tuple[Effect, ...]
    values: dict[str, float]
    signal: dict[str, float] = field(default_factory=dict)


def make_set(task: Task) -> SyntheticSet:
    """The set of a task; draws whose truth cannot be simulated are drawn anew.

    Raises:
        ConvergenceError: if no draw can.
    """
    for attempt in range(_ATTEMPTS):
        made = _try(task, generator(child(task.seed, task.key, attempt)))
        if made is not None:
            return made
    raise ConvergenceError(f"None of {_ATTEMPTS} truths of {task.key} could be simulated.")


def _try(task: Task, source: torch.Generator) -> SyntheticSet | None:
    gel = draw_gel(source)
    plan = make_plan(draw_designs(task.designs + _BESIDE, source), task)
    known = library()
    chosen: dict[Effect, dict[str, float]] = {}
    signal: dict[str, float] = {}
    if task.kind != "none":
        drawn = [draw_effect(_one_of(known, source), source) for _ in range(_DRAWS)]
        diagnosed = ExperimentBatch(plan.experiments[: task.designs])
        shown = signals(gel, [changed for _, changed in drawn], diagnosed, task.simulator())
        place = choose(shown)
        if place is None:
            return None
        effect, changed = drawn[place]
        chosen, signal = {effect: changed}, {effect.name: shown[place]}
    values = gel | {name: value for own in chosen.values() for name, value in own.items()}
    filmed = film(values, plan, task, source)
    if filmed is None:
        return None
    hidden = {effect.family for effect in chosen} if task.kind == "withheld" else set()
    return SyntheticSet(
        filmed[: task.designs],
        tuple(effect.name for effect in chosen),
        tuple(effect for effect in known if effect.family not in hidden),
        values,
        signal,
    )


def film(
    values: dict[str, float], plan: ExperimentBatch, task: Task, source: torch.Generator
) -> tuple[Experiment, ...] | None:
    """Shoot a plan: what the camera gives; None where a bubble cannot be simulated."""
    shifts = randn(1, len(plan.experiments), 3, generator=source) * plan.nuisance_sds
    curves = predict(
        task.simulator(fine=True), PARAMETERS.pack(values)[None], plan, shifts
    )[0]
    if not bool(torch.isfinite(curves).all()):
        return None
    return tuple(
        Experiment(
            e.label,
            e.design,
            e.times,
            Noise().draw(r, e.times, task.repeats, generator=source),
            e.nuisance,
        )
        for e, r in zip(plan.experiments, curves, strict=True)
    )


def _one_of(effects: tuple[Effect, ...], source: torch.Generator) -> Effect:
    return effects[int(torch.randint(len(effects), (), generator=source))]


def draw_gel(source: torch.Generator) -> dict[str, float]:
    """G and mu, SI."""
    return {name: draw_log_uniform(bounds, source) for name, bounds in GEL.items()}


def draw_log_uniform(bounds: tuple[float, float], source: torch.Generator) -> float:
    """Between two bounds."""
    low, high = map(math.log, bounds)
    return math.exp(low + (high - low) * float(rand((), generator=source)))


def draw_designs(count: int, source: torch.Generator) -> Tensor:
    """``count x 2`` random designs (We log-uniform, R_inf* uniform), none nearly another."""
    kept: list[Tensor] = []
    while len(kept) < count:
        point = rand(2, generator=source)
        if all(float((point - other).norm()) >= _APART for other in kept):
            kept.append(point)
    unit = torch.stack(kept)
    weber = _WEBER[0] * (_WEBER[1] / _WEBER[0]) ** unit[:, 0]
    return torch.stack((weber, _REST[0] + (_REST[1] - _REST[0]) * unit[:, 1]), 1)


def make_plan(designs: Tensor, task: Task) -> ExperimentBatch:
    """Experiments before they are shot."""
    times = linspace(0.0, 4.0, 81)
    blank = ones(task.repeats, 81)
    pairs = [(weber, rest) for weber, rest in designs.tolist()]
    return ExperimentBatch(
        tuple(
            Experiment(f"design {i}", d, times, blank, FLOOR) for i, d in enumerate(pairs)
        )
    )


def draw_effect(effect: Effect, source: torch.Generator) -> tuple[Effect, dict[str, float]]:
    """An effect with random values: its amplitude .2 to 2 prior standard deviations, the others
    from their priors.
    """
    values = {}
    for i, (name, prior) in enumerate(effect.priors.items()):
        u = randn((), generator=source)
        if i:
            values[name] = float(prior.to_physical(u))
            continue
        size = prior.sd * draw_log_uniform(_AMPLITUDE, source)  # type: ignore[attr-defined]  # amplitudes are truncated normal
        signed = math.copysign(size, float(u))
        lower = max(prior.lower, PARAMETERS[name].lower)
        upper = min(prior.upper, PARAMETERS[name].upper)
        values[name] = signed if lower <= signed <= upper else min(size, upper)
    return effect, values


def choose(signals: list[float]) -> int | None:
    """Place of the first draw that is detectable, else of the strongest; None if none acts at all."""
    able = [i for i, signal in enumerate(signals) if signal >= _ACTS]  # not NaN either
    seen = [i for i in able if signals[i] >= _SEEN]
    return seen[0] if seen else max(able, key=lambda i: signals[i], default=None)
