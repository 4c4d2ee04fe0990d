"""Stage 6, what to shoot next: the information that an experiment is expected to give, and its maximum over designs."""

from imr_torch.design.acquisition import ExpectedInformationGain
from imr_torch.design.eig import InformationGain, Plan, expected_information_gain
from imr_torch.design.optimizer import DesignOptimizer, DesignSearch, Recommendation, search_design, tell_gain
from imr_torch.design.space import DESIGN_NAMES, DesignSpace

__all__ = [
    "DESIGN_NAMES",
    "DesignOptimizer",
    "DesignSearch",
    "DesignSpace",
    "ExpectedInformationGain",
    "InformationGain",
    "Plan",
    "Recommendation",
    "expected_information_gain",
    "search_design",
    "tell_gain",
]
