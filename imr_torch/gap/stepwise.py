"""How much of a gap known effects close together: effects added one after the other, whether or not
they are enough.

The verdict names a cause only if nothing is left unexplained. Measured curves nearly always leave
something, and a laboratory still asks which effects close how much of it, and what remains. Each
step adds the effect of largest evidence beside those chosen, and drops those that it makes
superfluous. In the first two steps the fits of the attribution serve; later ones fit the effects
that came next in the step before, and those that a score test there ranks first. That curves differ
(``gel_scatter``) is an addition like the others: no effect of one gel explains two. From then on
every curve has a gel of its own, and each effect a strength of its own in it. These differences are
nuisances of a held-out curve too, so what such a step closes there holds what that curve itself
says of them, as it does of its Rmax and time zero. A fit that does not converge is no step: the
next best addition is tried. A step is a description of the data, not a cause, and other curves of
the same gel may prefer another one: each step names the additions that are not clearly worse in
place of its last one.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch

from imr_torch.assimilate import ModelFit
from imr_torch.gap.additions import (
    Fitted,
    Here,
    added_by,
    finished,
    fit_gels,
    longer_by_one,
    next_step,
)
from imr_torch.gap.adequacy import Adequacy, adequacy_test
from imr_torch.gap.attribute import Inquiry
from imr_torch.gap.hypotheses import EXPLAINS, GEL_SCATTER, Hypothesis, in_words, laplace_evidence
from imr_torch.gap.prediction import HeldOut
from imr_torch.gap.shrinkage import compare, reductions
from imr_torch.goodness.phases import PHASES, noise_shares, phase_numbers
from imr_torch.goodness.score import ADEQUATE, GapTest
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.types import Progress

Ended = Literal["adequate", "explains no more", "unsettled", "most"]
"""Why a selection has no further step."""

_ENDS: dict[Ended, str] = {
    "adequate": "the last step, which leaves only noise on the fitted curves, is not the one that does "
    "best on others",
    "explains no more": "no further effect of the library was found to explain it",
    "unsettled": "a further effect that may explain it could "
    "not be judged, since its fit did not converge",
    "most": "more additions were not tried",
}
_SURE = 1.645  # standard errors by which one of two models is better in 95 %


@dataclass(frozen=True)
class Left:
    """What a fit leaves in one phase of the bubble's life, root mean square over all mean curves,
    in R*.

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
        effects: those that are freed, ``gel_scatter`` last where gels differ; none on the first
            step.
        fit: with its certificate.
        gained: log evidence over the step before, nats.
        test: the gap test at this fit.
        left: by phase, where frames exist.
        closed: lower, median and upper share of the held-out squared bias that is gone, 90 %
            interval; None where no design could be held out.
        log_score: held-out log predictive density over the base model, nats, and its standard
            error; None likewise.
        trained: whether the fits of the held-out designs have converged.
        added: what the step before did not have; none on the first step.
        alternatives: additions that are not clearly worse in place of that one, best first: each
            gains enough, and its log evidence is behind by no more than ``EXPLAINS`` and what the
            misfit that is left may make by chance (95 %).

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
    added: str = ""
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
        """Root mean square residual beyond noise over all frames, R*, none where a phase has less
        than its noise.
        """
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
        differing: the base model where curves differ, if that could be asked, its fit converged,
            and no step is that: shots of one gel are known to differ, and unseen curves may be
            predicted better so even where the evidence is for less.
        unsettled: effects, joined by ``+``, that would have been a step had their fit converged.
        ended: why there is no further step: nothing is left to explain, no effect explains more,
            the fit of one that may did not converge, or there are as many as were asked for.

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
    differing: SelectionStep | None = None
    unsettled: tuple[str, ...] = ()
    ended: Ended = "explains no more"

    @property
    def judged(self) -> tuple[SelectionStep, ...]:
        """The steps, and ``differing``."""
        return (*self.steps, *([self.differing] if self.differing else []))

    @property
    def best(self) -> SelectionStep:
        """Of those judged, the one that closes some of the gap on held-out designs and predicts
        them best.

        The last step where none was held out.
        """
        if all(step.log_score is None for step in self.judged):
            return self.steps[-1]
        scores = [
            step.log_score[0] if step.log_score and step.closed and step.closed[1] > 0.0 else 0.0
            for step in self.judged
        ]
        return self.judged[scores.index(max(scores))]

    def __str__(self) -> str:
        """One sentence on how much the best step closes, and what is left where."""
        last = self.best
        if not last.effects:
            return "No effect of the library closes any of the gap."
        verb = "closes" if len(last.effects) == 1 and GEL_SCATTER not in last.effects else "close"
        if last.closed is None:
            share = f"lower the misfit in R* from {self.steps[0].misfit:.4f} to {last.misfit:.4f}"
            share = share if verb == "close" else f"lowers{share[5:]}"
        else:
            low, middle, high = last.closed
            share = (
                f"{verb} {middle:.2f} ({low:.2f} to {high:.2f}) of the gap on designs that the "
                "fits did not see"
            )
        *others, end = map(in_words, last.effects)
        named = f"{', '.join(others)} and {end}" if others else end
        if last.adequate:
            return f"{named} {share}; what is left is noise."
        part = last.worst
        return (
            f"{named} {share}; what is left lies most in the phase {part.phase!r}, "
            f"{part.misfit:.4f} in R* beside noise of "
            f"{part.noise:.4f}, and {_ENDS[self.ended]}."
        )


def select_stepwise(
    inquiry: Inquiry,
    null: ModelFit,
    test: GapTest,
    known: Mapping[str, ModelFit],
    *,
    tested: Mapping[str, Adequacy] | None = None,
    alone: Sequence[ModelFit] | None = None,
    most: int = 4,
    seed: int,
    progress: Progress | None = None,
) -> StepwiseSelection:
    """Add effects one after the other until the fit is adequate, nothing more is gained, or there
    are ``most``.

    Args:
        inquiry: base model, effects and data.
        null: the base model's fit.
        test: the gap test there.
        known: hypothesis -> fit, those of an attribution; what is missing is fitted.
        tested: hypothesis -> the gap test at its fit in ``known``; what is missing is tested.
        alone: the base model's fit of each experiment by itself; made here if they are asked for
            and not given.
        most: additions at most.
        seed: of fits and tests.
        progress: called with one line per step.
    """
    batch = inquiry.batch
    fits = {frozenset(name.split("+")) - {"none"}: fit for name, fit in known.items()}
    steps = [SelectionStep((), null, 0.0, test, left_over(null, batch))]
    here = Here(Hypothesis(inquiry.base), null)
    seen = {frozenset[str]()}
    unsettled = list[str]()
    while (ended := _ended(inquiry, here, steps[-1], most)) is None:
        own = child(seed, "rung", len(steps))
        before = here
        if len(steps) == 1:
            fits |= fit_gels(inquiry, null, alone, seed=own)
        found, failed = next_step(inquiry, here, fits, seen, seed=own)
        unsettled += failed
        if found is None:
            ended = "unsettled" if failed else "explains no more"
            break
        chosen, fit, others = found
        seen.add(frozenset(chosen.parts))
        left = (tested or {}).get(chosen.name) if fit is known.get(chosen.name) else None
        had = laplace_evidence(before.fit)
        beaten = tuple(other for other in others if laplace_evidence(other[1]) > had + EXPLAINS)
        here = Here(chosen, fit, left or _left(inquiry, chosen, fit, own), beaten)
        named = (added_by(before.chosen, h) for h in _not_clearly_worse(others, fit, had, batch))
        steps.append(replace(_step(before, here, batch), alternatives=tuple(named)))
        if progress:
            progress(f"stepwise selection: {steps[-1].name}, misfit {steps[-1].misfit:.4f}")
    rough = None if frozenset({GEL_SCATTER}) in seen else fits.get(frozenset({GEL_SCATTER}))
    differing = None if rough is None else _differing(inquiry, null, rough, seed)
    return StepwiseSelection(tuple(steps), differing, tuple(unsettled), ended)


def _ended(inquiry: Inquiry, here: Here, last: SelectionStep, most: int) -> Ended | None:
    """Why no further step is tried; None if one is."""
    if last.adequate:
        return "adequate"
    if len(here.chosen.parts) >= most:
        return "most"
    return None if longer_by_one(inquiry, here.chosen) else "explains no more"


def _differing(
    inquiry: Inquiry, null: ModelFit, rough: ModelFit, seed: int
) -> SelectionStep | None:
    """The base model where curves differ, like a first step; None if its fit does not converge."""
    base = Hypothesis(inquiry.base)
    chosen = replace(base, own_gels=True)
    fit = finished(rough, chosen, inquiry, seed)
    if not fit.certificate.converged:
        return None
    return _step(
        Here(base, null), Here(chosen, fit, _left(inquiry, chosen, fit, seed)), inquiry.batch
    )


def _left(inquiry: Inquiry, chosen: Hypothesis, fit: ModelFit, seed: int) -> Adequacy:
    """The gap test at a fit."""
    batch = chosen.seen(inquiry.batch)
    own = child(seed, "adequacy")
    return adequacy_test(fit, inquiry.effects, batch, inquiry.simulator, seed=own)


def _step(before: Here, here: Here, batch: ExperimentBatch) -> SelectionStep:
    """A step, judged in sample."""
    assert here.left is not None
    gained = laplace_evidence(here.fit) - laplace_evidence(before.fit)
    left = left_over(here.fit, batch)
    added = added_by(before.chosen, here.chosen)
    return SelectionStep(here.chosen.parts, here.fit, gained, here.left.test, left, added=added)


def with_held_out(
    selection: StepwiseSelection, held: Mapping[str, Sequence[HeldOut]], *, seed: int
) -> StepwiseSelection:
    """A stepwise selection with the share of the gap that each step closes on designs that its fits
    did not see.

    Args:
        selection: judged in sample only.
        held: name of each step -> held-out predictions (:func:`imr_torch.gap.prediction.hold_out`);
            a step that it does not name is not judged.
        seed: of the bootstrap.
    """
    own = {step.name: held[step.name] for step in selection.judged if step.name in held}
    _, closed = reductions(own, seed)

    def judged(step: SelectionStep) -> SelectionStep:
        if step.name not in own:
            return step
        score = compare(own, step.name, "none")
        trained = all(design.converged for name in ("none", step.name) for design in own[name])
        said = (score.difference, score.standard_error)
        return replace(step, closed=closed[step.name], log_score=said, trained=trained)

    steps = (selection.steps[0], *map(judged, selection.steps[1:]))
    return replace(
        selection,
        steps=steps,
        differing=judged(selection.differing) if selection.differing else None,
    )


def left_over(fit: ModelFit, batch: ExperimentBatch) -> tuple[Left, ...]:
    """The residual of a fit beyond its noise, by phase of the bubble's life."""
    sd = batch.sd(fit.prediction)
    residual = torch.where(batch.mask, batch.mean - fit.prediction, 0.0)
    phases = torch.where(batch.mask, phase_numbers(batch.times, fit.prediction, batch.mask), -1)
    shares = noise_shares([batch.whiten(residual, sd).square()], phases)
    square = residual.square()
    noise = shares * sd.square() / batch.counts.clamp_min(1.0)
    sums: list[tuple[str, float, float, int]] = []
    for number, phase in enumerate(PHASES):
        inside = phases == number
        if count := int(inside.sum()):
            excess = float((square - noise)[inside].sum().clamp_min(0.0))
            sums.append((phase, excess, float(noise[inside].mean().sqrt()), count))
    total = max(sum(excess for _, excess, _, _ in sums), 1e-300)
    return tuple(
        Left(phase, math.sqrt(excess / count), sd, excess / total, count)
        for phase, excess, sd, count in sums
    )


def _not_clearly_worse(
    others: Sequence[Fitted], fit: ModelFit, had: float, batch: ExperimentBatch
) -> list[Hypothesis]:
    """Hypotheses that gain enough beside evidence ``had`` and are not clearly behind a fit, in the
    order given.
    """
    best = laplace_evidence(fit)
    found = list[Hypothesis]()
    for hypothesis, other in others:
        evidence = laplace_evidence(other)
        if evidence >= max(
            had + EXPLAINS, best - EXPLAINS - _SURE * misfit_in_difference(fit, other, batch)
        ):
            found.append(hypothesis)
    return found


def misfit_in_difference(fit: ModelFit, other: ModelFit, batch: ExperimentBatch) -> float:
    """Standard error, nats, of the log likelihood of a fit over another's that is due to what the
    fit leaves beyond noise.

    With residuals ``r`` of the fit and the difference ``d`` of the predictions, both whitened, the
    likelihoods differ by ``d.d/2 - d.r``. The variance of ``d.r`` is that of its terms and their
    neighbours (Newey and West, Econometrica 55, 1987), less the ``d.d`` of noise; so models are
    compared that may both be wrong (Vuong, Econometrica 57, 1989).
    """
    sd = batch.sd(fit.prediction)
    apart, left = (
        torch.where(batch.mask, x - fit.prediction, 0.0) for x in (other.prediction, batch.mean)
    )
    apart, left = (batch.whiten(x, sd) for x in (apart, left))
    terms = apart * left
    lags = int(4.0 * (apart.shape[-1] / 100.0) ** (2.0 / 9.0))
    variance = float(terms.square().sum() - apart.square().sum())
    for lag in range(1, lags + 1):
        variance += 2.0 * (1.0 - lag / (lags + 1)) * float((terms[:, lag:] * terms[:, :-lag]).sum())
    return math.sqrt(max(variance, 0.0))


def _over_frames(values: Sequence[float], parts: Sequence[Left]) -> float:
    """Root mean square over the frames of all phases."""
    frames = sum(part.frames for part in parts)
    return math.sqrt(
        sum(value**2 * part.frames for value, part in zip(values, parts, strict=True)) / frames
    )
