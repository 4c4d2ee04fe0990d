"""Model selection: evidence with its Monte Carlo error, probabilities, and predictive scores beside
them.
"""

from imr_torch.select.evidence import Evidence, evidences, log_evidence, probability_errors, update
from imr_torch.select.identifiability import Bound, Identifiability, identifiability
from imr_torch.select.predictive import (
    PredictiveScore,
    cross_validate,
    default_folds,
    sum_over_folds,
)

__all__ = [
    "Bound",
    "Evidence",
    "Identifiability",
    "PredictiveScore",
    "cross_validate",
    "default_folds",
    "evidences",
    "identifiability",
    "log_evidence",
    "probability_errors",
    "sum_over_folds",
    "update",
]
