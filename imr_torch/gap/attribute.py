"""Attribution of the gap: evidence of each effect, of none and of an unknown one, and the adequacy of the best.

All effects are fitted in one batch, from two starts or, where an effect has several minima, from more; one is discarded once it
cannot come within 6 nats of the best. (Scores at the null fit rank small effects well and large ones badly, so they only choose
from where to start.) The evidence is that of the Gaussian approximation. A closed library always has a best effect, so that
must also be adequate: the gap test at its own fit gives ``p_ad``, and the probability of "other" follows from how often one or
two known effects fit the data of an unknown one, and by the bound of Sellke, Bayarri & Berger (Am. Stat. 55, 2001) on what it
could gain, ``1/(-e p ln p)``.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from imr_torch.assimilate import ModelFit, SearchOptions
from imr_torch.gap.hypotheses import Hypothesis, finish, fit_hypotheses, laplace_evidence
from imr_torch.gap.linear import Linearisation, linearise
from imr_torch.gap.refitted import refitted_directions
from imr_torch.gap.score import GapTest, block, effect_directions, gap_test, generic_blocks, promising_starts
from imr_torch.material import Effect, ModelBelief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

PRIOR_NONE, PRIOR_OTHER = 0.5, 0.1
PRIOR_TWO = 0.05
"""That two effects of the library act at once; ``PRIOR_OTHER`` is for one that is not in it."""
ADEQUATE = 0.05
"""Below this ``p_ad`` the winner leaves a gap, and the verdict is a further effect or "other"; a right winner is so doubted by
chance once in twenty. In the sets tried, two of four adequate wrong winners lay between .01 and here, one of 39 right ones."""

_MASKED = 0.35  # chance that some effect of the library is adequate although the true one is not in it
_MASKED_BY_TWO = 0.14  # that two are together, where none is alone: five of 35 withheld effects
_LESS = 0.7  # amplitude of a second start over that of the first, where the first is an estimate
_FIT = SearchOptions(starts=2, iterations=30, drop_behind=6.0, basin_rounds=0, polish=False)  # the winner's is finished later


@dataclass(frozen=True)
class Attribution:
    """Fits, evidence and probabilities of all causes.

    Args:
        fits: hypothesis -> fit, ``"none"`` among them; one that was discarded is not converged.
        log_evidence: hypothesis -> nats.
        posterior: hypothesis -> probability, with ``"none"`` and ``"other"``; those not fitted to the end are far behind.
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


@dataclass(frozen=True)
class Inquiry:
    """The attribution problem: a base model, candidate effects and data.

    Args:
        base: the base model's prior.
        effects: the library to choose from.
        batch: the data.
        simulator: makes the bubbles.
    """

    base: ModelBelief
    effects: tuple[Effect, ...]
    batch: ExperimentBatch
    simulator: Simulator

    def beside(self, chosen: Sequence[Effect]) -> tuple[Effect, ...]:
        """The effects that share no parameter with those chosen."""
        taken = {name for effect in chosen for name in effect.names}
        return tuple(effect for effect in self.effects if not taken & set(effect.names))


def attribute(
    inquiry: Inquiry,
    null: ModelFit,
    starts: Mapping[str, Sequence[Sequence[float]]],
    *,
    seed: int,
    with_: Sequence[Effect] = (),
    progress: Progress | None = None,
) -> Attribution:
    """Fit all effects and compute their probabilities.

    Args:
        inquiry: base model, effects and data.
        null: the fit that leaves a gap, from which effects start.
        starts: from which values each effect starts (:func:`imr_torch.gap.score.promising_starts`).
        seed: of the fits and of the adequacy test.
        with_: effects that are in every hypothesis already (forward selection of a second one).
        progress: called with one line per step.
    """
    base, batch, simulator, effects = inquiry.base, inquiry.batch, inquiry.simulator, inquiry.beside(with_)
    null_name = Hypothesis(base, tuple(with_)).name
    hypotheses = [Hypothesis(base, (*with_, effect)) for effect in effects]
    if progress:
        progress(f"attribution: {len(effects)} effects")
    found = fit_hypotheses(hypotheses, null, batch, simulator, seed=seed, starts=starts, options=_FIT, progress=progress)
    fits = {null_name: null} | found
    evidence = {name: laplace_evidence(fit) for name, fit in fits.items()}
    winner = max((name for name in fits if name != null_name), key=lambda name: evidence[name])
    if not fits[winner].certificate.converged:
        fits[winner] = finish(fits[winner], batch, simulator, seed=child(seed, "finish"), progress=progress)
        evidence[winner] = laplace_evidence(fits[winner])
    return _judged(inquiry, fits, evidence, winner, tuple(with_), seed=child(seed, "adequacy"))


def reconsider(inquiry: Inquiry, found: Attribution, effect: Effect, beside: ModelFit, *, seed: int) -> Attribution:
    """The attribution of a first effect again, once another was found beside its winner: is that one better alone?

    An effect with several minima (the moment of a pulse) may be found only beside another effect that explains most.

    Args:
        inquiry: base model, effects and data.
        found: the attribution of the first effect.
        effect: the one found beside it.
        beside: the fit of both.
        seed: of the fit and of the adequacy test.

    Returns:
        ``found`` itself unless the effect alone explains more than its winner.
    """
    batch, simulator = inquiry.batch, inquiry.simulator
    places = map(beside.prior.names.index, effect.names)
    amplitude, *shape = (float(beside.prior.marginals[i].to_physical(beside.mean[i])) for i in places)
    starts = {effect.name: [(amplitude, *shape), (_LESS * amplitude, *shape)]}
    alone = Hypothesis(inquiry.base, (effect,))
    fit = fit_hypotheses([alone], beside, batch, simulator, seed=seed, starts=starts, options=_FIT)[alone.name]
    if laplace_evidence(fit) <= found.log_evidence[found.winner]:
        return found
    if not fit.certificate.converged:
        fit = finish(fit, batch, simulator, seed=child(seed, "finish"))
    fits, evidence = found.fits | {alone.name: fit}, found.log_evidence | {alone.name: laplace_evidence(fit)}
    return _judged(inquiry, fits, evidence, alone.name, (), seed=child(seed, "adequacy"))


def _judged(
    inquiry: Inquiry,
    fits: dict[str, ModelFit],
    evidence: dict[str, float],
    winner: str,
    with_: tuple[Effect, ...],
    *,
    seed: int,
) -> Attribution:
    """Fits with what their evidence and the winner's adequacy say."""
    left = adequacy_test(fits[winner], inquiry.effects, inquiry.batch, inquiry.simulator, seed=seed)
    posterior, families = _weigh(evidence, inquiry.beside(with_), with_, left.test.p_value)
    return Attribution(fits, evidence, posterior, families, winner, left.test, left.starts)


@dataclass(frozen=True)
class Adequacy:
    """The gap test at a fit that includes effects: whether anything is left unexplained.

    Args:
        test: the gap test there.
        starts: from where each effect that the fit does not hold would start.
        line: local sensitivities at the fit.
        directions: what each of those effects changes there (:func:`imr_torch.gap.score.effect_directions`).
    """

    test: GapTest
    starts: dict[str, tuple[tuple[float, ...], ...]]
    line: Linearisation
    directions: dict[str, Tensor]


def adequacy_test(
    fit: ModelFit, effects: Sequence[Effect], batch: ExperimentBatch, simulator: Simulator, *, seed: int
) -> Adequacy:
    """The gap test at a fit, of effects that it does not hold and of the generic blocks."""
    line = linearise(fit, batch, simulator)
    others = [effect for effect in effects if not set(effect.names) & set(fit.prior.names)]
    directions = effect_directions(others, fit, batch, simulator, line)
    beside = refitted_directions(others, fit, batch, simulator, line, directions)
    generic = generic_blocks(fit, batch, simulator, line)
    blocks = [block(name, rows, line) for name, rows in beside.items()]
    starts = {effect.name: promising_starts(effect, beside[effect.name], line) for effect in others}
    return Adequacy(gap_test([*blocks, *generic], line, seed=seed), starts, line, directions)


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
    other = known * _odds_of_other(p_adequate, two=bool(with_))
    posterior = {name: math.exp(w - top) / (known + other) for name, w in weights.items()} | {"other": other / (known + other)}
    classes: dict[str, float] = {}
    for name, probability in posterior.items():
        family = family_of.get(name, name)
        classes[family] = classes.get(family, 0.0) + probability
    return posterior, classes


def _odds_of_other(p_adequate: float, *, two: bool) -> float:
    """Odds of an effect that is not in the library against what is, one or ``two`` of whose effects leave ``p_adequate``."""
    one_alone, two_at_once = PRIOR_OTHER / (1.0 - PRIOR_OTHER), PRIOR_OTHER * (1.0 - _MASKED) / PRIOR_TWO
    masked = two_at_once * _MASKED_BY_TWO if two else one_alone * _MASKED
    p = max(p_adequate, 1e-300)  # may have underflowed
    bound = -math.e * p * math.log(p) if p < 1.0 / math.e else 1.0
    return masked / max(bound, 1e-12)
