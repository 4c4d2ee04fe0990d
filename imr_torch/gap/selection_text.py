"""A stepwise selection in words: what each step leaves and closes, how curves differ, and what to
take with care.

A text has a sentence a step, a page a row of a table.
"""

from collections.abc import Sequence

from imr_torch.gap.hypotheses import in_words
from imr_torch.gap.stepwise import SelectionStep, StepwiseSelection
from imr_torch.gap.strengths import unusual_strengths, values_of_curves
from imr_torch.labels import p_value
from imr_torch.material import PARAMETERS, ModelBelief

HEADING = "How much do known effects close together?"
"""The question that a stepwise selection answers."""

STEPS_HEAD = (
    "additions",
    "misfit in R*",
    "noise in R*",
    "closed on unseen curves",
    "nats better on them",
    "adequacy",
)
"""Columns of :func:`steps_table`."""


def selection_sentences(selection: StepwiseSelection) -> tuple[str, ...]:
    """The selection, each step, what would do as well, what curves have of their own in the best
    step, what is left open.
    """
    base = selection.steps[0].fit.prior
    curves = _of_curves(selection.best, base)
    return (
        str(selection),
        *map(_judged, selection.judged),
        *alternatives(selection),
        *curves,
        *cautions(selection),
    )


def steps_table(selection: StepwiseSelection) -> tuple[tuple[str, ...], ...]:
    """A row a step, the base model first: see :data:`STEPS_HEAD`."""
    rows = []
    for step in selection.judged:
        closed = "" if step.closed is None else "{1:.2f} ({0:.2f} to {2:.2f})".format(*step.closed)
        better = (
            "" if step.log_score is None else f"{step.log_score[0]:+.0f} +- {step.log_score[1]:.0f}"
        )
        named = " + ".join(map(in_words, step.effects)) or "none: the base model alone"
        adequacy = (
            f"{p_value(step.test.p_value)}{'' if step.converged else '; a fit has not converged'}"
        )
        rows.append((named, f"{step.misfit:.4f}", f"{step.noise:.4f}", closed, better, adequacy))
    return tuple(rows)


def curves_table(
    selection: StepwiseSelection, labels: Sequence[str]
) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """The parameters of each curve in the best step: the head, and a row a curve; no rows where
    curves do not differ.
    """
    values = values_of_curves(selection.best.fit, selection.steps[0].fit.prior)
    head = ("curve", *(PARAMETERS[name].label for name in values))
    rows = (
        zip(labels, *(_shown(name, own) for name, own in values.items()), strict=True)
        if values
        else ()
    )
    return head, tuple(rows)


def alternatives(selection: StepwiseSelection) -> tuple[str, ...]:
    """Additions that would do as well, a sentence a step."""
    return tuple(
        f"Not clearly worse in place of {in_words(step.added)}: "
        f"{', '.join(map(in_words, step.alternatives))}."
        for step in selection.judged
        if step.alternatives
    )


def cautions(selection: StepwiseSelection) -> tuple[str, ...]:
    """Effects of unusual strength in the best step, and what was left open."""
    lines = _unusual(selection.best, selection.steps[0].fit.prior)
    unsettled = (" and ".join(map(in_words, name.split("+"))) for name in selection.unsettled)
    return (*lines, *(f"{name} was no step, since its fit did not converge." for name in unsettled))


def _judged(step: SelectionStep) -> str:
    line = f"{_named(step)}: misfit {step.misfit:.4f} in R* beside noise of {step.noise:.4f}"
    if step.closed is not None:
        low, middle, high = step.closed
        line += f", closes {middle:.2f} ({low:.2f} to {high:.2f}) of the held-out gap"
    if step.log_score is not None:
        line += (
            f", predicts held-out curves {step.log_score[0]:+.1f} +- {step.log_score[1]:.1f} nats "
            "better"
        )
    return (
        f"{line}; adequacy "
        f"{p_value(step.test.p_value)}{'' if step.converged else '; a fit has not converged'}."
    )


def _named(step: SelectionStep) -> str:
    return " and ".join(map(in_words, step.effects)) or "the base model alone"


def _of_curves(step: SelectionStep, base: ModelBelief) -> list[str]:
    """The parameters of each curve where curves differ."""
    values = values_of_curves(step.fit, base)
    said = (
        f"{PARAMETERS[name].label} {', '.join(_shown(name, own))}" for name, own in values.items()
    )
    return [f"Curve by curve, with {_named(step)}: {'; '.join(said)}."] if values else []


def _shown(name: str, values: Sequence[float]) -> list[str]:
    """Values of a parameter as they are shown."""
    return [f"{PARAMETERS[name].display_scale * value:.3g}" for value in values]


def _unusual(step: SelectionStep, base: ModelBelief) -> list[str]:
    """A caution for each effect whose strength its prior does not expect."""
    return [
        f"{name} is {sds:.0f} standard deviations of its prior from what is usual: these curves "
        "ask for what it does to them, "
        "and perhaps for another reason, which the library does not hold."
        for name, sds in unusual_strengths(step.fit, base).items()
    ]
