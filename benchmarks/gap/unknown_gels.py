"""Is what three gels of a laboratory miss said to be common where it is, and their own where it is?

  python -m benchmarks.gap.unknown_gels run OUT.jsonl [--sets 56] [--seed 0]
  python -m benchmarks.gap.unknown_gels table OUT.jsonl

Polytropic bubbles, two designs x 10 repeats of each gel, truths by finer steps, nuisances of each
experiment. What acts (``TRUTHS``) is one effect of one strength in all gels, or another effect or the
same with another strength in each, or a pulse of each shot's own, or nothing; a refit of each gel
leaves between 4 and 40 sd of it, of the strong drag 15 to 60. In laboratories with an odd seed the
library lacks what acts, so that functions alone can tell.
"""

import argparse
import math
import time
from functools import partial

import torch

from benchmarks.gap.sets import (
    Task,
    draw_designs,
    draw_effect,
    draw_gel,
    film,
    make_plan,
)
from benchmarks.gap.signals import signals
from benchmarks.records import (
    Job,
    Line,
    finish_command,
    start_commands,
    write_table,
)
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import rand
from imr_torch.gap import compare_gels, library
from imr_torch.gap.hypotheses import Inquiry
from imr_torch.material import wide_prior
from imr_torch.observe import Experiment, ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import fewer_steps
from imr_torch.unknown import CommonUnknown

STRESSES = (
    "strain_stiffening",
    "stress_relaxation",
    "damage",
    "shear_thinning",
    "yield_stress",
)
TRUTHS: dict[str, tuple[tuple[str, ...], tuple[float, float]]] = {
    "one drag": (("size_drag",), (4.0, 15.0)),
    "own stresses": (STRESSES, (4.0, 40.0)),
    "nothing": ((), (0.0, 1.0)),
    "one of gas or camera": (
        ("vapour_pressure", "hot_contents", "refraction", "energy_loss"),
        (4.0, 40.0),
    ),
    "own strengths": ((*STRESSES, "size_drag"), (4.0, 40.0)),
    "one strong drag": (("size_drag",), (15.0, 60.0)),
    "shots' own pulses": ((), (0.0, 1.0)),
}
"""What acts -> effects that it is drawn from, and how many sd of it a refit of a gel leaves."""

VERDICTS = ("common", "not shown", "none", "undecided")


def make_laboratory(
    kind: str, seed: int, *, attempts: int = 100, tries: int = 5
) -> tuple[list[tuple[Experiment, ...]], list[dict[str, float]]]:
    """The experiments of three gels, and what acts in each.

    Raises:
        ConvergenceError: where no attempt acts as is asked for.
    """
    source = generator(child(seed, kind))
    task = Task("none", 2, 10, "polytropic", seed)
    names, (least, most) = TRUTHS[kind]
    for _ in range(attempts):
        effects = library(names) if names else ()
        order = torch.randperm(max(3, len(effects)), generator=source)[:3].tolist()
        drawn = [draw_effect(effects[n % len(effects)], source) for n in order if effects]
        if kind.startswith("one"):
            drawn = drawn[:1] * 3
        if kind == "own strengths":
            own = [draw_effect(drawn[0][0], source)[1] for _ in range(3)]
            sizes = sorted(abs(next(iter(values.values()))) for values in own)
            drawn = [(drawn[0][0], values) for values in own]
            if sizes[1] < 2.0 * sizes[0] or sizes[2] < 2.0 * sizes[1]:
                continue
        made = []
        for _ in range(3 * tries + 1):
            if len(made) == 3:
                return [x for x, _ in made], [acts for _, acts in made]
            gel = draw_gel(source)
            plan = make_plan(draw_designs(2, source), task)
            acts = dict(drawn[len(made)][1]) if drawn else {}
            if (
                acts
                and not least <= signals(gel, [acts], plan, task.simulator())[0] <= most
            ):
                continue
            each = [gel | acts] * 2
            if kind.startswith("shots"):
                each = [gel | _draw_pulse(source) for _ in each]
            filmed = [film(values, plan, task, source) for values in each]
            if None not in filmed:
                made.append((tuple(x[i] for i, x in enumerate(filmed) if x), acts))
    raise ConvergenceError(f"None of {attempts} laboratories {kind}/{seed} acts as asked.")


def _draw_pulse(source: torch.Generator) -> dict[str, float]:
    size, when, width = rand(3, generator=source).tolist()
    return {
        "pulse": math.copysign(0.08 * (size + 0.2), width - 0.5),
        "pulse_time": 0.3 + 1.5 * when,
        "pulse_width": -1.8 + 0.4 * width,
    }


def infer_laboratory(kind: str, seed: int) -> Line:
    """What is said of the gels of a laboratory."""
    gels, acts = make_laboratory(kind, seed)
    withheld = bool(seed % 2) and any(acts)
    hidden = {name for values in acts for name in values} if withheld else set()
    effects = [effect for effect in library() if not hidden & set(effect.names)]
    simulator = fewer_steps(Task("none", 2, 10, "polytropic", seed).simulator())
    started = time.process_time()
    base = wide_prior(("nhkv",)).models[0]
    asked = {
        f"gel {n}": Inquiry(base, ExperimentBatch(own), simulator, tuple(effects))
        for n, own in enumerate(gels)
    }
    found = compare_gels(asked, seed=seed)
    return {
        "truth": kind,
        "acts": acts,
        "withheld": withheld,
        "verdict": found.verdict,
        "probabilities": found.probabilities,
        "causes": [vars(cause) for cause in found.causes[:5]],
        "seconds": time.process_time() - started,
    }


def effects_of(line: Line) -> set[str]:
    """Names of the effects that act."""
    names = {name for values in line["acts"] for name in values}
    return {effect.name for effect in library() if names & set(effect.names)}


def write_scores(lines: list[Line]) -> str:
    """Verdicts by what acts, and how often the effect that acts stands first where the library holds
    it and something common is said, in Markdown.
    """
    rows = []
    for kind in TRUTHS:
        own = [x for x in lines if x.get("truth") == kind]
        said = [CommonUnknown(x["probabilities"], ()).verdict for x in own]
        found = [
            x["causes"][0]["name"] in effects_of(x)
            for x, verdict in zip(own, said, strict=True)
            if verdict == "common" and not x["withheld"]
        ]
        rows.append(
            (kind, len(own), *map(said.count, VERDICTS), f"{sum(found)} of {len(found)}")
        )
    return write_table(("in truth", "laboratories", *VERDICTS, "named"), rows)


def list_jobs(args: argparse.Namespace) -> dict[str, Job]:
    """One laboratory of each kind in turn."""
    kinds = tuple(TRUTHS)
    asked = [(kinds[n % len(kinds)], args.seed + n // len(kinds)) for n in range(args.sets)]
    return {f"{kind}/{seed}": partial(infer_laboratory, kind, seed) for kind, seed in asked}


def main() -> None:
    """Run or tabulate."""
    finish_command(start_commands(__doc__, sets=56)[0], list_jobs, write_scores)


if __name__ == "__main__":
    main()
