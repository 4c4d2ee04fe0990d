"""What a diagnosis says, as a line of a record, and what its verdict is worth against the truth."""

from collections.abc import Iterable
from typing import Any

from benchmarks.records import Line
from imr_torch.gap import LIBRARY, GapReport, to_json
from imr_torch.goodness.score import ADEQUATE

_KEPT = (
    "gap",
    "p_gap",
    "bias_sigma",
    "verdict",
    "cause",
    "adequacy_p",
    "converged",
    "seconds",
    "members",
    "posterior",
)


def summarise(report: GapReport) -> Line:
    """What a report says, in the words of the command's JSON; ``selected`` are parts that were settled
    on before the last.
    """
    document = to_json(report)
    line: dict[str, Any] = {key: document[key] for key in _KEPT}
    line["selected"] = list(report.attribution.held.parts) if report.attribution else []
    if report.steps:
        first = report.steps[0]
        line["first"] = {
            "chance": first.likeness.chance,
            "adequate": first.adequacy.p_value >= ADEQUATE,
        }
    return line


def posterior_of(line: Line) -> dict[str, Any]:
    """Probabilities of causes, an unknown effect being as likely before as all known ones; empty where
    none was asked for. Older lines hold them at two prior odds.
    """
    at_odds = line.get("posterior_at_odds") or {}
    return line.get("posterior") or at_odds.get("1:1") or {}


def families(names: Iterable[str]) -> frozenset[str]:
    """Classes of effects; ``"none"`` and ``"other"`` are classes of their own."""
    return frozenset(LIBRARY[name].family if name in LIBRARY else name for name in names)


def is_named(line: Line) -> bool:
    """Whether the verdict names an effect or a class."""
    return line.get("verdict") in ("effect", "class")


def is_in_class(line: Line) -> bool:
    """Whether the named class holds all of the truth, with no effect too many."""
    return not line["selected"] and families(line["truth"]) <= families(line["cause"])


def is_named_alone(verdict: str, cause: Iterable[str]) -> bool:
    """Whether a verdict names one cause, or forms of one thing."""
    return verdict in ("effect", "class") and len(families(cause)) == 1
