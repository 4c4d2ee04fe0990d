"""A diagnosis in words, from its document alone: the verdict, then the questions in order.

The text is a list of sections, each a heading with sentences; the printed text and the page show the
same list. Where something was not tested, its section says why.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from imr_torch.assimilate.spikes import spoilt_sentence
from imr_torch.gap.hypotheses import EXPLAINS, GEL_SCATTER, in_words
from imr_torch.gap.verdict import MEMBER, NONE, OTHER, SLOW_NOISE
from imr_torch.goodness.score import ADEQUATE
from imr_torch.labels import p_value
from imr_torch.material import LIBRARY, PARAMETERS

Document = Mapping[str, Any]
"""A diagnosis as :func:`imr_torch.gap.to_json` makes it."""

VERDICT = "Verdict"
TESTED = "Is there a gap?"
HIDDEN = "What would these data not show?"
PLACE = "Where does it lie?"
CAUSES = "Which effect causes it?"
RECORD = "The record before any gel"
SHRINKS = "How far does it shrink on unseen curves?"
MISSING = "What is missing?"
CURVES = "The curves"
"""Headings of sections in which a figure or a table stands."""
_MOST_SHOWN = 5
_TESTS_SHOWN = 3
_SHARE_SHOWN = 0.15
_TOLD_APART = 0.8  # probability of a kind or a term from which on it is said
_KINDS = {
    "material": "a stress of the gel, one function of stretch and strain rate in all shots",
    "contents": "a pressure of the contents, one function of radius and velocity in all shots",
    "drive": "a pressure of its own in each shot",
    "sample": "the sample around the bubble: an echo of its flux, or a resistance to it",
    "camera": "an error of the camera, of radius or time",
}
_ENTRIES = {
    GEL_SCATTER: "the gel differs between shots",
    NONE: "nothing is missing",
    OTHER: "an effect that the library does not hold",
    SLOW_NOISE: "slow noise of the camera",
}


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


def title(name: str) -> str:
    """A cause in plain words, its code name behind: of an effect, of several joined by ``+``, or
    another entry of the posterior.

    >>> from imr_torch.gap.text import title
    >>> title("clock"), title("other")
    ('frame rate or pixel size is off (clock)', 'an effect that the library does not hold')
    """
    said = [
        f"{LIBRARY[part].meaning} ({part})" if part in LIBRARY else _ENTRIES.get(part, part)
        for part in name.split("+")
    ]
    return " and ".join(said)


def shown(parameter: str, value: float) -> str:
    """A value in display units.

    >>> from imr_torch.gap.text import shown
    >>> shown("G", 8310.0)
    '8.31 kPa'
    """
    return PARAMETERS[parameter].interval(value, value, value).split(" (")[0]


def describe(document: Document) -> str:
    """The diagnosis as text.

    Args:
        document: of the diagnosis (:func:`imr_torch.gap.to_json`).

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.gap import describe, diagnose, to_json
    >>> from imr_torch.material import PARAMETERS, library
    >>> from imr_torch.observe import SimulatedLaboratory
    >>> laboratory = SimulatedLaboratory(PolytropicSimulator(), PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> report = diagnose([shot], effects=library(["sound_speed"]), simulator=PolytropicSimulator())
    >>> describe(to_json(report)).splitlines()[1].strip()
    'No gap was found: the base model describes these data within their noise.'
    """
    blocks = []
    for section in (*sections(document), Section("What to do next", (document["next_step"],))):
        lines = "\n".join(f"  {sentence}" for sentence in section.sentences)
        blocks.append(f"{section.heading}\n{lines}")
    return "\n\n".join(blocks)


def sections(document: Document) -> list[Section]:
    """The diagnosis as sections, in the order of the questions."""
    no_cause = document["posterior"] is None
    record = document.get("record")
    before = [Section(RECORD, tuple(record["sentences"]), folded=True)] if record else []
    return [
        Section(
            VERDICT,
            (
                document["headline"],
                *_cause_sentences(document),
                document["reason"],
                *parameter_sentences(document),
            ),
        ),
        *before,
        Section(TESTED, _gap(document)),
        Section(HIDDEN, _hidden(document)),
        Section(PLACE, _where(document), folded=not document["examined"]),
        Section(CAUSES, _causes(document), folded=no_cause),
        Section(MISSING, _missing(document), folded=document.get("missing") is None),
        Section(SHRINKS, _shrinkage(document), folded=document["shrinkage"] is None),
        Section(
            "What does it do to the parameters?",
            _shift(document),
            folded=document["parameter_shift"] is None and document["gels"] is None,
        ),
        Section("What to measure next?", _next(document), folded=document["next_design"] is None),
        Section("Have the fits converged?", _certificates(document), folded=document["converged"]),
    ]


def headline(document: Document) -> str:
    """The verdict in one sentence."""
    verdict = document["verdict"]
    members = document["members"] or {}
    names = [title(name) for name in document["cause"]]
    if verdict == "none":
        return "No gap was found: the base model describes these data within their noise."
    if verdict == "other" and SLOW_NOISE in members:
        return (
            "There is a gap: slow noise of the camera, or an effect that the library does not "
            "hold and that looks like it."
        )
    if verdict == "other":
        known = [title(name) for name in members if name not in _ENTRIES]
        if known:
            return f"There is a gap: {', or '.join([*known, _ENTRIES[OTHER]])}."
        return "There is a gap, and no effect of the library that was offered explains it."
    unknown = (
        f", or an unknown effect that looks like it (probability {members[OTHER]:.2f})"
        if OTHER in members
        else ""
    )
    if verdict == "effect":
        return f"There is a gap, and its cause: {', together with: '.join(names)}{unknown}."
    if verdict == "class":
        shares = {name.split("+")[-1]: p for name, p in members.items()}
        said = [
            f"{text} with probability {shares[name]:.2f}" if name in shares else text
            for text, name in zip(names, document["cause"], strict=True)
        ]
        return (
            "There is a gap, and its cause is among these, which the data do not tell apart: "
            f"{'; '.join(said)}{unknown}."
        )
    return "Undecided." + (f" Leading candidates: {'; '.join(names)}." if names else "")


def next_step(document: Document) -> str:
    """What to do next, in one sentence."""
    verdict = document["verdict"]
    if not document["null_usable"]:
        return (
            "Run it again with another --seed, or with more frames: no verdict is given on a fit "
            "that did not converge."
        )
    if verdict == "none":
        return (
            "Use the base model with its intervals; shoot more repeats if an effect that would be "
            "missed here matters to you."
        )
    if (ahead := document["next_design"]) is not None and ahead["helps"]:
        apart = "; ".join(map(title, ahead["tells_apart"]))
        return (
            f"Shoot We = {ahead['We']:.0f}, R_inf* = {ahead['R_inf*']:.3f} next: there these "
            f"differ most: {apart}."
        )
    if GEL_SCATTER in document["cause"] and verdict == "effect":
        return (
            "Infer the population (characterize --population), since the gel differs between "
            "shots; one gel for all has no value to quote."
        )
    if verdict == "effect":
        return (
            f"Use the parameters of the model with {' and '.join(document['cause'])} added, and "
            "check them on curves that no fit has seen (--heldout)."
        )
    if verdict == "class":
        return (
            f"Measure {', '.join(document['cause'])} by other means, or shoot another design: these "
            "curves do not tell them apart."
        )
    if verdict == "other" and SLOW_NOISE in (document["members"] or {}):
        return (
            "Repeat a shot at the same design: noise differs between repeats, an effect of the "
            "gel does not."
        )
    if verdict == "other":
        return (
            "Quote the parameters with what the model may lack; check Rmax, R_inf, clock and optics "
            "first, then register the effect that you suspect."
        )
    return (
        "Shoot another design, or more repeats, and diagnose all curves together: these do not "
        "decide."
    )


def parameter_sentences(document: Document) -> tuple[str, ...]:
    """Each parameter of the gel with its interval if the model is right, and with what it may
    lack.
    """
    wide = document["parameters_with_model_error"]
    lines = []
    for name, (low, middle, high) in document["parameters"].items():
        right = f"{shown(name, low)} to {shown(name, high)} if the model is right"
        if wide is not None:
            least, _, most = wide[name]
            right += f"; {shown(name, least)} to {shown(name, most)} with what it may lack"
        lines.append(f"{name} is {shown(name, middle)} (90 %: {right}).")
    return tuple(lines)


def _cause_sentences(document: Document) -> list[str]:
    """The values of the named effects with their 90 % intervals, one sentence an effect."""
    lines = []
    for name, values in (document["cause_values"] or {}).items():
        said = [
            f"{PARAMETERS[p].meaning} is {PARAMETERS[p].interval(*v)}" for p, v in values.items()
        ]
        lines.append(f"{name}: {'; '.join(said)}.")
    return lines


def _gap(document: Document) -> tuple[str, ...]:
    if not document["null_usable"]:
        return (
            "No verdict: the base model's fit did not converge, and an unconverged fit looks "
            "exactly like a gap.",
        )
    found = "None found"
    if document["gap"]:
        found = "Yes"
    elif document["test_rejects"]:
        found = "By the test, but not by the evidence"
    tests = document["tests"]
    smallest = "; ".join(f"{b['name']} ({p_value(b['p_value'])})" for b in tests[:_TESTS_SHOWN])
    return (
        f"{found}: {p_value(document['p_gap'])}, of the smallest of {len(tests)} directed tests, "
        "calibrated with data drawn under the fitted base model.",
        f"Size: {document['bias_sigma']:.2f} standard deviations of a single shot (rms), "
        f"{document['bias_R']:.4f} in R*, without the part that the fitted parameters absorb.",
        *_noise(document),
        f"Smallest p-values: {smallest}.",
    )


def _noise(document: Document) -> list[str]:
    """The noise law where it was inferred, shots with a noise of their own, and frames that were
    left out.
    """
    if not document["noise_inferred"]:
        return []
    lines = [*document["noise_sentences"], f"Its law: {document['noise_text']}."]
    factors = {label: x for label, x in document["noise_factors"].items() if x != 1.0}
    lines += [
        f"The noise of {label} is {factor:.2f} times that of the other curves."
        for label, factor in factors.items()
    ]
    if document["frames_left_out"]:
        lines.append(spoilt_sentence(document["frames_left_out"]))
    return lines


def hidden_row(row: Mapping[str, Any]) -> tuple[str, str, str]:
    """Title of an effect, the size that would have been found with 90 %, and what that size (where
    there is none, its usual size), unseen, would move each parameter by.

    Args:
        row: an entry of ``hidden``.

    >>> from imr_torch.gap.text import hidden_row
    >>> hidden_row({"effect": "permanent_set", "size": None, "shift": {"G": -0.061}})[1:]
    ('none of a usual size', 'G by up to 6.1 %')
    """
    name = row["effect"]
    size = row["size"]
    moves = ", ".join(f"{p} by up to {100 * abs(x):.2g} %" for p, x in row["shift"].items())
    found = "none of a usual size" if size is None else shown(LIBRARY[name].names[0], size)
    return title(name), found, moves or "nothing"


def hidden_sentence(row: Mapping[str, Any]) -> str:
    """What these data would not show of an effect, in words.

    >>> from imr_torch.gap.text import hidden_sentence
    >>> hidden_sentence({"effect": "clock", "size": 0.01, "shift": {"G": 0.06}})
    'frame rate or pixel size is off (clock): 0.01 would be found; less, unseen, moves G by up to 6 %.'
    """
    name, found, moves = hidden_row(row)
    size = "its usual size" if row["size"] is None else "less"
    return f"{name}: {found} would be found; {size}, unseen, moves {moves}."


def _hidden(document: Document) -> tuple[str, ...]:
    if not document["hidden"]:
        return ("Not computed, because the base model's fit did not converge.",)
    return (
        "Sizes that these data would have shown with 90 %, and what a smaller one, unseen, may do; "
        "the largest changes first.",
        *map(hidden_sentence, document["hidden"][:_MOST_SHOWN]),
    )


def _where(document: Document) -> tuple[str, ...]:
    if not document["examined"]:
        if not document["null_usable"]:
            return ("Not tested, because the base model's fit did not converge.",)
        return ("Not run." if document["gap"] else "Not tested, because no gap was found.",)
    lines = [document["onset"]["sentence"]]
    if document["acts"] is not None:
        lines.append(document["acts"]["sentence"])
    return tuple(lines)


def acts_sentence(shares: Mapping[str, Sequence[float]]) -> str:
    """From which phases the signal of the named effects comes.

    >>> from imr_torch.gap.text import acts_sentence
    >>> acts_sentence({"start": (0.0, 0.02, 0.1), "first collapse": (0.7, 0.8, 0.9)})
    'Its signal beside a refit of the gel comes from: first collapse 0.80 (0.70 to 0.90).'
    """
    ranked = sorted(shares.items(), key=lambda item: -item[1][1])
    said = [
        f"{phase} {middle:.2f} ({low:.2f} to {high:.2f})"
        for phase, (low, middle, high) in ranked
        if high >= _SHARE_SHOWN
    ]
    return f"Its signal beside a refit of the gel comes from: {', '.join(said)}."


def _causes(document: Document) -> tuple[str, ...]:
    if document["posterior"] is None:
        return (
            "Not tested, because there is no gap to explain."
            if document["verdict"] == "none"
            else "Not tested, because the base model's fit did not converge.",
        )
    leading = document["leading"]
    loose = document["unconverged"]
    most = list(document["explained_nats"].items())[:_MOST_SHOWN]
    gained = ", ".join(
        f"{name} {nats:.0f}{' or more' if name in loose else ''}" for name, nats in most
    )
    adequacy = document["leading_adequacy_p"]
    enough = "it is enough" if adequacy >= ADEQUATE else "something else may still be missing"
    unknown = document["unknown"]
    lines = [
        *_probabilities(document),
        f"Log evidence gained by one part more, nats: {gained}.",
        f"95 % credible set: {', '.join(document['credible_set'])}.",
        f"Adequacy of {leading}: {p_value(adequacy)}, so {enough}.",
        f"The chance that an unknown effect of this size ({unknown['size_sd']:.1f} sd) looks like a "
        f"known one at these designs is {unknown['chance_look_alike']:.2f} +- "
        f"{unknown['standard_error']:.2f}; it is in the probability of an unknown one.",
    ]
    return (*lines, *_checks(document))


def _probabilities(document: Document) -> list[str]:
    """The most probable causes at each of the prior odds of an unknown effect."""
    lines = []
    for odds, posterior in document["posterior_at_odds"].items():
        ranked = sorted(posterior.items(), key=lambda item: -item[1])[:_MOST_SHOWN]
        basis = ", on which the verdict is based" if odds == document["verdict_odds"] else ""
        said = ", ".join(f"{name} {p:.3f}" for name, p in ranked)
        lines.append(f"Probabilities at prior odds {odds} of an unknown effect{basis}: {said}.")
    return lines


def _checks(document: Document) -> list[str]:
    """How far the probabilities depend on the Gaussian approximation."""
    checked = document["evidence_checks"]
    if not checked:
        return []
    said = [
        f"{n} {c['sampled'] - c['laplace']:+.1f} +- {c['error']:.1f} nats"
        for n, c in checked.items()
    ]
    unused = ", ".join(name for name, c in checked.items() if not c["reliable"])
    used = f"not used, since the weights of {unused} are too uneven" if unused else "used"
    return [
        f"Evidence by importance sampling less that of the Gaussian approximation ({used}): "
        f"{', '.join(said)}."
    ]


def _missing(document: Document) -> tuple[str, ...]:
    """The missing pressure: its kind, its size, what it looks like."""
    found = document.get("missing")
    if found is None:
        return ("Not inferred: that is done where there is a gap without a named cause.",)
    if found["explained_nats"] < EXPLAINS:
        return ("Nothing that is smooth in a state of the bubble or in time explains it.",)
    kind = found["kind"]
    share = found["kinds"][kind]
    said = (
        f"Most like {_KINDS[kind]} (probability {share:.2f} among five kinds; of simulated sets in "
        "which one kind had .8 or more, three of four were right)."
    )
    if share < _TOLD_APART:
        likely = [f"{_KINDS[k]}, {p:.2f}" for k, p in found["kinds"].items() if p > MEMBER]
        said = f"These data do not tell its kind: {'; '.join(likely)}."
    sentences = [
        said,
        f"It explains the curves {found['explained_nats']:.0f} nats better than the base model.",
    ]
    if found["shots"]:
        largest, own = (
            max(abs(p) for shot in found["shots"] for p in shot[name])
            for name in ("kPa", "own_kPa")
        )
        sentences.append(
            f"The missing pressure is up to {largest:.3g} kPa, where the base model's stress is up "
            f"to {own:.3g} kPa."
        )
    term, p = next(iter(found["terms"].items()), ("", 0.0))
    if p >= _TOLD_APART:
        sentences.append(f"It looks like {term} (probability {p:.2f}).")
    return tuple(sentences)


def _shrinkage(document: Document) -> tuple[str, ...]:
    found = document["shrinkage"]
    if found is None:
        if not document["gap"]:
            return ("Not computed, because no gap was found.",)
        if not document["examined"]:
            return ("Not run.",)
        if set(document["selected"]) <= {GEL_SCATTER}:
            return ("Not computed, because no effect was selected.",)
        return ("Not computed: it needs a curve that no fit saw; give two curves or more.",)
    if found["share"] is None:
        return (
            "What is the curves' own leaves no gap on unseen curves "
            f"({p_value(found['base_p'])}): differences between shots are enough.",
        )
    low, middle, high = found["share"]
    added = ", ".join(sorted({title(part) for parts in found["selected"] for part in parts}))
    lines = [
        f"On curves that neither fits nor selection saw, the gap is {found['word']}: "
        f"{middle:.2f} ({low:.2f} to {high:.2f}) of it goes with what was selected "
        f"({added or 'nothing'}).",
        f"As many random smooth effects, selected likewise, close {found['placebo_median']:.2f} "
        f"(95 % of {found['placebos']} libraries: less than {found['placebo_95']:.2f}).",
    ]
    if found["later"] is not None:
        low, middle, high = found["later"]
        lines.append(
            "After the first rebound, with what is a curve's own fitted before it: "
            f"{middle:.2f} ({low:.2f} to {high:.2f})."
        )
    if not found["converged"]:
        lines.append("Some of the training fits did not converge: take these figures with care.")
    return tuple(lines)


def _shift(document: Document) -> tuple[str, ...]:
    lines = []
    if (shift := document["parameter_shift"]) is not None:
        lines.append(f"With {' and '.join(map(in_words, document['selected']))}:")
        for name, values in shift.items():
            (_, before, _), after = values["base"], values["with_cause"]
            more = f", {100.0 * (after[1] / before - 1.0):+.1f} %"
            lines.append(
                f"{name}: {shown(name, before)} becomes {PARAMETERS[name].interval(*after)}"
                f"{more if PARAMETERS[name].dimension != 'ratio' else ''}."
            )
    if document["gels"] is not None:
        for name, values in document["gels"].items():
            each = ", ".join(shown(name, value) for value in values)
            lines.append(f"{name} of each shot: {each}.")
    bound = document["parameter_bound_sd"]
    if bound and document["gap"]:
        lines.append(
            f"By geometry alone, an error of the size of the residual ({bound:.0f} sd) may move a "
            "parameter of the base model by as many of its standard deviations."
        )
    return tuple(lines) or ("No cause is added, so the parameters do not change.",)


def _next(document: Document) -> tuple[str, ...]:
    found = document["next_design"]
    if found is None:
        return ("Not computed, because there are no causes that a shot would tell apart.",)
    rises = "" if found["helps"] else " The rise is within two standard errors: no design helps."
    plan = found["plan"]
    errors = (
        f"{100.0 * plan['max_radius_sd']:.2g} % of Rmax, {plan['time_zero_sd']:.2g} of time zero "
        f"in t*, {100.0 * plan['rest_radius_sd']:.2g} % of R_inf"
    )
    return (
        f"We = {found['We']:.0f}, R_inf* = {found['R_inf*']:.3f} tells "
        f"{', '.join(found['tells_apart'])} apart best: {found['gain']:.2f} +- "
        f"{found['gain_sd']:.2f} nats of the {found['entropy']:.2f} still open between them.",
        f"The expected probability of the true cause there is {found['p_truth_after']:.2f} +- "
        f"{found['p_truth_after_sd']:.2f} after the shot, and {found['p_truth_now']:.2f} now.{rises}",
        "Planned as these data were observed (median over their experiments): repeats: "
        f"{plan['repeats']}, frames: {plan['frames']} to t* = {plan['end_t']:.2f}, the same noise; "
        f"errors: {errors}.",
    )


def _certificates(document: Document) -> tuple[str, ...]:
    rows = document["certificates"]
    names = {"none": "Base model"}
    lines = [f"{names.get(name, name)}: {row['text']}." for name, row in rows.items()]
    behind: Sequence[str] = document["given_up"] or ()
    loose = [
        name
        for name in document["unconverged"] or ()
        if name != document["leading"] and name not in behind
    ]
    if behind:
        lines.append(
            "Fits that were given up, since by their costs and gradients they cannot come near "
            f"that of {document['leading']}: {', '.join(behind)}."
        )
    if loose:
        lines.append(
            "Other causes whose fits did not converge, so that their probabilities are lower "
            f"bounds: {', '.join(loose)}."
        )
    return tuple(lines)
