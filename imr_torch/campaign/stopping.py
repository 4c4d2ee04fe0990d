"""Rules that end a campaign, alone or combined; each gives its reason.

A rule looks at what is believed and what was done, and answers with a reason or with None.
``AnyOf`` and ``AllOf`` combine rules; a rule about the gain of the next experiment gives none while
that gain has not been estimated.

No rule sees an experiment that was forgotten.
"""

from dataclasses import dataclass
from typing import Protocol

from imr_torch.campaign.learners import Finding
from imr_torch.errors import InputDataError, check_at_least, check_fields, is_positive
from imr_torch.material import PARAMETERS, Belief
from imr_torch.observe import Experiment


@dataclass(frozen=True)
class CampaignState:
    """The state of a campaign before its next experiment, as stopping rules see it.

    Args:
        belief: the present belief.
        experiments: those that count as data.
        gain: expected information gain of the experiment that is proposed, nats; None when not
            known.
        finding: of the last diagnosis; None in a campaign that makes none.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import GainBelow, CampaignState
    >>> now = CampaignState(wide_prior(["nhkv"]), experiments=(), gain=0.4)
    >>> GainBelow(0.5).find_reason(now)
    'the expected information gain of the next design is below 0.5 nats'
    """

    belief: Belief
    experiments: tuple[Experiment, ...]
    gain: float | None = None
    finding: Finding | None = None


class StoppingRule(Protocol):
    """Says whether to stop; a frozen dataclass.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import Designs, CampaignState, StoppingRule
    >>> rule: StoppingRule = Designs(3)
    >>> rule.find_reason(CampaignState(wide_prior(["nhkv"]), experiments=())) is None  # go on
    True
    """

    def find_reason(self, state: CampaignState) -> str | None:
        """Why to stop now, or None."""
        ...


@dataclass(frozen=True)
class Designs:
    """Stop after a number of experiments that count as data; those that were forgotten do not.

    Args:
        count: how many.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import Designs, CampaignState
    >>> Designs(3).find_reason(CampaignState(wide_prior(["nhkv"]), experiments=())) is None  # go on
    True
    """

    count: int

    def __post_init__(self) -> None:
        check_at_least(self, 1, "count")

    def find_reason(self, state: CampaignState) -> str | None:
        """See :class:`StoppingRule`."""
        done = len(state.experiments)
        return f"{done} designs were shot" if done >= self.count else None


@dataclass(frozen=True)
class RelativeSd:
    """Stop when every parameter of the most probable model, or one, is known well enough.

    Args:
        below: posterior standard deviation over posterior mean; a parameter of mean 0 is never
            known so well.
        name: the parameter, never known if the model lacks it; every one if None.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import RelativeSd, CampaignState
    >>> RelativeSd(below=0.01).find_reason(CampaignState(wide_prior(["nhkv"]), experiments=())) is None  # the prior is wider
    True
    """

    below: float
    name: str | None = None

    def __post_init__(self) -> None:
        if self.name is not None:
            PARAMETERS[self.name]
        check_fields(self, is_positive, "a positive number, such as 0.01", "below")

    def find_reason(self, state: CampaignState) -> str | None:
        """See :class:`StoppingRule`."""
        best = state.belief.best
        known = (best.sds < self.below * best.means.abs()).tolist()
        reached = dict(zip(best.names, known, strict=True))
        if not (all(known) if self.name is None else reached.get(self.name)):
            return None
        return (
            f"{self.name or 'every parameter'} of {best.material.title} is known within "
            f"{100 * self.below:g} % (one standard deviation)"
        )


@dataclass(frozen=True)
class _Above:
    """A rule about a probability.

    Args:
        above: probability from which on it stops.
    """

    above: float

    def __post_init__(self) -> None:
        expected = "a probability between 0 and 1"
        check_fields(self, lambda value: 0.0 < value < 1.0, expected, "above")


@dataclass(frozen=True)
class ModelProbability(_Above):
    """Stop when one model is probable enough.

    Args:
        above: its posterior probability.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import ModelProbability, CampaignState
    >>> ModelProbability(above=0.95).find_reason(CampaignState(wide_prior(["nhkv"]), experiments=()))
    'NHKV has a probability above 0.95'
    """

    def find_reason(self, state: CampaignState) -> str | None:
        """See :class:`StoppingRule`."""
        best = state.belief.best
        if state.belief.probabilities[best.model] <= self.above:
            return None
        return f"{best.material.title} has a probability above {self.above:g}"


@dataclass(frozen=True)
class CauseProbability(_Above):
    """Stop when one cause of the gap is probable enough: an effect, an unknown one, or that nothing
    is missing.

    Args:
        above: its posterior probability, in a campaign that looks for the cause of a gap.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import CauseProbability, Finding, CampaignState
    >>> found = Finding("effect", ("wall",), {"wall": 0.96, "other": 0.04}, "Adequate.", True, 1e-6)
    >>> CauseProbability(above=0.9).find_reason(CampaignState(wide_prior(["nhkv"]), experiments=(), finding=found))
    'the cause wall has a probability above 0.9'
    """

    def find_reason(self, state: CampaignState) -> str | None:
        """See :class:`StoppingRule`."""
        found = state.finding
        if found is None or found.leader is None or not found.converged:
            return None
        if found.probabilities[found.leader] <= self.above:
            return None
        names = {
            "none": "that nothing is missing from the base model",
            "other": "an effect that is not in the library",
        }
        return (
            f"{names.get(found.leader, f'the cause {found.leader}')} has a probability above "
            f"{self.above:g}"
        )


@dataclass(frozen=True)
class GainBelow:
    """Stop when the expected information gain of the next experiment is small.

    Args:
        nats: least expected information gain worth an experiment.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import GainBelow, CampaignState
    >>> GainBelow(nats=0.5).find_reason(CampaignState(wide_prior(["nhkv"]), experiments=(), gain=0.4))
    'the expected information gain of the next design is below 0.5 nats'
    """

    nats: float

    def __post_init__(self) -> None:
        check_fields(self, is_positive, "a positive number of nats", "nats")

    def find_reason(self, state: CampaignState) -> str | None:
        """See :class:`StoppingRule`."""
        if state.gain is None or state.gain >= self.nats:
            return None
        return (
            f"the expected information gain of the next design is below {self.nats:g} nats"
        )


@dataclass(frozen=True)
class AnyOf:
    """Stop when one of several rules says so.

    Args:
        rules: the rules; the first that has a reason gives it.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import AnyOf, Designs, GainBelow, CampaignState
    >>> rule = AnyOf((Designs(10), GainBelow(0.5)))
    >>> rule.find_reason(CampaignState(wide_prior(["nhkv"]), experiments=(), gain=0.4))
    'the expected information gain of the next design is below 0.5 nats'
    """

    rules: tuple[StoppingRule, ...]

    def find_reason(self, state: CampaignState) -> str | None:
        """See :class:`StoppingRule`."""
        reasons = (rule.find_reason(state) for rule in self.rules)
        return next(filter(None, reasons), None)


@dataclass(frozen=True)
class AllOf:
    """Stop when all of several rules say so.

    Args:
        rules: the rules, at least one.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.campaign import AllOf, Designs, GainBelow, CampaignState
    >>> rule = AllOf((Designs(10), GainBelow(0.5)))
    >>> rule.find_reason(CampaignState(wide_prior(["nhkv"]), experiments=(), gain=0.4)) is None  # ten designs are not shot yet
    True
    """

    rules: tuple[StoppingRule, ...]

    def __post_init__(self) -> None:
        if not self.rules:
            raise InputDataError(
                "AllOf.rules is empty; it would stop at once. Give at least one rule."
            )

    def find_reason(self, state: CampaignState) -> str | None:
        """See :class:`StoppingRule`."""
        reasons = [rule.find_reason(state) for rule in self.rules]
        return None if None in reasons else " and ".join(filter(None, reasons))


RULES = {
    "designs": Designs,
    "sd": RelativeSd,
    "probability": ModelProbability,
    "cause": CauseProbability,
    "gain": GainBelow,
}


def stopping_rule(*texts: str) -> StoppingRule | None:
    """Rules as they are written on the command line: any of ``texts`` ends a campaign, each of
    which may ask for several.

    ``stopping_rule("sd=0.01,probability=0.99", "designs=5")`` stops after five designs, or once
    parameters *and* model are known.
    ``"G:5%,model:.99"`` names parameters and how well they are to be known, or ``model``.

    Returns:
        The rule, or None without texts.

    Raises:
        InputDataError: for a text that is no rule.

    >>> from imr_torch.campaign import stopping_rule
    >>> stopping_rule("sd=0.01,probability=0.99", "designs=5")
    AnyOf(rules=(AllOf(rules=(RelativeSd(below=0.01, name=None), ModelProbability(above=0.99))),
    Designs(count=5)))
    """
    rules = []
    for text in texts:
        first, *others = (_parse_rule(part.strip()) for part in text.split(","))
        rules.append(AllOf((first, *others)) if others else first)
    return AnyOf(tuple(rules)) if len(rules) > 1 else next(iter(rules), None)


def _parse_rule(text: str) -> StoppingRule:
    name, _, values = text.partition("=")
    try:
        if not values:
            name, _, goal = text.partition(":")
            least = float(goal.removesuffix("%")) / (100.0 if goal.endswith("%") else 1.0)
            return ModelProbability(least) if name == "model" else RelativeSd(least, name)
        number = int if name == "designs" else float
        return RULES[name](number(values))
    except InputDataError as error:
        raise InputDataError(f"{text!r} is not a stopping rule: {error}") from None
    except (KeyError, TypeError, ValueError):
        raise InputDataError(
            f"{text!r} is not a stopping rule; expected NAME=NUMBER with NAME of "
            f"{', '.join(RULES)}, PARAMETER:PERCENT as G:5%, or model:.99."
        ) from None
