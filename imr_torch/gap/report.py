"""A diagnosis as text: the gap, its location, its cause, its reduction, and what was not tested.

The report is a list of sections, each a heading with sentences; the printed text and the HTML page
show the same list. What was not tested or cannot be concluded is a section of its own, with the
reasons.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from scipy.optimize import brentq
from scipy.special import chdtri, chndtr

from imr_torch.design import Plan
from imr_torch.gap.attribute import Attribution
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.hypotheses import GEL_SCATTER
from imr_torch.gap.parts import Parts
from imr_torch.gap.selection_text import HEADING, selection_sentences
from imr_torch.gap.values import cause_values, fit_of_cause, parameter_shift
from imr_torch.gap.verdict import OTHER, SLOW_NOISE, VERDICT_ODDS
from imr_torch.goodness.score import ADEQUATE, LEVEL, BlockResult
from imr_torch.labels import p_value
from imr_torch.material import LIBRARY, PARAMETERS
from imr_torch.observe import noise_sentences

_CAUSES = 5
_BLOCKS = 3
_BLIND = 0.5  # power below which an effect counts as hidden at this number of repeats
# power below which it is close to the level itself, and only a bound on the repeats is known
_UNSURE = 0.1
_DRIFT = 0.01  # p below which a parameter is said to change over the event
_STEADY = (
    "Fitted to a moving window, no parameter changes over the event by more than its uncertainty."
)


@dataclass(frozen=True)
class Section:
    """A heading and its sentences.

    Args:
        heading: the question.
        sentences: the answer.
        folded: whether there is nothing to say, or only details, so that a page folds it away.
    """

    heading: str
    sentences: tuple[str, ...]
    folded: bool = False


def describe(report: GapReport, parts: Parts | None = None) -> str:
    """The report as text.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import describe, diagnose
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator())
    >>> describe(report).splitlines()[1].strip()
    'No gap was found: the base model describes these data within their noise.'
    """
    blocks = []
    for section in (
        *sections(report, parts),
        Section("What to do next", (next_step(report, parts),)),
    ):
        lines = "\n".join(f"  {sentence}" for sentence in section.sentences)
        blocks.append(f"{section.heading}\n{lines}")
    return "\n\n".join(blocks)


def sections(report: GapReport, parts: Parts | None = None) -> list[Section]:
    """The report as sections, in the order of the questions."""
    parts = parts or Parts()
    nothing = report.attribution is None
    steps = (
        ("Not computed, because no gap was found.",)
        if parts.selection is None
        else selection_sentences(parts.selection)
    )
    return [
        Section("Verdict", (headline(report), *cause_sentences(report), report.reason)),
        Section("Is there a gap?", _gap(report)),
        Section("Where does it lie?", _where(report, parts), folded=not _located(parts)),
        Section("Which effect causes it?", _causes(report), folded=nothing),
        Section(
            "Does the gel differ between the curves?", _scatter(parts), folded=parts.scatter is None
        ),
        Section(
            "How far does it shrink?",
            _shrinkage(report, parts),
            folded=nothing or parts.shrinkage is None,
        ),
        Section(HEADING, steps, folded=parts.selection is None),
        Section(
            "What does it do to the parameters?",
            _shift(report),
            folded=fit_of_cause(report) is None,
        ),
        Section("What to measure next?", _next(report, parts), folded=parts.next_design is None),
        Section("Not tested, and why", _not_tested(report, parts), folded=True),
        Section("Have the fits converged?", _certificates(report), folded=report.converged),
    ]


def _located(parts: Parts) -> bool:
    return any(
        x is not None for x in (parts.onset, parts.by_experiment, parts.windows, parts.latent)
    )


def cause_sentences(report: GapReport) -> tuple[str, ...]:
    """The values of the named causes with their 90 % intervals, one sentence an effect."""
    return tuple(
        f"{name}: "
        + "; ".join(
            f"{PARAMETERS[p].meaning} is {PARAMETERS[p].interval(*v)}" for p, v in values.items()
        )
        + "."
        for name, values in (cause_values(report) or {}).items()
    )


def next_step(report: GapReport, parts: Parts | None = None) -> str:
    """What to do next, in one sentence."""
    parts = parts or Parts()
    named = " and ".join(report.cause)
    if not report.null.certificate.usable:
        return (
            "Run it again with another --seed, or with more frames: no verdict is given on a fit "
            "that did not converge."
        )
    if report.verdict == "none":
        return (
            "Use the base model with its intervals; shoot more repeats if an effect that would be "
            "missed here matters to you."
        )
    if (ahead := parts.next_design) is not None and ahead.helps:
        weber, rest = ahead.design.tolist()
        return (
            f"Shoot We = {weber:.0f}, R_inf* = {rest:.3f} next: there "
            f"{' and '.join(ahead.causes)} differ most."
        )
    if report.verdict == "effect":
        return (
            f"Use the parameters of the model with {named} added, and check them on curves that "
            "no fit has seen (--heldout)."
        )
    if report.verdict == "class":
        return (
            f"Measure {', '.join(report.cause)} by other means, or shoot another design: these "
            "curves do not tell them apart."
        )
    if is_slow_noise(report):
        return (
            "Repeat a shot at the same design: noise differs between repeats, an effect of the "
            "gel does not."
        )
    if (
        report.verdict == "other"
        and parts.selection is not None
        and GEL_SCATTER in parts.selection.best.effects
    ):
        return (
            "Do not use the parameters of one gel, since curves differ: infer the population "
            "(characterize --population), and "
            "check Rmax, R_inf, clock and optics of each curve."
        )
    if report.verdict == "other":
        return (
            "Do not use the parameters; check Rmax, R_inf, clock and optics first, then register "
            "the effect that you suspect."
        )
    return (
        "Shoot another design, or more repeats, and diagnose all curves together: these do not "
        "decide."
    )


def headline(report: GapReport) -> str:
    """The verdict in one sentence."""
    names = [
        f"{name} ({LIBRARY[name].meaning})" if name in LIBRARY else name for name in report.cause
    ]
    unknown = _or_unknown(report)
    if report.verdict == "none":
        return "No gap was found: the base model describes these data within their noise."
    if is_slow_noise(report):
        return (
            "There is a gap: slow noise of the camera, or an effect that the library does not "
            "hold and that looks like it."
        )
    if report.verdict == "other":
        return "There is a gap, and no effect of the library that was offered explains it."
    if report.verdict == "effect":
        return f"There is a gap, and its cause is {' together with '.join(names)}{unknown}."
    if report.verdict == "class":
        shares = [
            f"{text}{_share_of(report, name)}"
            for text, name in zip(names, report.cause, strict=True)
        ]
        return (
            "There is a gap, and its cause is among these, which the data do not tell apart: "
            f"{', '.join(shares)}{unknown}."
        )
    return "Undecided." + (f" Leading candidates: {', '.join(names)}." if names else "")


def _or_unknown(report: GapReport) -> str:
    """What is said of an unknown effect beside named ones, where it is a member of the verdict."""
    if report.choice is None or OTHER not in report.choice.members:
        return ""
    return (
        ", or an unknown effect that looks like it (probability "
        f"{report.choice.members[OTHER]:.2f})"
    )


def _share_of(report: GapReport, name: str) -> str:
    """The probability of a member of a class; none for an effect that acts beside all of them."""
    members = report.choice.members if report.choice else {}
    own = [p for member, p in members.items() if member.split("+")[-1] == name]
    return f" with probability {own[0]:.2f}" if own else ""


def _gap(report: GapReport) -> tuple[str, ...]:
    test = report.gap
    if not report.null.certificate.usable:
        return (
            "No verdict: the base model's fit did not converge, and an unconverged fit looks "
            "exactly like a gap.",
        )
    found = (
        "Yes"
        if report.found
        else "By the test, but not by the evidence"
        if test.found
        else "None found"
    )
    lines = [
        f"{found}: {p_value(test.p_value)}, of the smallest of {len(test.blocks)} directed tests, "
        "calibrated with data drawn "
        "under the fitted base model.",
        f"Size: {test.bias_sigma:.2f} standard deviations of a single shot (rms), "
        f"{test.bias_radius:.4f} in R*, without the "
        "part that the fitted parameters absorb.",
        *_noise(report),
        "Smallest p-values: "
        + "; ".join(f"{b.name} ({p_value(b.p_value)}{_power(b)})" for b in test.blocks[:_BLOCKS])
        + ".",
    ]
    known = [b for b in test.blocks if b.name in LIBRARY and not math.isnan(b.power)]
    hidden = [b for b in known if b.power < _BLIND]
    if hidden:
        lines.append(
            "Would probably be missed here at a typical size: "
            f"{'; '.join(_missed(hidden, test.blocks))}."
        )
    elif known:
        lines.append(
            "Every effect of the library that was offered would probably be found here at a "
            "typical size."
        )
    return tuple(lines)


def is_slow_noise(report: GapReport) -> bool:
    """Whether the verdict is noise of the camera that lasts several frames, or an unknown effect
    that looks like it.
    """
    return (
        report.verdict == OTHER
        and report.choice is not None
        and SLOW_NOISE in report.choice.members
    )


def _noise(report: GapReport) -> tuple[str, ...]:
    """The noise law where it was inferred, shots with a noise of their own, and frames that were
    left out.
    """
    batch = report.batch
    if batch.noise_laws is None:
        return ()
    lines = [
        *noise_sentences(batch.noise, batch.noise_interval(report.null.prediction)),
        f"Its law: {batch.noise}.",
    ]
    own = {e.label: e.noise_factor for e in batch.curves if e.noise_factor != 1.0}
    lines += [
        f"The noise of {label} is {factor:.2f} times that of the other curves."
        for label, factor in own.items()
    ]
    if report.spoilt:
        counts = ", ".join(f"{count} of {label}" for label, count in report.spoilt.items())
        lines.append(f"Frames that stand alone, far off their neighbours, were left out: {counts}.")
    return tuple(lines)


def _power(block: BlockResult) -> str:
    return (
        f", power {block.power:.2f}"
        if block.name in LIBRARY and not math.isnan(block.power)
        else ""
    )


def _missed(hidden: Sequence[BlockResult], blocks: Sequence[BlockResult]) -> list[str]:
    """Hidden effects, with how many times the repeats would show each with power 0.8.

    Those of next to no power together.
    """

    def times(block: BlockResult) -> int:
        return math.ceil(repeats_needed(max(block.power, _UNSURE), block.rank, len(blocks)))

    likely, blind = ([b for b in hidden if (b.power > _UNSURE) == seen] for seen in (True, False))
    said = [
        f"{b.name} (power {b.power:.2f}; about {times(b)} x the repeats would show it)"
        for b in likely
    ]
    if blind:
        said.append(
            f"{', '.join(b.name for b in blind)} (more than {min(map(times, blind))} x the repeats)"
        )
    return said


def repeats_needed(power: float, rank: int, tests: int, *, wanted: float = 0.8) -> float:
    """Times the repeats that take a test from one power to another, as the noncentrality of
    chi-square is in proportion.

    Args:
        power: at the present number of repeats.
        rank: degrees of freedom of the test.
        tests: number of tests, for Bonferroni's level.
        wanted: power to be reached.
    """
    threshold = float(chdtri(rank, LEVEL / tests))

    def noncentrality(chance: float) -> float:
        return float(brentq(lambda size: 1.0 - chndtr(threshold, rank, size) - chance, 1e-9, 1e4))  # type: ignore[arg-type]

    return noncentrality(wanted) / noncentrality(power)


def _where(report: GapReport, parts: Parts) -> tuple[str, ...]:
    lines = []
    if parts.onset is not None:
        lines.append(str(parts.onset))
    if parts.acts is not None:
        lines.append(str(parts.acts))
    if parts.by_experiment is not None:
        which = parts.by_experiment
        loud = [
            f"{label} ({p_value(p)})"
            for label, p in zip(which.labels, which.p_values, strict=True)
            if p < LEVEL
        ]
        lines.append(
            f"Experiments that reject the model by themselves: {', '.join(loud) or 'none'}."
        )
        lines.append(which.reading)
    if parts.windows is not None:
        tested = zip(parts.windows.names, parts.windows.p_constant.tolist(), strict=True)
        drifting = [name for name, p in tested if p < _DRIFT]
        change = (
            f"change{'' if len(drifting) > 1 else 's'} over the event; any missing effect does "
            "that, so it names no cause."
        )
        lines.append(
            f"Fitted to a moving window, {', '.join(drifting)} {change}" if drifting else _STEADY
        )
    if parts.latent is not None:
        lines.append(
            f"Latent pressure: {parts.latent.log_bayes:.0f} nats of log evidence over no "
            f"pressure. {parts.latent.caveat}"
        )
    return tuple(lines) or (_unlocated(report),)


def _unlocated(report: GapReport) -> str:
    if not report.null.certificate.usable:
        return "Not tested, because the base model's fit did not converge."
    return "Not run." if report.found else "Not tested, because no gap was found."


def _causes(report: GapReport) -> tuple[str, ...]:
    found = report.attribution
    if found is None:
        return (
            "Not tested, because there is no gap to explain."
            if report.verdict == "none"
            else "Not tested, because the base model's fit did not converge.",
        )
    most = list(found.explained.items())[:_CAUSES]
    gained = ", ".join(
        f"{name} {nats:.0f}{' or more' if name in found.unconverged else ''}" for name, nats in most
    )
    lines = [
        *_probabilities(found),
        f"Log evidence gained by a single further effect, nats: {gained}.",
        f"95 % credible set: {', '.join(found.credible_set())}.",
        f"Adequacy of {found.winner}: {p_value(found.adequacy.p_value)}"
        + (
            ", so it is enough."
            if found.adequacy.p_value >= ADEQUATE
            else ", so something else may still be missing."
        ),
    ]
    if (like := found.likeness) is not None:
        lines.append(
            f"The chance that an unknown effect of this size ({like.size:.1f} sd) looks like a "
            "known one at these designs is "
            f"{like.chance:.2f} +- {like.error:.2f}; it is in the probability of other."
        )
    if found.alike:
        alike = [
            f"{name} ({angle:.0f} degrees, leaves {left:.1f} sd)"
            for name, (angle, left) in found.alike.items()
        ]
        lines.append(
            f"What looks most like {found.winner.split('+')[-1]} here: "
            f"{', '.join(alike[:_CAUSES])}."
        )
    return (*lines, *_checks(found))


def odds_text(odds: float) -> str:
    """Prior odds in words: ``"1:9"``, ``"1:1"``."""
    return f"1:{1.0 / odds:g}" if odds <= 1.0 else f"{odds:g}:1"


def _probabilities(found: Attribution) -> list[str]:
    """The most probable causes at each of the prior odds of an unknown effect."""
    lines = []
    for odds, own in (found.at_odds or {VERDICT_ODDS: found.posterior}).items():
        ranked = sorted(own.items(), key=lambda item: -item[1])[:_CAUSES]
        basis = ", on which the verdict is based" if odds == VERDICT_ODDS else ""
        said = ", ".join(f"{name} {p:.3f}" for name, p in ranked)
        lines.append(
            f"Probabilities at prior odds {odds_text(odds)} of an unknown effect{basis}: {said}."
        )
    return lines


def _checks(found: Attribution) -> list[str]:
    """How far the probabilities depend on the Gaussian approximation and on prior scales."""
    lines = []
    if found.checked:
        said = [
            f"{n} {c.sampled - c.laplace:+.1f} +- {c.error:.1f} nats"
            for n, c in found.checked.items()
        ]
        unused = [name for name, own in found.checked.items() if not own.reliable]
        used = (
            f"not used, since the weights of {', '.join(unused)} are too uneven"
            if unused
            else "used"
        )
        lines.append(
            f"Evidence by importance sampling less that of the Gaussian approximation ({used}): "
            f"{', '.join(said)}."
        )
    if found.rescaled:
        said = [
            f"{p:.3f} with {scale:g} times the prior scales" for scale, p in found.rescaled.items()
        ]
        lines.append(
            f"Probability of {found.winner}: {found.posterior.get(found.winner, 0.0):.3f}; "
            f"{', '.join(said)}."
        )
    return lines


def _scatter(parts: Parts) -> tuple[str, ...]:
    if parts.scatter is None:
        return ("Not tested: that needs a gap, and two curves or more, one of each shot.",)
    return parts.scatter.sentences()


def _shrinkage(report: GapReport, parts: Parts) -> tuple[str, ...]:
    found = parts.shrinkage
    causes = report.attribution
    if found is None or causes is None:
        return (
            "Not computed."
            if fit_of_cause(report)
            else "No cause is named, so no reduction was computed.",
        )
    lines = [
        f"On designs that the fits did not see, the gap is {found.word(causes.adequacy.p_value)} "
        f"by {found.effect}."
    ]
    for name, (low, median, high) in found.shrinkage.items():
        rival = " (the best rival)" if name == found.rival else ""
        lines.append(
            f"{name}{rival} removes {100 * median:.0f} % of the squared bias (90 %: "
            f"{100 * low:.0f} to {100 * high:.0f} %)."
        )
    for other in found.comparisons:
        lines.append(
            f"It predicts held-out curves {other.difference:+.1f} +- {other.standard_error:.1f} "
            "nats better than "
            f"{'the base model' if other.against == 'none' else other.against}."
        )
    if not found.converged:
        lines.append("Some of the training fits did not converge: take these figures with care.")
    return tuple(lines)


def _shift(report: GapReport) -> tuple[str, ...]:
    shift = parameter_shift(report)
    if shift is None:
        if report.verdict == "none":
            return ("No cause is added, so the parameters do not change.",)
        return (
            "Without a named cause the fitted parameters are biased by an unknown amount: do not "
            "quote them.",
        )
    assert report.attribution is not None
    lines = [f"With {report.attribution.winner} added:"]
    for name, values in shift.items():
        scale = PARAMETERS[name].display_scale
        (_, old, _), (low, new, high) = values["base"], values["with_cause"]
        lines.append(
            f"{PARAMETERS[name].label}: {scale * old:.4g} becomes {scale * new:.4g} (90 %: "
            f"{scale * low:.4g} to "
            f"{scale * high:.4g}), {100.0 * (new / old - 1.0):+.1f} %."
        )
    return tuple(lines)


def _next(report: GapReport, parts: Parts) -> tuple[str, ...]:
    lines = []
    if (found := parts.next_design) is not None:
        weber, rest = found.design.tolist()
        lines.append(
            f"We = {weber:.0f}, R_inf* = {rest:.3f} tells {', '.join(found.causes)} apart best: "
            f"{found.gain:.2f} +- "
            f"{found.error:.2f} nats of the {found.entropy:.2f} still open between them."
        )
        lines.append(
            f"The expected probability of the true cause there is {found.after:.2f} +- "
            f"{found.after_error:.2f} after the shot, "
            f"and {found.now:.2f} now."
            + ("" if found.helps else " The rise is within two standard errors: no design helps.")
        )
        lines.append(_planned(found.plan))
    return tuple(lines) or ("Not computed, because there are no causes to tell apart.",)


def _planned(plan: Plan) -> str:
    """How the next shot is taken to be observed."""
    own = plan.nuisance
    errors = (
        f"{100.0 * own.max_radius:.2g} % of Rmax, {own.time_zero:.2g} of time zero in t*, "
        f"{100.0 * own.rest_radius:.2g} %"
    )
    return (
        "Planned as these data were observed (median over their experiments): repeats: "
        f"{plan.repeats}, frames: "
        f"{len(plan.times)} to t* = {float(plan.times[-1]):.2f}, the same noise; errors: {errors} "
        "of R_inf."
    )


def _not_tested(report: GapReport, parts: Parts) -> tuple[str, ...]:
    lines = []
    if report.verdict == "other":
        lines.append(
            "What kind of effect it is: guesses at a family of an unknown effect are right in a "
            "third of cases."
        )
    if report.verdict == "class":
        lines.append("Which of the class it is: the data explain all of them about equally well.")
    if report.verdict == "undecided":
        lines.append("Which effect it is, if any: see the reason of the verdict.")
    if report.verdict == "none":
        lines.append("That the model is right: effects listed as probably missed may be there.")
    if report.attribution is not None:
        lines.append(
            "Effects that were not offered: only their sum has a probability, under 'other'."
        )
    if report.found and parts.shrinkage is None:
        lines.append(
            "How far the gap shrinks on new designs: no shrinkage on held-out designs was computed."
        )
    if report.found and parts.onset is None:
        lines.append("From when on the gap can be detected: the location was not run.")
    return tuple(lines)


def _certificates(report: GapReport) -> tuple[str, ...]:
    lines = [f"Base model: {report.null.certificate}."]
    found = report.attribution
    leading = {step.winner: step.fits[step.winner] for step in report.steps}
    if found is not None:
        leading |= {found.winner: found.fits[found.winner]}
    lines += [f"{name}: {fit.certificate}." for name, fit in leading.items()]
    if found is not None:
        behind = found.given_up
        loose = [name for name in found.unconverged if name not in (found.winner, *behind)]
        if behind:
            lines.append(
                "Fits that were given up, since by their costs and gradients they cannot come "
                "near that of "
                f"{found.winner}: {', '.join(behind)}."
            )
        if loose:
            lines.append(
                "Other causes whose fits did not converge, so that their probabilities are lower "
                f"bounds: {', '.join(loose)}."
            )
    return tuple(lines)
