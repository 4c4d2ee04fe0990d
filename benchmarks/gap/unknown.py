"""Is the missing pressure right? Sets whose effect no model holds, and sets where nothing is missing.

  python -m benchmarks.gap.unknown run OUT.jsonl [--sets 40] [--physics transport] [--seed 0]
  python -m benchmarks.gap.unknown table OUT.jsonl

An effect of the library acts in two sets of three; the base model alone is fitted, and what it misses is
inferred without the library. A kind is right if it is that of the effect's place: effects of the gel
and drags of the wall are a stress (the drag that sound between walls makes is one of the sample as
well), those of the gas a pressure of the contents, those of the drive a pressure in time, those of the
measurement the camera's; other effects of the liquid have no kind, and count as told apart wrongly
where one is sure. Two kinds count as right for four effects (``OWN_KINDS``, ``PLACES``): a bias of R_inf and
an energy loss (contents or material), a drag k R U (sample or material), a velocity at time zero (camera or
drive). For stress laws the true missing pressure is known: the stress of the true law less
that of the fitted base model, along the inferred bubble (the true one has shifts of its own), with the
law's memory integrated there. It is compared with the inferred one where the bubble was, weighted by
the inverse square of the stated error (correlation) or by its own square (share inside the 90 % band).
"""

import argparse
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from benchmarks.gap.sets import PHYSICS, Task, make_set
from benchmarks.records import (
    Job,
    Line,
    finish_command,
    start_commands,
    write_table,
)
from imr_torch.assimilate import ModelFit
from imr_torch.float64 import arange, tensor
from imr_torch.gap.fits import fit_null
from imr_torch.gap.hypotheses import EXPLAINS, Inquiry
from imr_torch.material import (
    LIBRARY,
    PARAMETERS,
    TERMS,
    dimensionless,
    gel_response,
    wide_prior,
)
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import fewer_steps
from imr_torch.units import Surroundings
from imr_torch.unknown import NOTHING_KNOWN, MissingPressure, Unknown, infer_unknown
from imr_torch.unknown.shot import SPACING

PLACES: dict[str, set[str]] = {
    "material": {"material"},
    "gas": {"contents"},
    "driving": {"drive"},
    "measurement": {"camera"},
    "geometry": {"contents", "material"},
    "liquid": set(),
}
OWN_KINDS = {"size_drag": {"sample", "material"}, "energy_loss": {"material", "contents"}}
OWN_KINDS |= {"vapour_pressure": {"contents"}, "residual_velocity": {"camera", "drive"}}
OWN_KINDS |= {"none": set(), "own_drive": {"drive"}}
SURE = 0.8


def infer_set(task: Task) -> Line:
    """Make a set, fit the base model, infer what it misses, and compare."""
    data = make_set(task)
    simulator = fewer_steps(task.simulator())
    batch = ExperimentBatch(data.experiments)
    base = wide_prior(("nhkv",)).models[0]
    null = fit_null(Inquiry(base, batch, simulator), seed=task.seed)
    found = infer_unknown(null, batch, simulator)
    line: Line = {"truth": data.truth, "signal": data.signal, "explained": None}
    if found is None:
        return line
    line |= summarise_unknown(found)
    if data.truth and found.shots and _is_stress(data.truth[0]):
        designs = [experiment.design for experiment in data.experiments]
        truths = [data.values] * len(designs)
        fitted = values_of(null)
        outer = simulator.conditions.surroundings
        line |= compare_pressures(designs, truths, fitted, found.shots, outer)
    return line


def summarise_unknown(found: Unknown) -> Line:
    """What is said to be missing."""
    return {
        "kind": found.kind,
        "kinds": found.probabilities,
        "explained": found.explained,
        "terms": dict(list(found.terms.items())[:3]),
        "sure_nonzero": share_nonzero(found.shots) if found.shots else 0.0,
    }


def values_of(fit: ModelFit) -> dict[str, float]:
    """The fitted parameters, SI."""
    values = fit.prior.to_si(fit.mean)[PARAMETERS.index(fit.prior.names)]
    return dict(zip(fit.prior.names, values.tolist(), strict=True))


def share_nonzero(shots: Sequence[MissingPressure]) -> float:
    """Share of time in which the 90 % band excludes zero."""
    away = [(shot.pressure.abs() > 1.645 * shot.sd).double().mean() for shot in shots]
    return float(torch.stack(away).mean())


def _is_stress(effect: str) -> bool:
    """Whether an effect acts by a stress term alone."""
    own = LIBRARY[effect]
    acts = any(set(own.names) & {term.switch, *term.names} for term in TERMS)
    return acts and not own.physical and effect != "permanent_set"


def compare_pressures(
    designs: Sequence[tuple[float, float]],
    truths: Sequence[Mapping[str, float]],
    fitted: Mapping[str, float],
    shots: Sequence[MissingPressure],
    surroundings: Surroundings,
) -> Line:
    """Correlation of true and inferred missing pressure, and the share of the true one inside the
    90 % band; true parameters of each shot and those of the fitted base model, SI.
    """
    trues, found, sds = [], [], []
    for design, truth, shot in zip(designs, truths, shots, strict=True):
        weber, rest = tensor(design)
        size = surroundings.max_radius(weber)
        seconds = surroundings.time_scale(size)
        times = shot.times / seconds
        step = float(times[1] - times[0])
        radius = shot.stretch * rest
        velocity = shot.rate * seconds * radius
        gels = (
            dimensionless(PARAMETERS.pack(x), size, surroundings) for x in (truth, fitted)
        )
        true, base = (stress_along(gel, radius, velocity, rest, step) for gel in gels)
        # as coarse in time as what is inferred: averaged, and made, by pulses
        width = math.sqrt(2.0) * SPACING / step
        trues.append(surroundings.far_field_pressure * smooth(true - base, width))
        found.append(shot.pressure)
        sds.append(shot.sd)
    true, own, sd = (torch.cat(x) for x in (trues, found, sds))
    inside = ((true - own).abs() <= 1.645 * sd).double()
    return {
        "correlation": weighted_correlation(true, own, sd.square().reciprocal()),
        "inside": float((inside * true.square()).sum() / true.square().sum()),
        "inside_plain": float(inside.mean()),
    }


def smooth(values: Tensor, width: float) -> Tensor:
    """Gaussian average, ``exp(-(t/width)^2)``, widths in samples."""
    reach = int(3.0 * width)
    offsets = arange(-reach, reach + 1)
    kernel = (-(offsets / width).square()).exp()
    padded = torch.nn.functional.pad(values[None, None], (reach, reach), mode="replicate")
    return torch.nn.functional.conv1d(padded, (kernel / kernel.sum())[None, None])[0, 0]


def weighted_correlation(a: Tensor, b: Tensor, weight: Tensor) -> float:
    """Pearson's correlation."""
    share = weight / weight.sum()
    a = a - share @ a
    b = b - share @ b
    return float((share @ (a * b)) / ((share @ a.square()) * (share @ b.square())).sqrt())


def stress_along(
    theta: dict[str, Tensor], radius: Tensor, velocity: Tensor, rest: Tensor, step: float
) -> Tensor:
    """Stress over p_inf of all terms that act along a path, their memory by Heun's method."""
    terms = [term for term in TERMS if bool(theta[term.switch] != 0.0)]
    memory = torch.cat([term.memory_start(rest, theta) for term in terms])
    if not len(memory):
        return gel_response(terms, radius, velocity, rest, theta, memory)[0].value
    states = [memory]
    for k in range(len(radius) - 1):
        _, rate = gel_response(terms, radius[k], velocity[k], rest, theta, memory)
        ahead = memory + step * rate
        _, later = gel_response(terms, radius[k + 1], velocity[k + 1], rest, theta, ahead)
        memory = memory + 0.5 * step * (rate + later)
        states.append(memory)
    held = torch.stack(states, -1)
    return gel_response(terms, radius, velocity, rest, theta, held)[0].value


def effect_of(line: Line) -> str:
    """What acted; ``"none"`` where nothing did."""
    return line.get("effect") or next(iter(line["truth"]), "none")


def kinds_of(effect: str, own: Mapping[str, set[str]]) -> set[str]:
    """Kinds that are right for an effect: its own, or those of its place."""
    return own[effect] if effect in own else PLACES[LIBRARY[effect].place]


def median_of(lines: Sequence[Line], name: str) -> str:
    """Median of a figure, and how many have it."""
    known = [x[name] for x in lines if x.get(name) is not None]
    return f"{statistics.median(known):.2f} ({len(known)})" if known else "-"


def count_words(words: Iterable[str]) -> str:
    """Words with their numbers."""
    return ", ".join(f"{word} {n}" for word, n in Counter(words).most_common()) or "-"


SCORES = (
    "sets",
    "a kind explains 3 nats",
    "one has P > .8 as well",
    "is right",
    "correlation",
    "inside",
    "inside, by time",
    "terms with P > .8",
    "time that excludes zero",
)


def score_group(
    lines: Sequence[Line], own: Mapping[str, set[str]] = OWN_KINDS
) -> tuple[object, ...]:
    """What ``SCORES`` says of some sets; ``own`` are kinds that are right for single effects."""
    asked = [x for x in lines if x.get("explained") is not None]
    clear = [x for x in asked if x["explained"] > EXPLAINS]
    sure = [x for x in clear if max(x["kinds"].values()) > SURE]
    right = [x for x in sure if x["kind"] in kinds_of(effect_of(x), own)]
    terms = [
        f"{effect_of(x)}: {name}"
        for x in clear
        for name, share in x["terms"].items()
        if share > SURE and name != NOTHING_KNOWN
    ]
    return (
        f"{len(asked)} of {len(lines)}",
        len(clear),
        f"{len(sure)}: {count_words(x['kind'] for x in sure)}",
        f"{len(right)} of {len(sure)}",
        *(median_of(asked, name) for name in ("correlation", "inside", "inside_plain")),
        count_words(terms),
        f"{sum(x['sure_nonzero'] for x in asked) / max(len(asked), 1):.3f}",
    )


def write_scores(lines: list[Line]) -> str:
    """Figures of a record in Markdown."""
    strong = [x for x in lines if max(x["signal"].values(), default=0.0) > 8.0]
    groups = {
        "an effect": [x for x in lines if x["truth"]],
        "of more than 8 sd": strong,
        "nothing missing": [x for x in lines if not x["truth"]],
    }
    rows = [(name, *score_group(own)) for name, own in groups.items()]
    return write_table(("", *SCORES), rows)


def list_jobs(args: argparse.Namespace) -> dict[str, Job]:
    """Two sets with an effect, one without in turn."""
    kinds = ("withheld", "withheld", "none")
    tasks = [
        Task(kinds[n % 3], 3, 10, args.physics, args.seed + n) for n in range(args.sets)
    ]
    return {task.key: partial(infer_set, task) for task in tasks}


def main() -> None:
    """Run or tabulate."""
    parser, _, runs = start_commands(__doc__, sets=40)
    runs.add_argument("--physics", choices=PHYSICS, default="transport")
    finish_command(parser, list_jobs, write_scores)


if __name__ == "__main__":
    main()
