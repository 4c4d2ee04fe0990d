"""What to shoot next: the information that an experiment is expected to give, and its maximum over
designs.
"""

from imr_torch.design.acquisition import ExpectedInformationGain, expected_information_gain
from imr_torch.design.gain import (
    ErrorParts,
    InformationEstimator,
    InformationGain,
    Target,
    separate_errors,
)
from imr_torch.design.laplace import Laplace
from imr_torch.design.next_design import NextDesign
from imr_torch.design.optimizer import DesignOptimizer, Recommendation
from imr_torch.design.response import Plan, Shot, radii
from imr_torch.design.search import DesignSearch, search_design
from imr_torch.design.sequence import choose_sequence, inform_draws
from imr_torch.design.space import (
    DESIGN_NAMES,
    DesignSpace,
    ListedDesigns,
    design_document,
    load_designs,
)

__all__ = [
    "DESIGN_NAMES",
    "DesignOptimizer",
    "DesignSearch",
    "DesignSpace",
    "ErrorParts",
    "ExpectedInformationGain",
    "InformationEstimator",
    "InformationGain",
    "Laplace",
    "ListedDesigns",
    "NextDesign",
    "Plan",
    "Recommendation",
    "Shot",
    "Target",
    "choose_sequence",
    "design_document",
    "expected_information_gain",
    "inform_draws",
    "load_designs",
    "radii",
    "search_design",
    "separate_errors",
]
