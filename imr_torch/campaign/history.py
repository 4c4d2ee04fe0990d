"""What a campaign is and what happened in it, as its journal has it: settings, designs asked for,
experiments that count, forgotten ones, beliefs.
"""

import json
import math
from collections import defaultdict
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any

from torch import Tensor

from imr_torch.campaign.journal import REMEDY, Journal, differing_names
from imr_torch.campaign.learners import ExactLearner, Finding, Inference, Learner
from imr_torch.campaign.policies import DesignPolicy, Optimal, Proposal
from imr_torch.campaign.stopping import StoppingRule
from imr_torch.design import (
    DesignSpace,
    Plan,
)
from imr_torch.errors import ImrError, InputDataError
from imr_torch.files import Document, without_nonfinite
from imr_torch.float64 import tensor
from imr_torch.material import Belief
from imr_torch.observe import Experiment, Noise
from imr_torch.select import Evidence
from imr_torch.units import Surroundings


@dataclass(frozen=True)
class CampaignSettings:
    """How a campaign chooses, learns and ends.

    Args:
        space: designs that may be asked for.
        plan: how each experiment will be observed.
        policy: chooses designs.
        learner: turns experiments into a belief.
        stop: ends the campaign; None to go on as long as :meth:`Campaign.run` is asked to.

    >>> from imr_torch.campaign import CampaignSettings, Designs, SpaceFilling
    >>> settings = CampaignSettings(policy=SpaceFilling(), stop=Designs(5))
    >>> settings.to_dict()["stop"]
    {'kind': 'Designs', 'count': 5}
    """

    space: DesignSpace = field(default_factory=DesignSpace)
    plan: Plan = field(default_factory=lambda: Plan(repeats=100))
    policy: DesignPolicy = field(default_factory=Optimal)
    learner: Learner = field(default_factory=ExactLearner)
    stop: StoppingRule | None = None

    def to_dict(self) -> Document:
        """JSON-ready values, with the kind of every part."""
        return _describe_part(self)


def _describe_part(value: Any) -> Any:
    """A dataclass and what it is made of as JSON-ready values.

    Fields that make no two of them differ are left out.
    """
    if is_dataclass(value):
        own = {
            f.name: _describe_part(getattr(value, f.name))
            for f in fields(value)
            if f.compare
        }
        return {"kind": type(value).__name__} | own
    if isinstance(value, tuple):
        return [_describe_part(part) for part in value]
    return value.tolist() if isinstance(value, Tensor) else value


@dataclass(frozen=True)
class Step(Inference):
    """What was inferred after one experiment, without fits and ``record`` when it was read back from
    the journal.

    Args:
        number: of the last experiment that it includes, from 1; 0 before the first.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import Step
    >>> step = Step(wide_prior(["nhkv"]), number=1)
    >>> step.number, step.belief.keys
    (1, ('nhkv',))
    """

    number: int = field(kw_only=True)


@dataclass
class Ask:
    """A design that was asked for.

    Args:
        proposal: the design and its gain.
        search: what the journal keeps of how it was found.
        failures: shots of it that failed.
        stale: whether an experiment was forgotten since.
    """

    proposal: Proposal
    search: Document | None
    failures: int = 0
    stale: bool = False


def describe_proposal(proposal: Proposal, surroundings: Surroundings) -> Document:
    """What the journal keeps of a design that was asked for."""
    return vars(proposal) | {
        "design": proposal.design.tolist(),
        "search": proposal.search and proposal.search.to_dict(surroundings),
    }


def describe_inference(inference: Inference) -> Document:
    """What the journal keeps of what was learnt."""
    return {
        "belief": inference.belief.to_dict(),
        "evidence": without_nonfinite([asdict(e) for e in inference.evidence])[0],
        "noise": vars(inference.noise) if inference.noise else None,
        "finding": asdict(inference.finding) if inference.finding else None,
        **inference.record,
    }


@dataclass
class History:
    """What a journal says.

    Args:
        told: experiments that count, by number.
        withdrawn: experiments that were forgotten, in that order.
        steps: the beliefs that still stand.
        asked: what was asked for last, by step.
        moved: designs asked for in a step whose shots failed twice.
    """

    told: dict[int, Experiment] = field(default_factory=dict)
    withdrawn: list[Experiment] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    asked: dict[int, Ask] = field(default_factory=dict)
    moved: defaultdict[int, list[Tensor]] = field(default_factory=lambda: defaultdict(list))

    @property
    def count(self) -> int:
        """Experiments that were told, forgotten ones included."""
        return len(self.told) + len(self.withdrawn)

    def standing_ask(self, number: int) -> Ask | None:
        """What was asked for last in a step.

        None if it was to be answered under a belief that was withdrawn since, or its design failed
        twice.
        """
        ask = self.asked.get(number)
        if ask is None or ask.failures > 1 or (ask.stale and number > self.count):
            return None
        return ask

    def follow_event(self, event: Document, journal: Journal) -> None:
        """Take one event of the journal in.

        Raises:
            InputDataError: if it lacks something, or is of no kind that a campaign writes.
        """
        match event:
            case {"event": "start" | "stop"}:
                pass
            case {
                "event": "ask",
                "step": int(step),
                "design": [float(), float()] as design,
                "search": search,
                **others,
            }:
                self.asked[step] = Ask(Proposal(step, tensor(design), **others), search)
            case {"event": "failed", "step": int(step)}:
                if ask := self.asked.get(step):
                    ask.failures += 1
                    if ask.failures == 2:
                        self.moved[step].append(ask.proposal.design)
            case {"event": "observed", "step": int(), "experiments": records}:
                for record in records:
                    self.told[int(record["number"])] = journal.restore_curves(record)
            case {
                "event": "learnt",
                "step": int(step),
                "experiments": numbers,
                "belief": belief,
                "evidence": rows,
                "noise": noise,
                "finding": finding,
            } if self.told.keys() >= set(numbers):
                self.steps.append(
                    Step(
                        Belief.from_dict(belief),
                        tuple(Evidence(**_restore_infinite(entry)) for entry in rows),
                        noise=Noise(**noise) if noise else None,
                        finding=Finding(**finding | {"causes": tuple(finding["causes"])})
                        if finding
                        else None,
                        number=step,
                    )
                )
            case {"event": "forget", "experiment": number}:
                self.withdrawn.append(self.told.pop(number))
                self.steps = [step for step in self.steps if step.number < number]
                for ask in self.asked.values():
                    ask.stale = True
            case _:
                raise InputDataError(
                    f"event {event['event']!r} lacks a field that a campaign writes, or is none of "
                    f"a campaign. {REMEDY}"
                )


def replay_journal(journal: Journal) -> History:
    """The history that a journal tells.

    Raises:
        InputDataError: naming the first line that cannot be read.
    """
    history = History()
    for line, event in enumerate(journal.events, start=1):
        try:
            history.follow_event(event, journal)
        except ImrError as error:
            raise type(error)(f"{journal.path}, line {line}: {error}") from None
        except Exception as error:
            raise InputDataError(
                f"{journal.path}, line {line}: event {event['event']!r} cannot be read "
                f"({type(error).__name__}: {error}). Restore the journal from a copy."
            ) from None
    return history


def check_identity(journal: Journal, identity: Document) -> Document:
    """The event that the journal of a campaign begins with, as it will read when it comes back.

    Args:
        journal: of the folder; one without events is of no campaign yet.
        identity: of the campaign.

    Raises:
        InputDataError: if the journal is that of another campaign, or the identity cannot be
            written.
    """
    for name, part in identity.items():
        try:
            json.dumps(part, allow_nan=False)
        except (ValueError, TypeError) as error:
            raise InputDataError(
                f"Campaign: {name} cannot be written to a journal ({error}); give finite numbers, "
                "text, or dataclasses of them."
            ) from None
    start = {"event": "start"} | json.loads(json.dumps(identity))
    first = journal.events[0] if journal.events else start
    if first["event"] != "start":
        raise InputDataError(
            f"{journal.path}, line 1: event is {first['event']!r}; a campaign begins with 'start'."
        )
    if names := differing_names(first, start):
        raise InputDataError(
            f"{journal.path} is the journal of another campaign: {', '.join(names)} differ. "
            "Resume with the same arguments; if another version of imr_torch began it, tell its "
            "curves to a campaign in a new folder."
        )
    return start


def _restore_infinite(values: Document) -> Document:
    """Inverse of :func:`imr_torch.files.without_nonfinite` for an evidence.

    The one number of it that may be infinite is the shape of its tail.
    """
    return {k: (math.inf if v is None else v) for k, v in values.items()}
