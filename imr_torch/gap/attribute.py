"""Which effect causes the gap: evidence over equivalence classes, none and other, and whether the winner is enough.

Every effect is ranked by its score at the null fit, the leading ones are refitted, and refitting stops when the rest cannot
catch up. The evidence is that of the Gaussian approximation. A closed library always names somebody, so the winner must also
be adequate: the gap test at its own fit gives ``p_ad``, and "other" is weighed by the bound of Sellke, Bayarri & Berger (Am.
Stat. 55, 2001) on what an unknown alternative could gain, ``1/(-e p ln p)``.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from imr_torch.assimilate import Assimilation, EnsembleOptions, ModelFit, assimilate
from imr_torch.gap.effects import Effect
from imr_torch.gap.hypotheses import Hypothesis, fit_hypotheses, laplace_evidence
from imr_torch.gap.linear import linearise
from imr_torch.gap.score import GapTest, block, effect_directions, gap_test, generic_blocks, promising_starts
from imr_torch.material import Belief, ModelBelief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

PRIOR_NONE, PRIOR_OTHER = 0.5, 0.1
ADEQUATE = 0.01
"""Below this ``p_ad`` the winner leaves a gap, and the verdict is a further effect or "other"."""

_ROUND = 12  # effects refitted together
_BEHIND = 8.0  # nats by which the best possible evidence of the rest must lag for refitting to stop
_CONTENDER = 5.0  # nats behind the best within which a fit has to be finished
_LOOSE = EnsembleOptions(iterations=25, hopeless=12.0)


@dataclass(frozen=True)
class Attribution:
    """What the data say about causes.

    Args:
        fits: hypothesis -> fit, for those that were refitted; ``"none"`` among them.
        log_evidence: hypothesis -> nats.
        posterior: hypothesis -> probability, with ``"none"`` and ``"other"``; effects that were not refitted are below 1e-3.
        families: class -> probability, effects that are the same to first order summed.
        winner: name of the best hypothesis beside none.
        adequacy: the gap test at the winner's fit.
        next_starts: from where a further effect beside the winner would start.
    """

    fits: dict[str, ModelFit]
    log_evidence: dict[str, float]
    posterior: dict[str, float]
    families: dict[str, float]
    winner: str
    adequacy: GapTest
    next_starts: dict[str, tuple[tuple[float, ...], ...]]

    def credible_set(self, level: float = 0.95) -> tuple[str, ...]:
        """The most probable entries of the posterior that together reach a level."""
        names, total = [], 0.0
        for name, probability in sorted(self.posterior.items(), key=lambda item: -item[1]):
            names.append(name)
            total += probability
            if total >= level:
                break
        return tuple(names)


def attribute(
    base: ModelBelief,
    effects: Sequence[Effect],
    null: ModelFit,
    gap: GapTest,
    starts: Mapping[str, Sequence[Sequence[float]]],
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    with_: Sequence[Effect] = (),
    progress: Progress | None = None,
) -> Attribution:
    """Refit the leading effects and weigh them.

    Args:
        base: the base model's prior.
        effects: the library to choose from.
        null: the fit that leaves a gap, from which effects start.
        gap: the gap test at that fit, for the ranking.
        starts: from which values each effect starts (:func:`imr_torch.gap.score.promising_starts`).
        batch: the data.
        simulator: makes the bubbles.
        seed: of the fits and of the adequacy test.
        with_: effects that are in every hypothesis already (forward selection of a second one).
        progress: called with one line per step.
    """
    fits = _refit(base, effects, null, gap, starts, batch, simulator, seed=seed, with_=tuple(with_), progress=progress)
    null_name = Hypothesis(base, tuple(with_)).name
    fits |= _finish({n: f for n, f in fits.items() if n != null_name}, batch, simulator, seed=child(seed, "finish"))
    evidence = {name: laplace_evidence(fit) for name, fit in fits.items()}
    winner = max((name for name in fits if name != null_name), key=evidence.__getitem__)
    adequacy, next_starts = adequacy_test(fits[winner], effects, batch, simulator, seed=child(seed, "adequacy"))
    posterior, families = _weigh(evidence, effects, tuple(with_), adequacy.p_value)
    return Attribution(fits, evidence, posterior, families, winner, adequacy, next_starts)


def adequacy_test(
    fit: ModelFit, effects: Sequence[Effect], batch: ExperimentBatch, simulator: Simulator, *, seed: int
) -> tuple[GapTest, dict[str, tuple[tuple[float, ...], ...]]]:
    """The gap test at a fit: whether anything is left that the library or the generic blocks can see.

    Returns:
        The test, and from where each effect that the fit does not hold would start.
    """
    line = linearise(fit, batch, simulator)
    others = [effect for effect in effects if not set(effect.names) & set(fit.prior.names)]
    rows = effect_directions(others, fit, batch, simulator, line)
    blocks = [block(name, directions, line) for name, directions in rows.items()]
    starts = {effect.name: promising_starts(effect, rows[effect.name], line) for effect in others}
    return gap_test([*blocks, *generic_blocks(fit, batch, simulator, line)], line, seed=seed), starts


def _refit(
    base: ModelBelief,
    effects: Sequence[Effect],
    null: ModelFit,
    gap: GapTest,
    starts: Mapping[str, Sequence[Sequence[float]]],
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    with_: tuple[Effect, ...],
    progress: Progress | None,
) -> dict[str, ModelFit]:
    """Fits of the null and of the leading effects, in rounds from the best score downwards."""
    score = {result.name: result.statistic for result in gap.blocks}
    waiting = sorted(effects, key=lambda effect: -score.get(effect.name, 0.0))
    fits = {Hypothesis(base, with_).name: null}
    best = laplace_evidence(null)
    while waiting:
        # the score is what an effect can gain to first order; twice that is allowed for what is not
        if len(fits) > _ROUND and laplace_evidence(null) + score.get(waiting[0].name, 0.0) < best - _BEHIND:
            break
        leading, waiting = waiting[:_ROUND], waiting[_ROUND:]
        if progress:
            progress(f"attribution: refitting {', '.join(effect.name for effect in leading)}")
        hypotheses = [Hypothesis(base, (*with_, effect)) for effect in leading]
        found = fit_hypotheses(hypotheses, null, batch, simulator, seed=seed, starts=starts, options=_LOOSE, progress=progress)
        fits |= found
        best = max(best, *(laplace_evidence(fit) for fit in found.values()))
    return fits


def _finish(fits: Mapping[str, ModelFit], batch: ExperimentBatch, simulator: Simulator, *, seed: int) -> dict[str, ModelFit]:
    """Refit, near where they got, the contenders whose search was cut short or whose starts did not agree."""
    best = max(laplace_evidence(fit) for fit in fits.values())
    open_ = [name for name, fit in fits.items() if not fit.certificate.converged and laplace_evidence(fit) > best - _CONTENDER]
    if not open_:
        return {}
    belief = Belief(tuple(fits[name].prior for name in open_), torch.zeros(len(open_), dtype=torch.float64))
    near = Assimilation(belief, batch, tuple(fits[name] for name in open_))
    found = assimilate(belief, batch, simulator, seed=seed, options=EnsembleOptions(starts=2), near=near)
    return dict(zip(open_, found.fits, strict=True))


def _weigh(
    evidence: dict[str, float], effects: Sequence[Effect], with_: tuple[Effect, ...], p_adequate: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Posterior over hypotheses and over families, with ``"none"`` (of the effects asked about) and ``"other"``."""
    families = sorted({effect.family for effect in effects})
    share = (1.0 - PRIOR_NONE - PRIOR_OTHER) / len(families)
    prefix = "+".join(effect.name for effect in with_)
    weights: dict[str, float] = {}
    family_of = {}
    for effect in effects:
        name = f"{prefix}+{effect.name}" if prefix else effect.name
        members = sum(other.family == effect.family for other in effects)
        family_of[name] = effect.family
        if name in evidence:
            weights[name] = math.log(share / members) + evidence[name]
    weights["none"] = math.log(PRIOR_NONE) + evidence[prefix or "none"]
    top = max(weights.values())
    known = sum(math.exp(w - top) for w in weights.values())
    bound = -math.e * p_adequate * math.log(p_adequate) if p_adequate < 1.0 / math.e else 1.0
    other = known * PRIOR_OTHER / (1.0 - PRIOR_OTHER) / max(bound, 1e-12)
    posterior = {name: math.exp(w - top) / (known + other) for name, w in weights.items()} | {"other": other / (known + other)}
    classes: dict[str, float] = {}
    for name, probability in posterior.items():
        family = family_of.get(name, name)
        classes[family] = classes.get(family, 0.0) + probability
    return posterior, classes
