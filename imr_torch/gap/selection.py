"""Forward selection of what is missing, and the verdict that follows from it.

Each round adds the part of largest evidence (an effect, or gels that differ between shots) beside
those held, until an unknown effect is improbable; the verdict is the set of causes of least
expected loss (:mod:`imr_torch.gap.verdict`), "other" where an unknown effect stays more probable
than not, and undecided where a fit that it rests on has not converged.

Beside "other" stands what comes nearest (:mod:`imr_torch.gap.within_misfit`); with the noise that is
inferred beside that, hypotheses that are ahead are fitted again from their fits, and what comes
nearest is selected anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from imr_torch.assimilate import ModelFit
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.attribute import Attribution, Candidates, attribute, reconsider
from imr_torch.gap.fits import finish
from imr_torch.gap.hypotheses import (
    EXPLAINS,
    Hypothesis,
    Inquiry,
    in_words,
    laplace_evidence,
)
from imr_torch.gap.verdict import MEMBER, NONE, OTHER, SLOW_NOISE, Choice, choose
from imr_torch.gap.within_misfit import (
    AGAIN,
    WIDE,
    MisfitSelection,
    WithinMisfit,
    choose_ahead,
    expect_selections,
    report_selection,
)
from imr_torch.labels import p_value
from imr_torch.random import child

_NO_GAP = 0.5  # probability of the base model alone from which on there is no gap
# probability of an unknown effect from which on the verdict is "other", once further effects were
# tried
_UNKNOWN = 0.5


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
    path: Sequence[Candidates] = (),
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
        path: how what comes nearest was selected with other noise: its parts are held again.
        seed: of every random number.
    """
    finding = _select_until_adequate(inquiry, null, left, path=path, seed=seed)
    laws = inquiry.batch.noise_laws
    if finding.verdict != OTHER or laws is None or not laws.of_residuals:
        return finding
    before = _count_before(path, len(finding.steps))
    nearer = MisfitSelection.begin(inquiry, null, before=before, seed=seed)
    while not nearer.ended:
        held = nearer.held.name
        nearer.extend([step for step in finding.steps if step.held.name == held])
    parts = " and ".join(map(in_words, nearer.held.parts))
    explained = f"some of it goes with {parts}" if parts else "none explains any of it"
    return replace(
        finding,
        selected=nearer.held,
        selected_fit=nearer.fit,
        within_misfit=nearer.conclude(),
        reason="No effect of the library is enough; where all that is left counts as noise, "
        f"{explained}.",
    )


def _count_before(path: Sequence[Candidates], number: int) -> float:
    """Time before a step, over that of a selection with the camera's noise."""
    return (1.0 + WIDE) * len(path) + AGAIN * number if path else float(number)


def _select_until_adequate(
    inquiry: Inquiry,
    null: ModelFit,
    left: Adequacy,
    *,
    path: Sequence[Candidates],
    seed: int,
) -> Finding:
    """The selection with the noise of single frames.

    Args:
        inquiry: base model, effects and data.
        null: the base model's fit.
        left: the gap test there.
        path: an earlier selection with other noise: what it held is held, and the hypotheses that
            were ahead are fitted from there. Without one all are, and what is best is held.
        seed: of every random number.
    """
    held = Hypothesis(inquiry.base)
    fit = null
    before = left
    masked = 1.0
    steps: tuple[Attribution, ...] = ()
    while len(held.parts) < inquiry.most and inquiry.longer(held):
        number = len(steps)
        own = child(seed, "attribute", len(held.parts))
        near = choose_ahead(path[number], inquiry) if path else None
        times = (_count_before(path, number), _count_before(path, number + 1))
        what = "with new noise, cause" if path else "cause"
        expected = expect_selections(inquiry, left)
        counted = report_selection(inquiry, held, what, times, expected=expected)
        found = attribute(
            counted, fit, held, before=before, near=near, seed=own, masked=masked
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
        # the path led to each part alone, where it is seen
        named = None if path else _with_one_part(inquiry, left, steps, seed)
        if named is None and found.posterior[OTHER] <= _UNKNOWN:
            named = name_causes(found, choice)
        if named is not None:
            return replace(named, steps=steps)
        held = found.winner
        fit = found.winner_fit
        before = found.left
        masked = masked * (1.0 - found.likeness.chance)
        if path:
            if len(steps) == len(path):
                break
            next_held = path[len(steps)].held
            if next_held.name != held.name:
                held = next_held
                fit = found.fits[held.name]
                if not fit.certificate.usable:
                    fit = finish(inquiry, fit, held, seed=own)
                before = inquiry.test(fit, held, seed=own)
    return replace(_conclude_other(null, left, steps), steps=steps)


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
    null: ModelFit, left: Adequacy, steps: Sequence[Attribution]
) -> Finding:
    """The verdict where an unknown effect stays more probable than not."""
    held = steps[-1].winner
    fit = steps[-1].winner_fit
    test = steps[-1].adequacy
    nearest = " and ".join(map(in_words, held.parts))
    explained = laplace_evidence(fit) - laplace_evidence(null)
    finding = Finding(
        OTHER, (), "", held, fit, steps[0], test.p_value, choose(steps[-1].posterior)
    )
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
    misfit = (
        f"the misfit in R* goes from {left.test.bias_radius:.4f} to {test.bias_radius:.4f}"
    )
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
    return slow >= max(
        p for name, p in found.posterior.items() if name not in (OTHER, SLOW_NOISE)
    )


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
        reason = f"With it the model explains the curves ({p_value(p)}); other causes are improbable."
    elif not reason:
        verdict = "class"
        reason = "These effects explain the data about equally well."
    return Finding(
        verdict, causes, reason, found.winner, found.winner_fit, found, p, choice
    )


def _reason_for_doubt(found: Attribution, choice: Choice) -> str:
    """Why no cause can be named; empty where one can."""
    if not found.winner_fit.certificate.usable:
        return "No fit with an effect converged."
    if found.left_out:
        ahead = ", ".join(in_words(found.part(name)) for name in found.left_out)
        return (
            f"The fit with {ahead} did not converge and was left out; it may explain more."
        )
    if NONE in choice.members:
        held = " and ".join(map(in_words, found.held.parts)) or "The base model"
        return (
            f"{held} alone keeps a probability of {choice.members[NONE]:.2f}: too much to name a "
            "cause."
        )
    if SLOW_NOISE in choice.members:
        slow = choice.members[SLOW_NOISE]
        return (
            f"Slow noise of the camera looks alike (probability {slow:.2f}): repeat a shot."
        )
    if not choice.decided:
        return "The probability is spread over too many effects to name a cause."
    return ""
