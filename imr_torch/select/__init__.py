"""Stage 5, which model: evidence with its Monte Carlo error, and probabilities."""

from imr_torch.select.evidence import Evidence, evidences, log_evidence
from imr_torch.select.probabilities import update

__all__ = ["Evidence", "evidences", "log_evidence", "update"]
