"""Model selection: evidence with its Monte Carlo error, and probabilities."""

from imr_torch.select.evidence import Evidence, evidences, log_evidence, probability_errors, update
from imr_torch.select.identifiability import Bound, Identifiability, identifiability

__all__ = [
    "Bound",
    "Evidence",
    "Identifiability",
    "evidences",
    "identifiability",
    "log_evidence",
    "probability_errors",
    "update",
]
