"""One set of the benchmark from its task to its line: make it, diagnose it, judge parts against the
truth, add baselines.
"""

import hashlib
import importlib
import json
import math
import numbers
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from typing import Any

from benchmarks.gap.baselines import baselines
from benchmarks.gap.identity import compare_designs
from benchmarks.gap.sets import GEL, SyntheticSet, Task, make_set
from benchmarks.gap.signals import signal_by_phase
from benchmarks.gap.table import families
from imr_torch.assimilate import SearchOptions
from imr_torch.gap import LIBRARY, GapReport, diagnose, to_json
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.gap.hypotheses import Hypothesis, fit_hypotheses, laplace_evidence
from imr_torch.gap.locate import onset
from imr_torch.gap.prediction import held_out, hold_out
from imr_torch.gap.shrinkage import judge
from imr_torch.goodness.phases import PHASES
from imr_torch.goodness.score import ADEQUATE
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.simulate import Simulator, fewer_steps

_DECIDING = (
    "goodness.score",
    "gap.adequacy",
    "gap.lookalike",
    "gap.evidence",
    "gap.verdict",
    "gap.attribute",
    "gap.diagnose",
    "gap.hypotheses",
    "gap.locate",
    "gap.refitted",
    "gap.restrict",
    "gap.prediction",
    "gap.shrinkage",
    "gap.windows",
)
_LOUD = 4.5  # sd at which one test of hundreds rejects at one per cent
_LESS = 0.7  # amplitude of a second start over the true one
_KEPT = (
    "gap",
    "p_gap",
    "bias_sigma",
    "verdict",
    "cause",
    "adequacy_p",
    "converged",
    "seconds",
    "members",
    "posterior_at_odds",
    "unknown",
)


@dataclass(frozen=True)
class Extras:
    """Parts beside the verdict.

    Args:
        onset: the phase in which the gap begins.
        shrinkage: how far the truth shrinks the gap on unseen designs, and whether the best wrong
            effect is exposed.
        baselines: what others would do.
    """

    onset: bool = False
    shrinkage: bool = False
    baselines: bool = True


def thresholds() -> dict[str, str]:
    """Every constant of the modules that decide, by module and name."""
    found = {"assimilate.SearchOptions": repr(SearchOptions())}
    for place in _DECIDING:
        module = importlib.import_module(f"imr_torch.{place}")
        name = place.partition(".")[2]
        for key, value in vars(module).items():
            plain = isinstance(value, numbers.Number | tuple) or (
                is_dataclass(value) and not isinstance(value, type)
            )
            if key.isupper() and plain:
                found[f"{name}.{key}"] = repr(value)
    return found


def frozen() -> str:
    """Hash of the thresholds and of the library with its priors and starts.

    It stands in every line.
    """
    effects = [
        (effect.name, list(effect.names), repr(effect.priors), effect.starts)
        for effect in LIBRARY.values()
    ]
    document = json.dumps([thresholds(), effects])
    return hashlib.sha256(document.encode()).hexdigest()[:12]


def run_task(task: Task, extras: Extras | None = None) -> dict[str, Any]:
    """The line of a task, ready for JSON; what failed is in it, as an undecided verdict with the
    reason.

    Args:
        task: the set.
        extras: parts beside the verdict.
    """
    extras = extras or Extras()
    line: dict[str, Any] = {
        "key": task.key,
        "kind": task.kind,
        "size": task.size,
        "physics": task.physics,
    }
    line |= {
        "nuisances": task.nuisances,
        "seed": task.seed,
        "truths": task.truths,
        "frozen": frozen(),
    }
    try:
        if task.kind == "next":
            no_verdict = {"gap": False, "verdict": "next", "cause": []}
            return line | no_verdict | compare_designs(task, fewer_steps(task.simulator()))
        data = make_set(task)
        line |= {"truth": list(data.truth), "values": data.values, "signal": data.signal}
        line |= {
            "designs": [list(e.design) for e in data.experiments],
            "offered": len(data.offered),
        }
        simulator = task.simulator()
        seed = child(task.seed, "diagnosis", task.key)
        report = diagnose(data.experiments, effects=data.offered, simulator=simulator, seed=seed)
        line |= summary(report)
        for part in _parts(data, report, simulator, seed, extras):
            line |= part
    except Exception as error:  # hours of other sets must not be lost with it
        line = {
            "truth": [],
            "gap": False,
            "verdict": "undecided",
            "cause": [],
            "converged": False,
        } | line
        line["error"] = f"{type(error).__name__}: {error}"
    return line


def summary(report: GapReport) -> dict[str, Any]:
    """What a report says, in the words of the command's JSON.

    ``selected`` are effects that were settled on before the last; ``"none"`` in the posterior
    beside them is called by their names, so that a name always says all that acts.
    """
    document = to_json(report)
    line: dict[str, Any] = {key: document[key] for key in _KEPT}
    line |= {"selected": [], "winner": None, "posterior": None, "credible_set": None}
    found = report.attribution
    if report.steps:
        first = report.steps[0]
        chance = first.likeness.chance if first.likeness else math.nan
        line["first"] = {
            "chance": chance,
            "adequate": first.adequacy.p_value >= ADEQUATE,
            "winner": first.winner,
        }
    if found is not None:
        *before, _ = found.winner.split("+")
        own = {"none": "+".join(before)} if before else {}
        line["selected"], line["winner"] = before, found.winner
        line["posterior"] = {
            own.get(name, name): p for name, p in found.posterior.items() if p > 1e-6
        }
        line["credible_set"] = [own.get(name, name) for name in found.credible_set(0.95)]
    return line


def _parts(
    data: SyntheticSet, report: GapReport, simulator: Simulator, seed: int, extras: Extras
) -> Iterator[dict[str, Any]]:
    """The parts asked for, as far as the report allows them."""
    if extras.baselines:
        yield {
            "baselines": baselines(
                report, report.line, data.offered, simulator, seed=child(seed, "baselines")
            )
        }
    if not report.found:
        return
    if report.cause and len(data.truth) == 1 and not families(data.truth) <= families(report.cause):
        yield _advantage(data, report, simulator, seed)
    if extras.onset and data.truth:
        yield _onset(data, report, simulator, seed)
    if extras.shrinkage and len(data.truth) == 1 and report.attribution is not None:
        yield _shrinkage(data, report, simulator, seed)


def _onset(
    data: SyntheticSet, report: GapReport, simulator: Simulator, seed: int
) -> dict[str, Any]:
    """When the gap begins, found and true: the first phase up to whose end the truth adds what
    shows in a test for it.
    """
    own = child(seed, "onset")
    gel = {name: data.values[name] for name in GEL}
    shown = signal_by_phase(gel, data.values, ExperimentBatch(data.experiments), simulator)
    true = next((phase for phase, size in zip(PHASES, shown, strict=True) if size >= _LOUD), "none")
    when = onset(
        report.null, report.line, report.batch, simulator, seed=own, directions=report.directions
    )
    return {
        "phase": true,
        "signal_by_phase": shown,
        "onset_phase": when.phase,
        "onset_t": when.time,
    }


def _advantage(
    data: SyntheticSet, report: GapReport, simulator: Simulator, seed: int
) -> dict[str, Any]:
    """Nats by which the truth explains the data better than what is wrongly suspected, so what
    could be known at all.
    """
    found, (truth,) = report.attribution, data.truth
    assert found is not None
    values = tuple(data.values[name] for name in LIBRARY[truth].names)
    starts = {truth: [values, (_LESS * values[0], *values[1:])]}
    right = Hypothesis(report.null.prior, (LIBRARY[truth],))
    fits = fit_hypotheses(
        [right], report.null, report.batch, simulator, seed=child(seed, "truth"), starts=starts
    )
    return {"truth_ahead": laplace_evidence(fits[truth]) - found.log_evidence[found.winner]}


def _shrinkage(
    data: SyntheticSet, report: GapReport, simulator: Simulator, seed: int
) -> dict[str, Any]:
    """How far the right effect shrinks the gap on unseen designs, measured and true, and whether
    the best wrong one is exposed.

    A wrong effect is exposed if its own fit is not adequate, or if it loses to the right one on the
    unseen designs by two standard errors. Fits that the diagnosis gave up, since they were behind,
    are finished here. Nothing for a truth that was not offered, or not fitted alone because another
    effect was settled on first: that is counted as a miss of the attribution.
    """
    found = report.attribution
    truth = data.truth[0]
    assert found is not None
    wrong = [
        name
        for name in found.fits
        if name in LIBRARY and LIBRARY[name].family != LIBRARY[truth].family
    ]
    if truth not in found.fits:
        return {}
    rival = max(wrong, key=lambda name: found.log_evidence[name], default=None)
    right = Hypothesis(report.null.prior, (LIBRARY[truth],))
    other = Hypothesis(report.null.prior, (LIBRARY[rival],)) if rival else None
    fits = {"none": report.null} | {n: found.fits[n] for n in (truth, rival) if n}
    loose = [h for h in (right, other) if h and not fits[h.name].certificate.converged]
    fits |= (
        fit_hypotheses(loose, report.null, report.batch, simulator, seed=child(seed, "loose"))
        if loose
        else {}
    )
    unseen = ExperimentBatch(data.unseen, report.batch.noise)
    held = hold_out(fits, report.batch, simulator, seed=seed, unseen=unseen)
    judged = judge(right, other, fits, held, seed=child(seed, "shrinkage"))
    clean = data.noiseless(unseen=True)
    parts = [ExperimentBatch((e,), clean.noise) for e in clean.experiments]
    true_gap = {
        n: sum(float(held_out(fits[n], p, simulator).residual.square().sum()) for p in parts)
        for n in ("none", truth)
    }
    line: dict[str, Any] = {
        "shrinkage": list(judged.shrinkage[truth]),
        "shrinkage_true": 1.0 - true_gap[truth] / max(true_gap["none"], 1e-300),
        "rival": rival,
    }
    if rival:
        adequacy = adequacy_test(
            fits[rival], data.offered, report.batch, simulator, seed=child(seed, "rival")
        ).test
        lost = any(c.against == rival and c.won for c in judged.comparisons)
        line |= {
            "rival_adequacy_p": adequacy.p_value,
            "rival_lost": lost,
            "rival_exposed": adequacy.p_value < ADEQUATE or lost,
        }
    return line
