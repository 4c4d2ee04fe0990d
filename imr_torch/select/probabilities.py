"""Bayes' rule over models: prior odds times evidence, once."""

from collections.abc import Sequence

import torch

from imr_torch.assimilate import Assimilation
from imr_torch.errors import InputDataError
from imr_torch.material import Belief
from imr_torch.select.evidence import Evidence


def update(assimilation: Assimilation, evidence: Sequence[Evidence]) -> Belief:
    """The belief after the data: each model's posterior Gaussian, and its prior probability times its evidence.

    Args:
        assimilation: the fits, which carry the prior belief.
        evidence: one per model, in the same order.

    Raises:
        InputDataError: if models and evidences do not match.
    """
    if tuple(e.model for e in evidence) != assimilation.prior.keys:
        raise InputDataError(
            f"Evidence of {[e.model for e in evidence]} does not match the belief over {list(assimilation.prior.keys)}."
        )
    logs = assimilation.prior.log_probabilities + torch.tensor([e.value for e in evidence], dtype=torch.float64)
    return Belief(tuple(fit.posterior for fit in assimilation.fits), logs)
