"""A diagnosis in words, from its document alone: the verdict, then the questions in order.

The text is a template, as those of all results are. It is a list of sections, each a heading with
sentences; the page shows the same list.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from imr_torch.assimilate.spikes import spoilt_sentence
from imr_torch.gap.hypotheses import EXPLAINS, GEL_SCATTER, in_words
from imr_torch.gap.verdict import MEMBER, NONE, OTHER, SLOW_NOISE
from imr_torch.goodness.score import ADEQUATE
from imr_torch.html import render
from imr_torch.labels import p_value
from imr_torch.material import LIBRARY, PARAMETERS

Document = Mapping[str, Any]
"""A diagnosis as :func:`imr_torch.gap.to_json` makes it."""

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


def list_names() -> Mapping[str, Any]:
    """What templates of a diagnosis may use beside the document: words for its numbers."""
    return {
        "parameters": PARAMETERS,
        "entries": _ENTRIES,
        "titles": lambda names: list(map(title, names)),
        "shown": shown,
        "in_words": in_words,
        "hidden_row": hidden_row,
        "sections": sections,
        "p_value": p_value,
        "spoilt_sentence": spoilt_sentence,
        "adequate": ADEQUATE,
        "explains": EXPLAINS,
        "member": MEMBER,
    }


def _fill_template(name: str, document: Document) -> str:
    return render(name, document=document, **list_names()).strip("\n")


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
    return _fill_template("diagnose.txt", document)


def sections(document: Document) -> list[Section]:
    """The diagnosis as sections, in the order of the questions."""
    folded = {
        "The record before any gel": True,
        "Where does it lie?": not document["examined"],
        "Which effect causes it?": document["posterior"] is None,
        "What is missing?": document.get("missing") is None,
        "How far does it shrink on unseen curves?": document["shrinkage"] is None,
        "What does it do to the parameters?": not (document["parameter_shift"] or document["gels"]),
        "What to measure next?": document["next_design"] is None,
        "Have the fits converged?": document["converged"],
        "The medium": True,
    }
    blocks = map(str.splitlines, describe(document).split("\n\n")[:-1])
    return [
        Section(heading, tuple(map(str.strip, lines)), folded.get(heading, False))
        for heading, *lines in blocks
    ]


def headline(document: Document) -> str:
    """The verdict in one sentence."""
    return _fill_template("diagnosis_headline.txt", document)


def next_step(document: Document) -> str:
    """What to do next, in one sentence."""
    return _fill_template("diagnosis_next_step.txt", document)


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
