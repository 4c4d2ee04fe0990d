"""Six effects that the library does not hold: what is said of them, and of sets where nothing is missing
or each shot has a pressure of its own.

  python -m benchmarks.gap.foreign run OUT.jsonl [--sets 4] [--seed 0] [--paths repeats,single]
      [--only darcy,none] [--physics polytropic]
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
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from benchmarks.gap import closures
from benchmarks.gap.sets import GEL, draw_designs
from benchmarks.gap.signals import refit
from benchmarks.gap.single_curves import FITS, TRUTH, trace
from benchmarks.gap.unknown import SURE, share_nonzero, values_of
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
from imr_torch.gap.hypotheses import EXPLAINS
from imr_torch.material import LIBRARY
from imr_torch.observe import Experiment, ExperimentBatch, Noise, TraceSet, prepare
from imr_torch.observe.nuisance import FLOOR
from imr_torch.random import child, generator
from imr_torch.simulate import STEPPINGS, PolytropicSimulator, Simulator, fewer_steps, process_pool
from imr_torch.unknown import NOTHING_KNOWN, Unknown, infer_unknown
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
PLACEBOS = ("none", "own_drive")
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
}
SIMULATORS: dict[str, tuple[Simulator, Simulator]] = {
    "polytropic": (
        PolytropicSimulator(threads=1),
        PolytropicSimulator(stepping=STEPPINGS["reference"], threads=1),
    ),
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
        effect: one of ``EFFECTS`` or ``PLACEBOS``.
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
        gel = {name: _log_uniform(*bounds, source) for name, bounds in GEL.items()}
        designs = tuple((w, r) for w, r in draw_designs(SHOTS + _UNSEEN, source).tolist())
        fine = effect == "dropped_frame" and float(rand((), generator=source)) < 0.5
        every = closures.SAMPLES // (2 if fine else 1)
        truth = Truth(effect, 0.0, (gel,) * len(designs), designs, every, physics)
        pulses = [_draw_pulse(source) for _ in designs]
        target = _log_uniform(*SIGNALS, source)
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


def _log_uniform(low: float, high: float, source: torch.Generator) -> float:
    return low * (high / low) ** float(rand((), generator=source))


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
    line: Line = {
        "shown": report.found and not is_named({"verdict": report.verdict}),
        "kind": found.kind,
        "kinds": found.probabilities,
        "explained": found.explained,
        "terms": dict(list(found.terms.items())[:3]),
        "sure_nonzero": share_nonzero(found.shots) if found.shots else 0.0,
        "seconds_unknown": time.process_time() - started,
        "unseen": judge_unseen(truth, report, found, unseen),
    }
    if truth.effect in PRESSURES and found.shots:
        fitted = values_of(report.null)
        given = (truth.gels[:SHOTS], truth.designs[:SHOTS], fitted, found.shots)
        line |= _simulate(closures.compare_shots, truth.effect, truth.strength, *given)
    return line


def judge_unseen(truth: Truth, report: GapReport, found: Unknown, unseen: Tensor) -> Line:
    """Whitened squared errors on unseen designs, of the base model and of each kind."""
    fewer = fewer_steps(truth.fits)
    times = truth.plan(1, Noise()).curves[0].times
    errors = dict.fromkeys(("base", *found.probabilities), 0.0)
    for design, curve in zip(truth.designs[SHOTS:], unseen, strict=True):
        plan = Plan(repeats=1, times=times)
        shot = plan_shot(tensor(design), plan, report.null.prior, fewer)
        base = shot.predict(report.null.mean, zeros(3), zeros(len(shot.moments)))
        left = shot.whiten((curve - base)[None], base)[0]
        errors["base"] += float(left.square().mean())
        for kind in found.probabilities:
            made = predict_curve(shot, found.rivals[kind], base).mean
            errors[kind] += float((left - made).square().mean())
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


def is_sure(line: Line) -> bool:
    """Whether one kind has P > .8 and explains 3 nats."""
    return max(line["kinds"].values()) > SURE and line["explained"] >= EXPLAINS


def named_term(line: Line) -> str | None:
    """The plain term with P > .8, if any."""
    name, share = next(iter(line["terms"].items()), (NOTHING_KNOWN, 1.0))
    known = name != NOTHING_KNOWN and share > SURE and line["explained"] >= EXPLAINS
    return name if known else None


def score_unseen(line: Line) -> float:
    """S of the most probable kind on unseen designs."""
    errors = line.get("unseen") or {}
    value = errors.get(line.get("kind"))
    return math.nan if value is None or not errors["base"] else 1.0 - value / errors["base"]


def _middle(values: Sequence[float | None]) -> str:
    known = sorted(x for x in values if x is not None and not math.isnan(x))
    return f"{known[len(known) // 2]:.2f} ({len(known)})" if known else "-"


def _count(values: Sequence[str]) -> str:
    return ", ".join(f"{name} {n}" for name, n in Counter(values).most_common()) or "-"


def _rows(lines: Sequence[Line]) -> Sequence[Sequence[object]]:
    """A row of each effect."""
    rows = []
    for effect in (*EFFECTS, *PLACEBOS):
        own = [x for x in lines if x["effect"] == effect and "verdict" in x]
        asked = [x for x in own if x["explained"] is not None]
        sure = [x for x in asked if is_sure(x)]
        names = ["+".join(x["cause"]) for x in own if is_named(x)]
        terms = [term for x in asked if (term := named_term(x))]
        if own:
            cells = (
                _middle([x["signal"] for x in own]),
                sum(x["p_gap"] < 0.05 for x in own),
                _count([x["verdict"] for x in own]),
                _count(names),
                f"{len(sure)} of {len(asked)}: {_count([x['kind'] for x in sure])}",
                _middle([x.get("correlation") for x in asked]),
                _middle([x.get("inside") for x in asked]),
                _middle([score_unseen(x) for x in asked]) if effect in EFFECTS else "-",
                _count(terms),
            )
            rows.append((effect, len(own), *cells))
    return rows


def write_scores(lines: Sequence[Line]) -> str:
    """A table of each path by effects, then what must be met."""
    head = ("effect", "sets", "sd", "p < .05", "verdicts", "names", "sure kinds")
    head += ("correlation", "inside", "S unseen", "terms")
    pages = []
    found = []
    for path in PATHS:
        own = [x for x in lines if x["path"] == path]
        failed = sum("verdict" not in x for x in own)
        pages.append(f"{path}: {len(own)} sets, {failed} without an answer\n")
        pages.append(write_table(head, _rows(own)) + "\n")
        found.append([value for _, value in list_figures(own)])
    names = [name for name, _ in list_figures([])]
    pages.append(write_table(("figure", *PATHS), list(zip(names, *found, strict=True))))
    return "\n".join(pages)


def list_figures(lines: Sequence[Line]) -> list[tuple[str, str]]:
    """Figures and what must be met, over all effects."""
    lines = [x for x in lines if "verdict" in x]
    asked = [x for x in lines if x["explained"] is not None]
    acting = [x for x in asked if x["effect"] in EFFECTS]
    seen = [x for x in lines if x["effect"] in EFFECTS and x["gap"]]
    sure = [x for x in acting if is_sure(x)]
    right = [x for x in sure if x["kind"] in EFFECTS[x["effect"]]]
    gel = [x for x in sure if x["kind"] in ("material", "contents")]
    state = [x for x in acting if x["effect"] in PRESSURES]
    none = [x for x in asked if x["effect"] == "none"]
    drive = [x for x in asked if x["effect"] == "own_drive"]
    called = [x for x in drive if is_sure(x) and x["kind"] in ("material", "contents")]
    terms = [f"{x['effect']}: {term}" for x in acting if (term := named_term(x))]
    quiet = sum(x["explained"] < EXPLAINS for x in none)
    seconds = [x["seconds_diagnosis"] + x["seconds_unknown"] for x in acting]
    return [
        ("an effect is seen", f"{len(seen)} of {sum(x['effect'] in EFFECTS for x in lines)}"),
        ("seen: a library effect or class is named", f"{sum(map(is_named, seen))} of {len(seen)}"),
        ("one kind has P > .8 (must .4)", f"{len(sure)} of {len(acting)}"),
        ("such a kind is right (must .9)", f"{len(right)} of {len(sure)}"),
        (
            "the same where a user sees it",
            f"{sum(x['shown'] for x in right)} of {sum(x['shown'] for x in sure)}",
        ),
        (
            "camera faults called material or contents",
            f"{sum(EFFECTS[x['effect']] == {'camera'} for x in gel)}",
        ),
        ("correlation, median (must .85)", _middle([x.get("correlation") for x in state])),
        ("inside the 90 % band, median (must .8)", _middle([x.get("inside") for x in state])),
        ("S on unseen designs, median (must .6)", _middle([score_unseen(x) for x in state])),
        ("terms with P > .8 (must .85 right)", _count(terms)),
        ("nothing missing: no kind explains 3 nats (must .95)", f"{quiet} of {len(none)}"),
        ("placebo called material or contents (must .05)", f"{len(called)} of {len(drive)}"),
        ("CPU of diagnosis and what is missing, median", _middle(seconds)),
    ]


def main() -> None:
    """Run or tabulate."""
    parser, commands = start_commands(__doc__)
    runs = commands.add_parser("run", help="simulate sets, diagnose them and compare")
    add_out(runs)
    runs.add_argument("--sets", type=int, default=4, help="of each effect and path")
    runs.add_argument("--seed", type=int, default=0, help="of the first set; others count up")
    runs.add_argument("--physics", choices=SIMULATORS, default="polytropic")
    runs.add_argument("--paths", default=",".join(PATHS))
    runs.add_argument("--only", default=",".join((*EFFECTS, *PLACEBOS)))
    args = parser.parse_args()
    if args.what == "table":
        lines = read_record(*args.files)
    else:
        jobs, about = list_jobs(args)
        lines = run_missing_jobs(args.out, jobs, about=about)
    print(write_scores(lines))


if __name__ == "__main__":
    main()
