"""Campaigns: sequences of choosing a design, measuring and inference, recorded in a journal."""

from imr_torch.campaign.forecast import ShotForecast, camera_variants, forecast_shots
from imr_torch.campaign.history import CampaignSettings, Step
from imr_torch.campaign.journal import Journal
from imr_torch.campaign.learners import (
    ExactLearner,
    Finding,
    Inference,
    Learner,
    Observations,
)
from imr_torch.campaign.loop import Campaign
from imr_torch.campaign.policies import (
    DesignPolicy,
    Optimal,
    Proposal,
    Random,
    Situation,
    SpaceFilling,
)
from imr_torch.campaign.stopping import (
    AllOf,
    AnyOf,
    CampaignState,
    CauseProbability,
    Designs,
    GainBelow,
    ModelProbability,
    RelativeSd,
    StoppingRule,
    stopping_rule,
)

__all__ = [
    "AllOf",
    "AnyOf",
    "Campaign",
    "CampaignSettings",
    "CampaignState",
    "CauseProbability",
    "DesignPolicy",
    "Designs",
    "ExactLearner",
    "Finding",
    "GainBelow",
    "Inference",
    "Journal",
    "Learner",
    "ModelProbability",
    "Observations",
    "Optimal",
    "Proposal",
    "Random",
    "RelativeSd",
    "ShotForecast",
    "Situation",
    "SpaceFilling",
    "Step",
    "StoppingRule",
    "camera_variants",
    "forecast_shots",
    "stopping_rule",
]
