"""How much of a gap known effects close together: effects added one after the other, whether or not they are enough.

The verdict names a cause only if nothing is left unexplained. Measured curves nearly always leave something, and a laboratory
still asks which effects close how much of it, and what remains. Each step adds the effect of largest evidence beside those
chosen, and drops those that it makes superfluous. In the first two steps the fits of the attribution serve; later ones fit the
effects that a score test at the step before ranks first. A fit that does not converge is no step: the next best addition is
tried. A step is a description of the data, not a cause, and other curves of the same gel may prefer another one: each step
names the effects that are not clearly worse in place of its last one.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from imr_torch.assimilate import ModelFit, SearchOptions
from imr_torch.gap.adequacy import Adequacy, adequacy_test
from imr_torch.gap.attribute import Inquiry, near_values
from imr_torch.gap.hypotheses import EXPLAINS, Hypothesis, finish, fit_hypotheses, laplace_evidence, promised
from imr_torch.gap.prediction import GEL_SCATTER, HeldOut
from imr_torch.gap.shrinkage import compare, reductions
from imr_torch.goodness.phases import PHASES, noise_shares, phase_numbers
from imr_torch.goodness.score import ADEQUATE, GapTest
from imr_torch.material import Effect
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.types import Progress

_CANDIDATES = 6  # effects that are fitted in a later step
_TRIED = 2  # of these, additions that are taken to their minimum until one converges
_FIT = SearchOptions(starts=2, iterations=12, drop_behind=6.0, basin_rounds=0, polish=False)
_FINISH = SearchOptions(starts=2, iterations=15, basin_rounds=0)
_SURE = 1.645  # standard errors by which one of two models is better in 95 %
_CLEAR = 10.0  # standard deviations from zero at which an effect is kept: some 50 nats

_Fitted = tuple[tuple[Effect, ...], ModelFit]
"""Effects, and the fit with them freed."""

_Step = tuple[tuple[Effect, ...], ModelFit, list[_Fitted]]
"""Likewise, and the other additions that were fitted, that of largest evidence first."""


@dataclass(frozen=True)
class Left:
    """What a fit leaves in one phase of the bubble's life, root mean square over all mean curves, in R*.

    Args:
        phase: one of :data:`imr_torch.goodness.phases.PHASES`.
        misfit: of the residual beyond its noise; 0 if none.
        noise: of the mean curves, no more than the residuals leave room for.
        share: of the squared misfit of all phases.
        frames: how many it has.
    """

    phase: str
    misfit: float
    noise: float
    share: float
    frames: int


@dataclass(frozen=True)
class SelectionStep:
    """The base model with some effects, and what it leaves.

    Args:
        effects: those that are freed; none on the first step.
        fit: with its certificate.
        gained: log evidence over the step before, nats.
        test: the gap test at this fit.
        left: by phase, where frames exist.
        closed: lower, median and upper share of the held-out squared bias that is gone, 90 % interval; None where no design
            could be held out.
        log_score: held-out log predictive density over the base model, nats, and its standard error; None likewise.
        trained: whether the fits of the held-out designs have converged.
        alternatives: effects that are not clearly worse in place of the last one, best first: each gains enough, and its log
            evidence is behind by no more than ``EXPLAINS`` and what the misfit that is left may make by chance (95 %).

    >>> from imr_torch.gap.stepwise import Left
    >>> Left("first rebound", misfit=0.008, noise=0.003, share=0.7, frames=40).phase  # what a step leaves there
    'first rebound'
    """

    effects: tuple[str, ...]
    fit: ModelFit
    gained: float
    test: GapTest
    left: tuple[Left, ...]
    closed: tuple[float, float, float] | None = None
    log_score: tuple[float, float] | None = None
    trained: bool = True
    alternatives: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """``"none"``, or the effects joined by ``+``."""
        return "+".join(self.effects) or "none"

    @property
    def adequate(self) -> bool:
        """Whether the gap test leaves nothing to explain."""
        return self.test.p_value >= ADEQUATE

    @property
    def misfit(self) -> float:
        """Root mean square residual beyond noise over all frames, R*, none where a phase has less than its noise."""
        return _over_frames([part.misfit for part in self.left], self.left)

    @property
    def noise(self) -> float:
        """Root mean square noise of the mean curves over all frames, R*."""
        return _over_frames([part.noise for part in self.left], self.left)

    @property
    def converged(self) -> bool:
        """Whether its fit, and those to the training designs, have converged."""
        return self.fit.certificate.converged and self.trained

    @property
    def worst(self) -> Left:
        """The phase that holds most of what is left."""
        return max(self.left, key=lambda part: part.share)


@dataclass(frozen=True)
class StepwiseSelection:
    """The steps from the base model to the last effect that was added.

    Args:
        steps: the base model first.
        own_gels: steps at which every curve has a gel of its own, where that was asked (:mod:`imr_torch.gap.own_gels`).
        unsettled: effects, joined by ``+``, that would have been a step had their fit converged.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import diagnose, examine
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> simulator = PolytropicSimulator()
    >>> gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093, "sound_speed": 0.8})
    >>> laboratory = SimulatedLaboratory(simulator, gel, repeats=20)
    >>> shots = [laboratory.shoot(torch.tensor(d).double(), seed=i) for i, d in enumerate(((400.0, 0.22), (700.0, 0.16)))]
    >>> report = diagnose(shots, effects=library(["sound_speed"]), simulator=simulator)
    >>> selection = examine(report, simulator).selection
    >>> [step.name for step in selection.steps], selection.best.adequate
    (['none', 'sound_speed'], True)
    """

    steps: tuple[SelectionStep, ...]
    own_gels: tuple[SelectionStep, ...] = ()
    unsettled: tuple[str, ...] = ()

    @property
    def best(self) -> SelectionStep:
        """The step that closes some of the gap on held-out designs and predicts them best; the last where none was held out.

        Steps at which every curve has a gel of its own count too.
        """
        if self.steps[-1].log_score is None:
            return self.steps[-1]
        all_ = (*self.steps, *self.own_gels)
        scores = [step.log_score[0] if step.log_score and step.closed and step.closed[1] > 0.0 else 0.0 for step in all_]
        return all_[scores.index(max(scores))]

    def __str__(self) -> str:
        """One sentence on how much the best step closes, and what is left where."""
        last = self.best
        if not last.effects:
            return "No effect of the library closes any of the gap."
        verb = "closes" if len(last.effects) == 1 else "close"
        if last.closed is None:
            share = f"lower the misfit in R* from {self.steps[0].misfit:.4f} to {last.misfit:.4f}"
            share = share if verb == "close" else f"lowers{share[5:]}"
        else:
            low, middle, high = last.closed
            share = f"{verb} {middle:.2f} ({low:.2f} to {high:.2f}) of the gap on designs that the fits did not see"
        *others, end = ("a gel of its own for each curve" if name == GEL_SCATTER else name for name in last.effects)
        named = f"{', '.join(others)} and {end}" if others else end
        if last.adequate:
            return f"{named} {share}; what is left is noise."
        part = last.worst
        return (
            f"{named} {share}; what is left lies most in the phase {part.phase!r}, {part.misfit:.4f} in R* beside noise of "
            f"{part.noise:.4f}, and no further effect of the library was found to explain it."
        )


def select_stepwise(
    inquiry: Inquiry,
    null: ModelFit,
    test: GapTest,
    known: Mapping[str, ModelFit],
    *,
    tested: Mapping[str, Adequacy] | None = None,
    most: int = 4,
    seed: int,
    progress: Progress | None = None,
) -> StepwiseSelection:
    """Add effects one after the other until the fit is adequate, nothing more is gained, or there are ``most``.

    Args:
        inquiry: base model, effects and data.
        null: the base model's fit.
        test: the gap test there.
        known: hypothesis -> fit, those of an attribution; what is missing is fitted.
        tested: hypothesis -> the gap test at its fit in ``known``; what is missing is tested.
        most: effects at most.
        seed: of fits and tests.
        progress: called with one line per step.
    """
    batch = inquiry.batch
    fits = {frozenset(name.split("+")) - {"none"}: fit for name, fit in known.items()}
    steps, here = [SelectionStep((), null, 0.0, test, left_over(null, batch))], _Here((), null)
    seen, unsettled = {frozenset[str]()}, list[str]()
    while len(here.chosen) < most and not steps[-1].adequate and inquiry.beside(here.chosen):
        own, before = child(seed, "rung", len(steps)), here.fit
        found, failed = _next_step(inquiry, here, fits, seen, seed=own)
        unsettled += failed
        if found is None:
            break
        chosen, fit, others = found
        names = tuple(effect.name for effect in chosen)
        seen.add(frozenset(names))
        name = Hypothesis(inquiry.base, chosen).name
        left = (tested or {}).get(name) if fit is known.get(name) else None
        left = left or adequacy_test(fit, inquiry.effects, batch, inquiry.simulator, seed=child(own, "adequacy"))
        here = _Here(chosen, fit, left)
        gained = laplace_evidence(fit) - laplace_evidence(before)
        step = SelectionStep(names, fit, gained, left.test, left_over(fit, batch))
        steps.append(replace(step, alternatives=_not_clearly_worse(others, fit, laplace_evidence(before), batch)))
        if progress:
            progress(f"stepwise selection: {steps[-1].name}, misfit {steps[-1].misfit:.4f}")
    return StepwiseSelection(tuple(steps), unsettled=tuple(unsettled))


def with_held_out(selection: StepwiseSelection, held: Mapping[str, Sequence[HeldOut]], *, seed: int) -> StepwiseSelection:
    """A stepwise selection with the share of the gap that each step closes on designs that its fits did not see.

    Args:
        selection: judged in sample only.
        held: name of each step -> held-out predictions (:func:`imr_torch.gap.shrinkage.hold_out`).
        seed: of the bootstrap.
    """
    own = {step.name: held[step.name] for step in (*selection.steps, *selection.own_gels)}
    _, closed = reductions(own, seed)

    def judged(step: SelectionStep) -> SelectionStep:
        score = compare(own, step.name, "none")
        trained = all(design.converged for name in ("none", step.name) for design in own[name])
        said = (score.difference, score.standard_error)
        return replace(step, closed=closed[step.name], log_score=said, trained=trained)

    steps = (selection.steps[0], *map(judged, selection.steps[1:]))
    return replace(selection, steps=steps, own_gels=tuple(map(judged, selection.own_gels)))


def left_over(fit: ModelFit, batch: ExperimentBatch) -> tuple[Left, ...]:
    """The residual of a fit beyond its noise, by phase of the bubble's life."""
    sd = batch.sd(fit.prediction)
    residual = torch.where(batch.mask, batch.mean - fit.prediction, 0.0)
    phases = torch.where(batch.mask, phase_numbers(batch.times, fit.prediction, batch.mask), -1)
    shares = noise_shares([batch.whiten(residual, sd).square()], phases)
    square, noise = residual.square(), shares * sd.square() / batch.counts.clamp_min(1.0)
    sums: list[tuple[str, float, float, int]] = []
    for number, phase in enumerate(PHASES):
        inside = phases == number
        if count := int(inside.sum()):
            excess = float((square - noise)[inside].sum().clamp_min(0.0))
            sums.append((phase, excess, float(noise[inside].mean().sqrt()), count))
    total = max(sum(excess for _, excess, _, _ in sums), 1e-300)
    return tuple(Left(phase, math.sqrt(excess / count), sd, excess / total, count) for phase, excess, sd, count in sums)


def _not_clearly_worse(others: Sequence[_Fitted], fit: ModelFit, had: float, batch: ExperimentBatch) -> tuple[str, ...]:
    """Last effects of these additions that gain enough beside evidence ``had`` and are not clearly behind a fit, best first."""
    best, found = laplace_evidence(fit), list[str]()
    for effects, other in others:
        evidence = laplace_evidence(other)
        if evidence >= max(had + EXPLAINS, best - EXPLAINS - _SURE * misfit_in_difference(fit, other, batch)):
            found.append(effects[-1].name)
    return tuple(found)


def misfit_in_difference(fit: ModelFit, other: ModelFit, batch: ExperimentBatch) -> float:
    """Standard error, nats, of the log likelihood of a fit over another's that is due to what the fit leaves beyond noise.

    With residuals ``r`` of the fit and the difference ``d`` of the predictions, both whitened, the likelihoods differ by
    ``d.d/2 - d.r``. The variance of ``d.r`` is that of its terms and their neighbours (Newey and West, Econometrica 55, 1987),
    less the ``d.d`` of noise; so models are compared that may both be wrong (Vuong, Econometrica 57, 1989).
    """
    sd = batch.sd(fit.prediction)
    apart, left = (torch.where(batch.mask, x - fit.prediction, 0.0) for x in (other.prediction, batch.mean))
    apart, left = (batch.whiten(x, sd) for x in (apart, left))
    terms, lags = apart * left, int(4.0 * (apart.shape[-1] / 100.0) ** (2.0 / 9.0))
    variance = float(terms.square().sum() - apart.square().sum())
    for lag in range(1, lags + 1):
        variance += 2.0 * (1.0 - lag / (lags + 1)) * float((terms[:, lag:] * terms[:, :-lag]).sum())
    return math.sqrt(max(variance, 0.0))


def _over_frames(values: Sequence[float], parts: Sequence[Left]) -> float:
    """Root mean square over the frames of all phases."""
    frames = sum(part.frames for part in parts)
    return math.sqrt(sum(value**2 * part.frames for value, part in zip(values, parts, strict=True)) / frames)


@dataclass(frozen=True)
class _Here:
    """Where the selection stands: the effects, their fit, and the gap test there, None of the base model."""

    chosen: tuple[Effect, ...]
    fit: ModelFit
    left: Adequacy | None = None


def _next_step(
    inquiry: Inquiry, here: _Here, fits: dict[frozenset[str], ModelFit], seen: set[frozenset[str]], *, seed: int
) -> tuple[_Step | None, list[str]]:
    """The next step, whose fit has converged; None if nothing is gained. Then what did not converge.

    The minimum is sought once, after superfluous effects are gone.
    """
    had, failed, additions = laplace_evidence(here.fit), list[str](), _additions(inquiry, here, fits, seed=seed)
    for added in additions[:_TRIED]:
        if laplace_evidence(added[1]) + promised(added[1]) < had + EXPLAINS:
            break
        chosen, rough = _without_superfluous(inquiry, *added, seed=seed)
        if frozenset(effect.name for effect in chosen) in seen:
            break
        fit = _finished(rough, inquiry, seed)
        if not fit.certificate.converged:
            failed.append(Hypothesis(inquiry.base, chosen).name)
            continue
        needed = EXPLAINS if len(chosen) > len(here.chosen) else 0.0
        others = [other for other in additions if other is not added]
        return ((chosen, fit, others) if laplace_evidence(fit) >= had + needed else None), failed
    return None, failed


def _additions(inquiry: Inquiry, here: _Here, fits: dict[frozenset[str], ModelFit], *, seed: int) -> list[_Fitted]:
    """The effects with one more and their fits, not finished, that of largest evidence first; none if none can be fitted."""
    chosen, fit, left = here.chosen, here.fit, here.left
    have = frozenset(effect.name for effect in chosen)
    beside = inquiry.beside(chosen)
    if sum(have | {effect.name} in fits for effect in beside) <= _CANDIDATES:  # no attribution was made of these
        ranked = [] if left is None else [block.name for block in left.test.blocks]
        order = sorted(beside, key=lambda e: ranked.index(e.name) if e.name in ranked else len(ranked))
        tried = [Hypothesis(inquiry.base, (*chosen, effect)) for effect in order[:_CANDIDATES]]
        starts = {} if left is None else left.starts
        found = fit_hypotheses(tried, fit, inquiry.batch, inquiry.simulator, seed=seed, starts=starts, options=_FIT)
        fits |= {frozenset(name.split("+")): own for name, own in found.items()}
    known = [((*chosen, effect), fits[have | {effect.name}]) for effect in beside if have | {effect.name} in fits]
    return sorted(known, key=lambda addition: -laplace_evidence(addition[1]))


def _without_superfluous(inquiry: Inquiry, chosen: tuple[Effect, ...], fit: ModelFit, *, seed: int) -> _Fitted:
    """Effects less those without which the evidence is nearly as large, the least needed first; never the last one.

    An effect whose amplitude is many standard deviations from zero is kept without a fit.
    """
    while len(chosen) > 1:
        last, doubtful = chosen[-1], [effect for effect in chosen[:-1] if _distance(fit, effect) < _CLEAR]
        tried = [Hypothesis(inquiry.base, tuple(e for e in chosen if e is not out)) for out in doubtful]
        if not tried:
            break
        starts = {last.name: near_values(fit, last)}
        options = replace(_FIT, rival=fit.cost)
        found = fit_hypotheses(tried, fit, inquiry.batch, inquiry.simulator, seed=seed, starts=starts, options=options)
        best = max(tried, key=lambda h: laplace_evidence(found[h.name]))
        if laplace_evidence(found[best.name]) < laplace_evidence(fit) - EXPLAINS:
            break
        chosen, fit = best.effects, found[best.name]
    return chosen, fit


def _distance(fit: ModelFit, effect: Effect) -> float:
    """Standard deviations of an effect's fitted amplitude from zero, by the slope of its prior's transform at the fit."""
    place = fit.prior.names.index(effect.names[0])
    marginal, at, sd = fit.prior.marginals[place], fit.mean[place], fit.chol[place].norm()
    return float(marginal.to_physical(at).abs() / (sd * marginal.log_slope(at).exp()))


def _finished(fit: ModelFit, inquiry: Inquiry, seed: int) -> ModelFit:
    """A fit taken to its minimum if it is not there."""
    if fit.certificate.converged:
        return fit
    return finish(fit, inquiry.batch, inquiry.simulator, seed=child(seed, "finish"), options=_FINISH)
