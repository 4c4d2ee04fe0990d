"""Stage 7, do it again: ask, experiment, assimilate, select, and the journal that remembers all of it."""

from imr_torch.campaign.journal import Journal
from imr_torch.campaign.loop import Campaign, CampaignSettings, Proposal, Step

__all__ = ["Campaign", "CampaignSettings", "Journal", "Proposal", "Step"]
