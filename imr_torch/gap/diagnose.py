"""The whole diagnosis in order: null fit, gap test, location, attribution, shrinkage, next design.

Each step is usable alone; this runs them, stops where a step has nothing to build on, and says so. No verdict is given
without converged fits.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from imr_torch.assimilate import ModelFit
from imr_torch.errors import InputDataError
from imr_torch.gap.attribute import ADEQUATE, Attribution, adequacy_test, attribute
from imr_torch.gap.effects import LIBRARY, Effect, library
from imr_torch.gap.hypotheses import Hypothesis, fit_null
from imr_torch.gap.score import GapTest
from imr_torch.material import ModelBelief, wide_prior
from imr_torch.observe import Experiment, ExperimentBatch, Noise
from imr_torch.random import child
from imr_torch.simulate import ACCURACIES, Simulator, TransportSimulator
from imr_torch.types import Progress

_SURE = 0.8  # probability of one family at which a cause is named alone


@dataclass(frozen=True)
class GapReport:
    """What a diagnosis found.

    Args:
        batch: the data, with their noise.
        null: the base model's fit.
        gap: the gap test at that fit.
        attribution: causes, if there is a gap; of the last effect where several were selected.
        verdict: ``"none"``, ``"effect"``, ``"class"``, ``"other"`` or ``"undecided"``.
        cause: names of the effects that the verdict names.
        seconds: wall time.
        reason: one sentence on how the verdict came about.
    """

    batch: ExperimentBatch
    null: ModelFit
    gap: GapTest
    attribution: Attribution | None
    verdict: str
    cause: tuple[str, ...]
    seconds: float
    reason: str = field(default="")

    @property
    def converged(self) -> bool:
        """Whether the fits that the verdict stands on carry clean certificates."""
        sound = self.null.certificate.converged
        if self.attribution is not None:
            sound &= self.attribution.fits[self.attribution.winner].certificate.converged
        return sound


def diagnose(
    experiments: Sequence[Experiment],
    *,
    base: ModelBelief | None = None,
    effects: Sequence[Effect] | None = None,
    noise: Noise | None = None,
    simulator: Simulator | None = None,
    most: int = 2,
    seed: int = 0,
    progress: Progress | None = None,
) -> GapReport:
    """Diagnose the gap between a base model and data.

    Args:
        experiments: the data, one entry a design.
        base: prior of the base model; a wide prior of NHKV by default.
        effects: the library to choose from; all that can be put on the base by default.
        noise: law of one repeat's noise.
        simulator: makes the bubbles; full physics by default.
        most: effects that are selected one after the other, at most.
        seed: of every random number.
        progress: called with one line per step.

    Raises:
        InputDataError: without an effect to choose from.
    """
    start = time.perf_counter()
    base = base or wide_prior(("nhkv",)).models[0]
    effects = tuple(library(base=base.model) if effects is None else effects)
    if not effects:
        raise InputDataError(f"No effect is left that can be put on {base.model!r}; known are {', '.join(LIBRARY)}.")
    simulator = simulator or TransportSimulator(accuracy=ACCURACIES["search"])
    batch = ExperimentBatch(tuple(experiments), noise or Noise())
    null = fit_null(base, batch, simulator, seed=child(seed, "null"), progress=progress)
    gap, starts = adequacy_test(null, effects, batch, simulator, seed=child(seed, "gap"))
    if progress:
        progress(f"gap test: p = {gap.p_value:.2g}, leading block {gap.blocks[0].name}")

    def report(verdict: str, cause: tuple[str, ...], reason: str, found: Attribution | None = None) -> GapReport:
        return GapReport(batch, null, gap, found, verdict, cause, time.perf_counter() - start, reason)

    if not null.certificate.converged:
        return report("undecided", (), f"The base model's fit did not converge: {null.certificate}.")
    if not gap.found:
        return report("none", (), "No block of the gap test rejects the base model.")
    return _decide(base, effects, null, gap, starts, batch, simulator, most, seed, progress, report)


def _decide(base, effects, null, gap, starts, batch, simulator, most, seed, progress, report) -> GapReport:
    """Select effects one after the other until one is adequate; name it, its class, or nobody."""
    chosen: tuple[Effect, ...] = ()
    fit, test = null, gap
    first: Attribution | None = None
    for step in range(most):
        left = tuple(e for e in effects if not set(e.names) & {n for c in chosen for n in c.names})
        found = attribute(
            base,
            left,
            fit,
            test,
            starts,
            batch,
            simulator,
            seed=child(seed, "attribute", step),
            with_=chosen,
            progress=progress,
        )
        if step and found.log_evidence[found.winner] < found.log_evidence[Hypothesis(base, chosen).name] + 3.0:
            break  # a further effect that explains nothing is none
        first = first or found
        winner = found.winner.split("+")[-1]
        chosen = (*chosen, next(e for e in left if e.name == winner))
        fit, test, starts = found.fits[found.winner], found.adequacy, found.next_starts
        if test.p_value >= ADEQUATE:
            return _name(chosen, found, report)
    assert first is not None
    return report("other", (), f"No effect of the library is enough (adequacy p = {test.p_value:.2g}).", first)


def _name(chosen: tuple[Effect, ...], found: Attribution, report) -> GapReport:
    """An adequate cause: alone if it is sure, else the class of those that the data do not tell apart."""
    if not found.fits[found.winner].certificate.converged:
        return report("undecided", tuple(e.name for e in chosen), "The leading effect's fit did not converge.", found)
    before = tuple(effect.name for effect in chosen[:-1])
    names = {name: name.split("+")[-1] for name in found.posterior}
    ranked = sorted((n for n in found.posterior if n not in ("none", "other")), key=lambda n: -found.posterior[n])
    total = sum(found.posterior[n] for n in ranked)
    top = chosen[-1].family
    same = tuple(names[n] for n in ranked if LIBRARY[names[n]].family == top and found.posterior[n] > 0.05 * total)
    if sum(found.posterior[n] for n in ranked if LIBRARY[names[n]].family == top) >= _SURE * total:
        verdict = "effect" if len(same) == 1 else "class"
        return report(
            verdict, before + same, f"Adequate (p = {found.adequacy.p_value:.2g}), and the others are improbable.", found
        )
    cause, reached = [], 0.0
    for n in ranked:
        cause.append(names[n])
        reached += found.posterior[n]
        if reached >= 0.95 * total:
            break
    verdict = "class" if len(cause) <= 3 else "undecided"
    return report(verdict, before + tuple(cause), "These effects explain the data about equally well.", found)
