"""How a campaign chooses, learns and ends, and how that is written down in its journal."""

from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from torch import Tensor

from imr_torch.campaign.learners import ExactLearner, Learner
from imr_torch.campaign.policies import DesignPolicy, Optimal
from imr_torch.campaign.stopping import StoppingRule
from imr_torch.design import DesignSpace, Plan


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

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready values, with the kind of every part."""
        return _describe_part(self)


def _describe_part(value: Any) -> Any:
    """A dataclass and what it is made of as JSON-ready values.

    Fields that make no two of them differ are left out.
    """
    if is_dataclass(value):
        own = {f.name: _describe_part(getattr(value, f.name)) for f in fields(value) if f.compare}
        return {"kind": type(value).__name__} | own
    if isinstance(value, tuple):
        return [_describe_part(part) for part in value]
    return value.tolist() if isinstance(value, Tensor) else value
