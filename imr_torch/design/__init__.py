"""Stage 6, what to shoot next: the information that an experiment is expected to give, and its maximum over designs."""

from imr_torch.design.acquisition import ExpectedInformationGain
from imr_torch.design.closed_form import linear_gaussian_gain
from imr_torch.design.eig import Bracket, expected_information_gain, gains_of_each, information_bracket
from imr_torch.design.gain import Estimator, InformationGain, Method
from imr_torch.design.optimizer import (
    POLICIES,
    Cost,
    DesignOptimizer,
    DesignSearch,
    Policy,
    Recommendation,
    search_design,
    tell_gain,
)
from imr_torch.design.plan import PAPER_PLAN, Plan
from imr_torch.design.space import DESIGN_NAMES, DesignSpace

__all__ = [
    "DESIGN_NAMES",
    "PAPER_PLAN",
    "POLICIES",
    "Bracket",
    "Cost",
    "DesignOptimizer",
    "DesignSearch",
    "DesignSpace",
    "Estimator",
    "ExpectedInformationGain",
    "InformationGain",
    "Method",
    "Plan",
    "Policy",
    "Recommendation",
    "expected_information_gain",
    "gains_of_each",
    "information_bracket",
    "linear_gaussian_gain",
    "search_design",
    "tell_gain",
]
