"""What happened in a campaign, read back from its journal: experiments that count, forgotten ones,
beliefs.
"""

import math
from dataclasses import dataclass, field
from typing import Any

from imr_torch.assimilate import Assimilation
from imr_torch.campaign.journal import Journal, differing
from imr_torch.campaign.learners import Finding
from imr_torch.errors import ImrError, InputDataError
from imr_torch.material import Belief
from imr_torch.observe import Experiment, Noise
from imr_torch.select import Evidence


@dataclass(frozen=True)
class Step:
    """The state after one experiment: belief, evidence and fits.

    Args:
        number: of the last experiment that it includes, from 1.
        belief: after this experiment.
        evidence: evidence of each model, all experiments together; empty if the learner knows none.
        assimilation: the fits; None when the step was read back from the journal, or the learner
            makes none.
        noise: of one curve, if the learner estimates it.
        finding: of the diagnosis, if the learner makes one.
        population: JSON-ready, if the learner infers one and there are two shots or more.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import Step
    >>> step = Step(1, wide_prior(["nhkv"]), evidence=())
    >>> step.number, step.belief.keys
    (1, ('nhkv',))
    """

    number: int
    belief: Belief
    evidence: tuple[Evidence, ...]
    assimilation: Assimilation | None = None
    noise: Noise | None = None
    finding: Finding | None = None
    population: dict[str, Any] | None = None


@dataclass
class History:
    """What a journal says.

    Args:
        told: experiments that count, by number.
        withdrawn: experiments that were forgotten, in that order.
        steps: the beliefs that still stand.
    """

    told: dict[int, Experiment] = field(default_factory=dict)
    withdrawn: list[Experiment] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)

    def follow(self, event: dict[str, Any], journal: Journal) -> None:
        """Take one event of the journal in."""
        if event["event"] == "observed":
            for record in event["experiments"]:
                self.told[record["number"]] = journal.restore(record)
        elif event["event"] == "learnt":
            evidence = tuple(Evidence(**_infinite(entry)) for entry in event["evidence"])
            noise = Noise(**event["noise"]) if event.get("noise") else None
            finding = Finding.from_dict(event["finding"]) if event.get("finding") else None
            belief = Belief.from_dict(event["belief"])
            self.steps.append(
                Step(event["step"], belief, evidence, None, noise, finding, event.get("population"))
            )
        elif event["event"] == "forget":
            self.withdrawn.append(self.told.pop(event["experiment"]))
            self.steps = [step for step in self.steps if step.number < event["experiment"]]


def replayed(journal: Journal) -> History:
    """The history that a journal tells.

    Raises:
        InputDataError: naming the first line that cannot be read.
    """
    history = History()
    for line, event in enumerate(journal.events, start=1):
        try:
            history.follow(event, journal)
        except ImrError as error:
            raise type(error)(f"{journal.path}, line {line}: {error}") from None
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            raise InputDataError(
                f"{journal.path}, line {line}: event {event['event']!r} cannot be read "
                f"({type(error).__name__}: {error}). Restore the journal from a copy."
            ) from None
    return history


def check_identity(journal: Journal, identity: dict[str, Any]) -> None:
    """Raise if a journal is that of another campaign; one without events is of none.

    Args:
        journal: of the folder.
        identity: what the journal of the campaign begins with.
    """
    if not journal.events:
        return
    first = journal.events[0]
    if first["event"] != "start":
        raise InputDataError(
            f"{journal.path}, line 1: event is {first['event']!r}; a campaign begins with 'start'."
        )
    known = {key: value for key, value in first.items() if key != "event"}
    if names := differing(known, identity):
        raise InputDataError(
            f"{journal.path} is the journal of another campaign: {', '.join(names)} differ. "
            "Resume with the same "
            "arguments; if another version of imr_torch began it, tell its curves to a campaign "
            "in a new folder."
        )


def _infinite(values: dict[str, Any]) -> dict[str, Any]:
    """Inverse of :func:`finite`.

    The one number of an evidence that may be infinite is the shape of its tail.
    """
    return {k: (math.inf if v is None else v) for k, v in values.items()}
