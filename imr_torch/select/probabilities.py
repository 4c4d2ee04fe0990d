"""Bayes' rule over models: prior odds times evidence, once, with what the Monte Carlo error of the evidence leaves open."""

from collections.abc import Sequence

import torch

from imr_torch.assimilate import Assimilation
from imr_torch.errors import InputDataError
from imr_torch.material import Belief
from imr_torch.select.evidence import Evidence


def update(assimilation: Assimilation, evidence: Sequence[Evidence]) -> Belief:
    """The belief after the data: each model's posterior, and its prior probability times its evidence.

    Args:
        assimilation: the fits, which carry the prior belief.
        evidence: one per model, in the same order.

    Raises:
        InputDataError: if models and evidences do not match.
    """
    _check(assimilation.prior, evidence)
    logs = assimilation.prior.log_probabilities + torch.tensor([e.value for e in evidence], dtype=torch.float64)
    return Belief(tuple(fit.posterior for fit in assimilation.fits), logs)


def probability_errors(prior: Belief, evidence: Sequence[Evidence]) -> dict[str, float]:
    """Monte Carlo standard error of each model's posterior probability, by the delta method.

    With ``P = softmax(log prior + log evidence)``, ``dP_i = P_i sum_j (1[i = j] - P_j) d log Z_j``. It is the error of this
    computation, not the uncertainty about the model, which the probability itself states.

    Args:
        prior: belief before the data.
        evidence: one per model, in the same order.

    Returns:
        Model key -> standard error.

    Raises:
        InputDataError: if models and evidences do not match.
    """
    _check(prior, evidence)
    values = torch.tensor([(e.value, e.error) for e in evidence], dtype=torch.float64)
    after = torch.softmax(prior.log_probabilities + values[:, 0], dim=0)
    slopes = after[:, None] * (torch.eye(len(after), dtype=torch.float64) - after)
    errors = (slopes.square() @ values[:, 1].square()).sqrt()
    return dict(zip(prior.keys, errors.tolist(), strict=True))


def _check(prior: Belief, evidence: Sequence[Evidence]) -> None:
    if tuple(e.model for e in evidence) != prior.keys:
        raise InputDataError(f"Evidence of {[e.model for e in evidence]} does not match the belief over {list(prior.keys)}.")
