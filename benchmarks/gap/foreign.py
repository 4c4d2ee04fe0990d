"""Six effects that the library does not hold: what is said of them, and of sets where nothing is missing
or each shot has a pressure of its own.

  python -m benchmarks.gap.foreign run OUT.jsonl [--sets 4] [--seed 0] [--paths repeats,single]
      [--only darcy,none] [--physics resting]
  python -m benchmarks.gap.foreign table OUT.jsonl ...

Truths are those of :mod:`benchmarks.gap.closures`, simulated by finer steps (``transport``: 24 + 28
modes as well) in a process of their own, so that no fit can find their laws. ``repeats`` are three
designs x 10 repeats whose noise is known, a fault of the camera being that of all repeats;
``single`` are three curves of .4 times the published noise, read as a laboratory's, the noise
inferred. The strength of an effect is moved until a refit of gel and nuisances leaves, by the true
noise, what was drawn between 8 and 40 standard deviations (within a factor 1.3). The default
diagnosis and what is missing are asked of each set.
Kinds that are right were stated before any set was run (``EFFECTS``): a viscous interface is one of
the contents or a stress of the gel; what a drag in the pores may be taken for, of the sample as well;
a loss by shapes that look larger, of the contents or the camera. Every name of a library effect is
wrong, though of the drag ``size_drag`` comes near (``beside_drag``: what a refit with it leaves).
S of what is missing is judged on two designs that no fit saw, against their true curves: 1 less the
squared error over that of the base model.
"""

import argparse
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from benchmarks.gap import closures
from benchmarks.gap.sets import GEL, draw_designs, draw_log_uniform
from benchmarks.gap.signals import refit
from benchmarks.gap.single_curves import FITS, TRUTH, trace
from benchmarks.gap.unknown import (
    OWN_KINDS,
    SCORES,
    count_words,
    median_of,
    score_group,
    summarise_unknown,
    values_of,
)
from benchmarks.gap.verdicts import is_named, summarise
from benchmarks.records import (
    Line,
    add_out,
    read_record,
    run_missing_jobs,
    start_commands,
    write_table,
)
from imr_torch.design import Plan
from imr_torch.float64 import arange, ones, rand, randn, tensor, zeros
from imr_torch.gap import GapReport, diagnose
from imr_torch.material import LIBRARY
from imr_torch.observe import Experiment, ExperimentBatch, Noise, TraceSet, prepare
from imr_torch.observe.nuisance import FLOOR
from imr_torch.random import child, generator
from imr_torch.simulate import (
    STEPPINGS,
    Conditions,
    PolytropicGas,
    PolytropicSimulator,
    Simulator,
    fewer_steps,
    process_pool,
)
from imr_torch.unknown import Unknown, infer_unknown
from imr_torch.unknown.next_shot import plan_shot, predict_curve

EFFECTS = {
    "surface_viscosity": {"contents", "material"},
    "darcy": {"sample", "contents", "material"},
    "dropped_frame": {"camera"},
    "drifting_edge": {"camera"},
    "no_sphere": {"contents", "camera"},
    "two_times": {"material"},
}
"""Effect -> kinds that are right."""
PATHS = {"repeats": (10, Noise()), "single": (1, Noise(scale=0.4))}
"""Repeats of a design, and the law of one's noise."""
PRESSURES = ("surface_viscosity", "darcy", "two_times")
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
        strength: of the effect.
        gels: true parameters of each shot beside it, SI.
        designs: of all shots.
        every: samples of a frame.
        physics: of ``SIMULATORS``.
    """

    effect: str
    strength: float
    gels: tuple[dict[str, float], ...]
    designs: tuple[tuple[float, float], ...]
    every: int
    physics: str

    @property
    def fits(self) -> Simulator:
        """The simulator of the diagnosis."""
        return SIMULATORS[self.physics][0]

    @property
    def finer(self) -> Simulator:
        """That of the truth."""
        return SIMULATORS[self.physics][1]

    def film(self, simulator: Simulator, shifts: Tensor, first: int = 0) -> Tensor:
        """Frames without noise of as many shots as there are shifts."""
        shots = slice(first, first + len(shifts))
        of_shots = (self.gels[shots], self.designs[shots], shifts, self.every, simulator)
        return _simulate(closures.film_shots, self.effect, self.strength, *of_shots)

    def plan(self, repeats: int, noise: Noise) -> ExperimentBatch:
        """The diagnosed shots before they are filmed."""
        times = closures.STEP * arange(0.0, closures.FRAMES * closures.SAMPLES + 1.0, self.every)
        blank = ones(repeats, len(times))
        shots = self.designs[:SHOTS]
        made = [Experiment(f"shot {i}", d, times, blank, FLOOR) for i, d in enumerate(shots)]
        return ExperimentBatch(tuple(made), noise)


_POOL: list[ProcessPoolExecutor] = []


def _simulate(work: Callable, *given: object):
    """Work in the process in which the closures are registered."""
    if not _POOL:
        _POOL.append(process_pool(1))
    return _POOL[0].submit(work, *given).result()


def draw_truth(
    path: str, effect: str, physics: str, source: torch.Generator
) -> tuple[Truth, float]:
    """A random truth that shows as much as it should, and by how many standard deviations."""
    repeats, noise = PATHS[path]
    while True:
        gel = {name: draw_log_uniform(bounds, source) for name, bounds in GEL.items()}
        designs = tuple((w, r) for w, r in draw_designs(SHOTS + _UNSEEN, source).tolist())
        fine = effect == "dropped_frame" and float(rand((), generator=source)) < 0.5
        every = closures.SAMPLES // (2 if fine else 1)
        truth = Truth(effect, 0.0, (gel,) * len(designs), designs, every, physics)
        pulses = [_draw_pulse(source) for _ in designs]
        target = draw_log_uniform(SIGNALS, source)
        if effect == "none":
            return truth, 0.0
        strength = STARTS[effect]
        for _ in range(8):
            if effect == "dropped_frame":
                strength = float(min(max(round(strength), 1), 60))
            gels = tuple(gel | {**own, "pulse": own["pulse"] * strength} for own in pulses)
            truth = replace(
                truth, strength=strength, gels=gels if effect == "own_drive" else truth.gels
            )
            curve = truth.film(truth.fits, zeros(SHOTS, 3))
            signal = refit(gel, curve, truth.plan(repeats, noise), truth.fits)
            if math.isnan(signal):
                break
            away = target / max(signal, 1e-9)
            if max(away, 1.0 / away) < _CLOSE and SIGNALS[0] <= signal <= SIGNALS[1]:
                return truth, signal
            strength *= min(max(away, 0.2), 5.0)


def _draw_pulse(source: torch.Generator) -> dict[str, float]:
    """A pulse of a shot's own, of about unit size and either sign."""
    size, sign, moment, width = rand(4, generator=source).tolist()
    amplitude = math.copysign(0.5 + size, sign - 0.5)
    return {"pulse": amplitude, "pulse_time": 0.3 + 3.0 * moment, "pulse_width": -2.0 + width}


def judge_set(path: str, effect: str, physics: str, number: int) -> Line:
    """Make a set, diagnose it, infer what is missing, and compare."""
    seed = child(number, "foreign", path, effect, physics)
    source = generator(seed)
    repeats, noise = PATHS[path]
    while True:
        truth, signal = draw_truth(path, effect, physics, source)
        plan = truth.plan(repeats, noise)
        shifts = randn(SHOTS, 3, generator=source) * plan.nuisance_sds
        curves = truth.film(truth.finer, shifts)
        unseen = truth.film(truth.finer, zeros(_UNSEEN, 3), SHOTS)
        if bool(torch.isfinite(torch.cat((curves, unseen))).all()):
            break
    line: Line = {
        "strength": truth.strength,
        "signal": signal,
        "frames": curves.shape[1],
        "gel": {name: truth.gels[0][name] for name in GEL},
    }
    if effect == "darcy":
        drag = LIBRARY["size_drag"]
        clean = truth.film(truth.fits, zeros(SHOTS, 3))
        gel = truth.gels[0]
        left = [refit(gel, clean, plan, truth.fits, rival=(drag, start)) for start in drag.starts]
        line["beside_drag"] = min(left)
    drawn = [
        noise.draw(curve, shot.times, repeats, generator=source)
        for curve, shot in zip(curves, plan.curves, strict=True)
    ]
    if path == "single":
        traces = [
            trace(shot.label, shot.times, radius[0], shot.design[0], None)
            for shot, radius in zip(plan.curves, drawn, strict=True)
        ]
        experiments = prepare(TraceSet(tuple(traces))).experiments
    else:
        experiments = tuple(replace(e, radius=r) for e, r in zip(plan.curves, drawn, strict=True))
    started = time.process_time()
    single = path == "single"
    report = diagnose(experiments, estimate_noise=single, simulator=truth.fits, seed=seed)
    line |= {"seconds_diagnosis": time.process_time() - started}
    said = summarise(report)
    likeliest = sorted(said["posterior"] or {}, key=lambda name: -said["posterior"][name])[:4]
    said["posterior"] = {name: said["posterior"][name] for name in likeliest}
    return line | said | judge_unknown(truth, report, unseen)


def judge_unknown(truth: Truth, report: GapReport, unseen: Tensor) -> Line:
    """What is inferred to be missing; ``shown`` where a user would see it."""
    started = time.process_time()
    fewer = fewer_steps(truth.fits)
    if not report.null.certificate.usable:
        return {"explained": None}
    try:
        found = infer_unknown(report.null, report.batch, fewer)
    except RuntimeError:  # a matrix that is not positive definite
        found = None
    if found is None:
        return {"explained": None}
    line = summarise_unknown(found) | {
        "shown": report.found and not is_named({"verdict": report.verdict}),
        "seconds_unknown": time.process_time() - started,
        "unseen": judge_unseen(truth, report, found, unseen),
    }
    if truth.effect in PRESSURES and found.shots:
        fitted = values_of(report.null)
        given = (truth.gels[:SHOTS], truth.designs[:SHOTS], fitted, found.shots)
        line |= _simulate(closures.compare_shots, truth.effect, truth.strength, *given)
    return line


def judge_unseen(truth: Truth, report: GapReport, found: Unknown, unseen: Tensor) -> Line:
    """Whitened squared errors on unseen designs, of the base model and of the most probable kind."""
    fewer = fewer_steps(truth.fits)
    times = truth.plan(1, Noise()).curves[0].times
    errors = {"base": 0.0, found.kind: 0.0}
    for design, curve in zip(truth.designs[SHOTS:], unseen, strict=True):
        plan = Plan(repeats=1, times=times)
        shot = plan_shot(tensor(design), plan, report.null.prior, fewer)
        base = shot.predict(report.null.mean, zeros(3), zeros(len(shot.moments)))
        left = shot.whiten((curve - base)[None], base)[0]
        errors["base"] += float(left.square().mean())
        made = predict_curve(shot, found.rivals[found.kind], base).mean
        errors[found.kind] += float((left - made).square().mean())
    return errors


def list_jobs(args: argparse.Namespace) -> tuple[dict[str, partial[Line]], dict[str, Line]]:
    """Sets asked for, and what they are of, a few of each effect coming first."""
    jobs = {}
    about = {}
    for number in range(args.seed, args.seed + args.sets):
        for path in args.paths.split(","):
            for effect in args.only.split(","):
                key = f"{path}/{effect}/{args.physics}/{number}"
                jobs[key] = partial(judge_set, path, effect, args.physics, number)
                about[key] = {
                    "path": path,
                    "effect": effect,
                    "physics": args.physics,
                    "seed": number,
                }
    return jobs, about


def write_scores(lines: Sequence[Line]) -> str:
    """A table of each path: by effects, of all effects together, and placebos."""
    head = ("", "sd", "p < .05", "named", "S unseen", "CPU s", *SCORES)
    pages = []
    for path in PATHS:
        own = [
            x
            | {"S": score_unseen(x), "cpu": x["seconds_diagnosis"] + x.get("seconds_unknown", 0.0)}
            for x in lines
            if x["path"] == path and "verdict" in x
        ]
        groups = {effect: [x for x in own if x["effect"] == effect] for effect in STARTS}
        for name, kinds in (("all effects", EFFECTS), ("pressures", PRESSURES)):
            groups[name] = [x for x in own if x["effect"] in kinds]
        rows = []
        for name, some in groups.items():
            seen = f"{sum(x['p_gap'] < 0.05 for x in some)} of {len(some)}"
            named = count_words("+".join(x["cause"]) for x in some if is_named(x))
            sd, share, cost = (median_of(some, x) for x in ("signal", "S", "cpu"))
            rows.append(
                (name, sd, seen, named, share, cost, *score_group(some, OWN_KINDS | EFFECTS))
            )
        pages.append(f"{path}\n\n{write_table(head, rows)}")
    return "\n\n".join(pages)


def score_unseen(line: Line) -> float | None:
    """S of the most probable kind on unseen designs; minus infinity where its bubble failed."""
    if "unseen" not in line:
        return None
    left = line["unseen"][line["kind"]]
    return 1.0 - (math.inf if left is None else left) / line["unseen"]["base"]


def main() -> None:
    """Run or tabulate."""
    parser, commands = start_commands(__doc__)
    runs = commands.add_parser("run", help="simulate sets, diagnose them and compare")
    add_out(runs)
    runs.add_argument("--sets", type=int, default=4, help="of each effect and path")
    runs.add_argument("--seed", type=int, default=0, help="of the first set; others count up")
    runs.add_argument("--physics", choices=SIMULATORS, default="resting")
    runs.add_argument("--paths", default=",".join(PATHS))
    runs.add_argument("--only", default=",".join(STARTS))
    args = parser.parse_args()
    if args.what == "table":
        lines = read_record(*args.files)
    else:
        jobs, about = list_jobs(args)
        lines = run_missing_jobs(args.out, jobs, about=about)
    print(write_scores(lines))


if __name__ == "__main__":
    main()
