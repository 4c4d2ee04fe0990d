"""Forward selection of what is missing, and the verdict that follows from it.

Each round adds the part of largest evidence (an effect, or gels that differ between shots) beside
those held, until an unknown effect is improbable; the verdict is the set of causes of least
expected loss (:mod:`imr_torch.gap.verdict`), "other" where an unknown effect stays more probable
than not, and undecided where a fit that it rests on has not converged.

Beside "other" stands what comes nearest. With the camera's own noise that would be what passes
nearest to a few frames next to a collapse, at any strength; so, where the noise was inferred, it is
selected beside slow noise of each shot's own, of an amount that is as unknown beside each part.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import torch

from imr_torch.assimilate import ModelFit, infer_frame_noise
from imr_torch.assimilate.slow_noise import BesideSlowNoise
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.attribute import Attribution, attribute, reconsider
from imr_torch.gap.fits import finish, fit_null
from imr_torch.gap.hypotheses import EXPLAINS, Hypothesis, Inquiry, in_words, laplace_evidence
from imr_torch.gap.verdict import MEMBER, NONE, OTHER, SLOW_NOISE, Choice, choose
from imr_torch.labels import p_value
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.types import ProgressLine, within

_NO_GAP = 0.5  # probability of the base model alone from which on there is no gap
# probability of an unknown effect from which on the verdict is "other", once further effects were
# tried
_UNKNOWN = 0.5
_AHEAD = 8  # hypotheses whose most probable points beside slow noise are found
_LARGE_GAP = 1e-6  # p-value below which the verdict was "other" in 13 of 13 measured sets
_SELECTIONS = 5  # that such a gap takes: of causes, of what is nearest, of causes with new noise
_NOISE_ROUNDS = 2  # times that the noise is inferred about a fit, and the fit made with it
_CAUSE = "cause"
_NEAREST = "no effect is enough, nearest cause"
_AGAIN = "with new noise, cause"


@dataclass(frozen=True)
class WithinMisfit:
    """Fits with noise of the size of what is left, where no model is enough.

    Args:
        own: the base model's fit with noise of the size of what it leaves itself, and the data
            with that noise.
        batch: the data with noise of the size of what is left beside the selected parts.
        null: the base model's fit with that noise.
        left: the gap test there.
        steps: attributions in the order of the selection, each hypothesis with the fit that
            explains more beside slow noise: that with noise of the size of what is left, or that
            with the camera's.
    """

    own: tuple[ModelFit, ExperimentBatch]
    batch: ExperimentBatch
    null: ModelFit
    left: Adequacy
    steps: tuple[Attribution, ...] = ()


@dataclass(frozen=True)
class Finding:
    """A verdict, with the attribution that it is based on and what was selected.

    Args:
        verdict: ``"none"``, ``"effect"``, ``"class"``, ``"other"`` or ``"undecided"``.
        cause: names of the parts that the verdict names: effects, or ``"gel_scatter"``.
        reason: one sentence on how the verdict came about.
        selected: all parts that were selected together, whether or not they are enough; the base
            model alone where none was.
        selected_fit: its fit.
        attribution: causes, if the test finds a gap: of the last part selected if all are enough
            together, else of the first.
        adequacy_p: of all parts that were selected together; None where none was.
        choice: the causes of least expected loss with their probabilities; None where no effect was
            fitted.
        steps: attributions in the order of the selection, ``attribution`` among them.
        within_misfit: where the verdict is "other" and the noise was inferred, how the parts were
            selected.
    """

    verdict: str
    cause: tuple[str, ...]
    reason: str
    selected: Hypothesis
    selected_fit: ModelFit
    attribution: Attribution | None = None
    adequacy_p: float | None = None
    choice: Choice | None = None
    steps: tuple[Attribution, ...] = ()
    within_misfit: WithinMisfit | None = None


def select_causes(
    inquiry: Inquiry,
    null: ModelFit,
    left: Adequacy,
    *,
    nearest: Finding | None = None,
    seed: int,
) -> Finding:
    """Forward selection of parts until an unknown effect is improbable, and the verdict that
    follows.

    Each round adds the part of largest evidence beside those held. A first part that the second
    does not need is dropped. Where an unknown effect stays more probable than not, the verdict is
    "other", or undecided where the last fit has not nearly converged.

    Args:
        inquiry: base model, effects and data.
        null: the base model's fit.
        left: the gap test there.
        nearest: an earlier verdict "other", whose parts are tried again from their fit: with little
            noise a search may end where collapses lie on the wrong side of frames.
        seed: of every random number.
    """
    finding = _select_until_adequate(inquiry, null, left, nearest=nearest, seed=seed)
    laws = inquiry.batch.noise_laws
    if finding.verdict != OTHER or laws is None or not laws.of_residuals:
        return finding
    if nearest is None:
        nearest = _select_within_misfit(inquiry, finding, null, left, seed=seed)
    return replace(
        finding,
        selected=nearest.selected,
        selected_fit=nearest.selected_fit,
        within_misfit=nearest.within_misfit,
        reason=nearest.reason,
    )


def _select_within_misfit(
    inquiry: Inquiry, finding: Finding, null: ModelFit, gap: Adequacy, *, seed: int
) -> Finding:
    """The verdict "other" with the parts that explain much even if all that is left counts as
    noise: slow noise of each shot's own, or else larger noise in all frames alike.
    """
    held = Hypothesis(inquiry.base)
    fit, widened = fit_with_noise(inquiry, held, null, of_misfit=True, seed=child(seed, "misfit"))
    without = fit, widened.batch
    left = widened.test(fit, held, seed=seed)
    steps: list[Attribution] = []
    while len(held.parts) < inquiry.most and inquiry.longer(held):
        own = child(seed, "misfit", len(held.parts))
        number = len(finding.steps) + len(steps)
        counted = _count_selection(widened, held, _NEAREST, number, gap)
        found = attribute(counted, fit, held, before=left, seed=own)
        beside = [step for step in finding.steps if step.held.name == held.name]
        step, explained = weigh_beside_slow([found, *beside], inquiry.batch, inquiry.simulator)
        steps.append(step)
        name, nats = max(explained.items(), key=itemgetter(1), default=("", 0.0))
        if nats < EXPLAINS:
            name = found.winner.name
            if found.explained[name] < EXPLAINS:
                break
        held = step.hypotheses[name]
        fit, widened = fit_with_noise(inquiry, held, step.fits[name], of_misfit=True, seed=own)
        left = widened.test(fit, held, seed=own)
    base, _ = without
    if held.parts:
        near = steps[0].fits[NONE]
        base = fit_null(replace(widened, progress=None), seed=seed, near=near)
        left = widened.test(base, Hypothesis(inquiry.base), seed=seed)
    nearest = " and ".join(map(in_words, held.parts))
    explained = f"some of it goes with {nearest}" if nearest else "none explains any of it"
    return replace(
        finding,
        selected=held,
        selected_fit=fit,
        within_misfit=WithinMisfit(without, widened.batch, base, left, tuple(steps)),
        reason="No effect of the library is enough; where all that is left counts as noise, "
        f"{explained}.",
    )


def weigh_beside_slow(
    steps: Sequence[Attribution], batch: ExperimentBatch, simulator: Simulator
) -> tuple[Attribution, dict[str, float]]:
    """Attributions beside one held hypothesis as one, with the fits that explain more beside slow
    noise of each shot's own, and the nats that the last part of each hypothesis explains there.

    Fits from several noise laws are tried, since each is where another noise led; of the hypotheses
    that are ahead to first order about them, the most probable points beside slow noise count.
    That gels differ between shots is left out: it is of each shot's own, as the deviations are.

    Args:
        steps: the attributions; hypotheses are those of the first.
        batch: the data, with the noise of single frames.
        simulator: makes the bubbles.
    """
    held = steps[0].held.name
    tried = dict[str, list[tuple[float, ModelFit]]]()
    for step in steps:
        for name, fit in step.fits.items():
            hypothesis = step.hypotheses[name]
            if hypothesis.gels_differ is step.held.gels_differ:
                value = evidence_beside_slow(fit, hypothesis.seen(batch), simulator, steps=0)
                tried.setdefault(name, []).append((value, fit))
    ranked = sorted(tried, key=lambda name: max(value for value, _ in tried[name]), reverse=True)
    fits = dict[str, ModelFit]()
    evidence = dict[str, float]()
    for name in dict.fromkeys((held, *ranked[:_AHEAD])):
        seen = steps[0].hypotheses[name].seen(batch)
        again = [(evidence_beside_slow(fit, seen, simulator), fit) for _, fit in tried[name]]
        evidence[name], fits[name] = max(again, key=itemgetter(0))
    explained = {n: value - evidence[held] for n, value in evidence.items() if n != held}
    return replace(steps[0], fits=steps[0].fits | fits), explained


def evidence_beside_slow(
    fit: ModelFit, batch: ExperimentBatch, simulator: Simulator, *, steps: int = 6
) -> float:
    """Log evidence of a hypothesis beside slow noise of each shot's own, after so many steps from a
    fit to the most probable point there; -inf where the fit has no prediction.
    """
    near = fit.linearise(batch, simulator)
    if not bool(torch.isfinite(near.centre[batch.mask]).all()):
        return -math.inf
    return BesideSlowNoise.at_mode(near, steps=steps).log_evidence


def fit_with_noise(
    inquiry: Inquiry,
    held: Hypothesis,
    fit: ModelFit,
    *,
    of_misfit: bool = False,
    seed: int,
) -> tuple[ModelFit, Inquiry]:
    """The fit of a hypothesis under the noise that is inferred about it, and the inquiry with that
    noise: of single frames, or of all that the fit leaves.
    """
    for number in range(_NOISE_ROUNDS):
        seen = held.seen(inquiry.batch)
        noise = infer_frame_noise(fit.linearise(seen, inquiry.simulator))
        if of_misfit:  # enlarged only at last: a fit by wide noise leaves more
            noise = noise.for_fits(widen=number + 1 == _NOISE_ROUNDS)
        inquiry = replace(inquiry, batch=noise.applied(inquiry.batch))
        if inquiry.progress:
            inquiry.progress(ProgressLine(f"noise {inquiry.batch.noise}", step="noise"))
        if held.parts:
            fit = finish(inquiry, fit, held, seed=child(seed, number))
        else:
            fit = fit_null(inquiry, seed=child(seed, number), near=fit)
    return fit, inquiry


def _select_until_adequate(
    inquiry: Inquiry,
    null: ModelFit,
    left: Adequacy,
    *,
    nearest: Finding | None,
    seed: int,
) -> Finding:
    held = Hypothesis(inquiry.base)
    fit = null
    before = left
    masked = 1.0
    steps: tuple[Attribution, ...] = ()
    while len(held.parts) < inquiry.most and inquiry.longer(held):
        own = child(seed, "attribute", len(held.parts))
        what = _CAUSE if nearest is None else _AGAIN
        number = len(steps) + (0 if nearest is None else _count_steps(nearest))
        counted = _count_selection(inquiry, held, what, number, left)
        found = attribute(counted, fit, held, before=before, seed=own, masked=masked)
        if nearest is not None and not held.parts:
            for part in nearest.selected.parts:
                own = child(seed, part)
                found = reconsider(
                    inquiry, found, part, nearest.selected_fit, before=left, seed=own
                )
        if held.parts and found.explained[found.winner.name] < EXPLAINS:
            break
        choice = choose(found.posterior)
        steps = (*steps, found)
        if not held.parts and found.posterior[NONE] >= _NO_GAP:
            # by chance at the level of the test, and then no effect explains much
            reason = (
                f"A test rejects the base model ({p_value(left.test.p_value)}), but no effect of the "
                "library explains enough: the base model alone keeps a probability of "
                f"{found.posterior[NONE]:.2f}."
            )
            return Finding(NONE, (), reason, held, null, found, None, choice, steps)
        if _is_slow_noise(found):
            p = found.adequacy.p_value
            return Finding(OTHER, (), "", held, fit, steps[0], p, choice, steps)
        held = found.winner
        fit = found.winner_fit
        named = _with_one_part(inquiry, left, steps, seed)
        if named is None and found.posterior[OTHER] <= _UNKNOWN:
            named = name_causes(found, choice)
        if named is not None:
            return replace(named, steps=steps)
        before = found.left
        masked = masked * (1.0 - found.likeness.chance)
    return replace(_conclude_other(null, left, held, fit, steps), steps=steps)


def _count_steps(found: Finding) -> int:
    """Selections that led to a finding."""
    return len(found.steps) + (len(found.within_misfit.steps) if found.within_misfit else 0)


def _count_selection(
    inquiry: Inquiry, held: Hypothesis, what: str, number: int, left: Adequacy
) -> Inquiry:
    """An inquiry that reports one selection, after a number of others and with more of them
    expected.

    Args:
        inquiry: base model, effects and data.
        held: what was selected.
        what: a selection is of.
        number: of selections before.
        left: the gap test at the base model's fit.
    """
    laws = inquiry.batch.noise_laws
    large = laws is not None and laws.of_residuals and left.test.p_value < _LARGE_GAP
    expected = max(number + 1, _SELECTIONS if large else 1)
    name = f"{what} {len(held.parts) + 1} of at most {inquiry.most}"
    parts = (number / expected, (number + 1) / expected)
    report = within(inquiry.progress, *parts, name=name, size=expected)
    return replace(inquiry, progress=report)


def _with_one_part(
    inquiry: Inquiry, left: Adequacy, steps: Sequence[Attribution], seed: int
) -> Finding | None:
    """The verdict on one of the selected parts alone, where that explains the data without the
    others.

    The last one may not need those before it. The first may have ended in a local minimum (its
    collapses on the wrong side of frames), which the parts after it led out of.
    """
    last = steps[-1]
    if len(last.winner.parts) < 2:
        return None
    alone = steps[0]
    for part in reversed(last.winner.parts):
        own = child(seed, "reconsider", part)
        alone = reconsider(inquiry, alone, part, last.winner_fit, before=left, seed=own)
    choice = choose(alone.posterior)
    if alone is steps[0] or choice.leader == NONE or alone.posterior[OTHER] > _UNKNOWN:
        return None
    return name_causes(alone, choice)


def _conclude_other(
    null: ModelFit,
    left: Adequacy,
    held: Hypothesis,
    fit: ModelFit,
    steps: Sequence[Attribution],
) -> Finding:
    """The verdict where an unknown effect stays more probable than not."""
    test = steps[-1].adequacy
    nearest = " and ".join(map(in_words, held.parts))
    explained = laplace_evidence(fit) - laplace_evidence(null)
    finding = Finding(OTHER, (), "", held, fit, steps[0], test.p_value, choose(steps[-1].posterior))
    # a nearly converged fit would not become adequate by converging further
    if not fit.certificate.nearly_converged:
        reason = (
            f"No effect of the library was found to be enough, but the fit with {nearest} did not "
            f"converge ({explained:.0f} nats better than the base; adequacy "
            f"{p_value(test.p_value)}), which may be why."
        )
        return replace(finding, verdict="undecided", reason=reason)
    if explained < EXPLAINS:
        reason = f"No effect of the library explains any of it (adequacy {p_value(test.p_value)})."
        return replace(finding, reason=reason, selected=steps[0].held, selected_fit=null)
    misfit = f"the misfit in R* goes from {left.test.bias_radius:.4f} to {test.bias_radius:.4f}"
    reason = (
        f"No effect of the library is enough; nearest comes {nearest} "
        f"({explained:.0f} nats; {misfit}; adequacy {p_value(test.p_value)})."
    )
    return replace(finding, reason=reason)


def _is_slow_noise(found: Attribution) -> bool:
    """Whether slow noise, or an unknown effect that looks like it, is more probable than all else,
    and no known effect is.
    """
    slow = found.posterior.get(SLOW_NOISE)
    if slow is None or slow <= MEMBER or slow + found.posterior[OTHER] <= _UNKNOWN:
        return False
    return slow >= max(p for name, p in found.posterior.items() if name not in (OTHER, SLOW_NOISE))


def name_causes(found: Attribution, choice: Choice) -> Finding:
    """The verdict on a known cause: the parts of the set of least expected loss, beside those that
    every hypothesis holds.
    """
    causes = (*found.held.parts, *map(found.part, choice.causes))
    p = found.adequacy.p_value
    verdict = "undecided"
    reason = _reason_for_doubt(found, choice)
    if not reason and len(choice.causes) == 1:
        verdict = "effect"
        reason = f"Adequate ({p_value(p)}), and the others are improbable."
    elif not reason:
        verdict = "class"
        reason = "These effects explain the data about equally well."
    return Finding(verdict, causes, reason, found.winner, found.winner_fit, found, p, choice)


def _reason_for_doubt(found: Attribution, choice: Choice) -> str:
    """Why no cause can be named; empty where one can."""
    if not found.winner_fit.certificate.usable:
        return "No fit with an effect converged."
    if found.left_out:
        ahead = ", ".join(in_words(found.part(name)) for name in found.left_out)
        return f"The fit with {ahead} did not converge and was left out; it may explain more."
    if NONE in choice.members:
        held = " and ".join(map(in_words, found.held.parts)) or "The base model"
        return (
            f"{held} alone keeps a probability of {choice.members[NONE]:.2f}: too much to name a "
            "cause."
        )
    if SLOW_NOISE in choice.members:
        slow = choice.members[SLOW_NOISE]
        return f"Slow noise of the camera looks alike (probability {slow:.2f}): repeat a shot."
    if not choice.decided:
        return "The probability is spread over too many effects to name a cause."
    return ""
