"""Model probabilities by Bayes' rule, prior times evidence, with their Monte Carlo error."""

from collections.abc import Sequence

import torch

from imr_torch.assimilate import Assimilation
from imr_torch.errors import InputDataError
from imr_torch.material import Belief
from imr_torch.select.evidence import Evidence


def update(assimilation: Assimilation, evidence: Sequence[Evidence]) -> Belief:
    """The belief after the data: each model's posterior, and its prior probability times its
    evidence.

    Args:
        assimilation: the fits, which carry the prior belief.
        evidence: one per model, in the same order.

    Raises:
        InputDataError: if models and evidences do not match.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions, assimilate, weigh
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> from imr_torch.select import evidences, update
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> options = SearchOptions(raw_samples=16, starts=2)
    >>> fits = assimilate(case.prior, ExperimentBatch((shot,)), simulator, seed=0, options=options)
    >>> weighted = weigh(fits, simulator, seed=0, samples=64)
    >>> update(weighted, evidences(weighted)).best.model
    'nhkv'
    """
    _check_models(assimilation.prior, evidence)
    logs = assimilation.prior.log_probabilities + torch.tensor(
        [e.value for e in evidence], dtype=torch.float64
    )
    return Belief(tuple(fit.posterior for fit in assimilation.fits), logs)


def probability_errors(prior: Belief, evidence: Sequence[Evidence]) -> dict[str, float]:
    """Monte Carlo standard error of each model's posterior probability, by the delta method.

    With ``P = softmax(log prior + log evidence)``, ``dP_i = P_i sum_j (1[i = j] - P_j) d log Z_j``.
    It is the error of this computation, not the uncertainty about the model, which the probability
    itself states.

    Args:
        prior: belief before the data.
        evidence: one per model, in the same order.

    Returns:
        Model key -> standard error.

    Raises:
        InputDataError: if models and evidences do not match.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.select import Evidence, probability_errors
    >>> prior = wide_prior(["newtonian", "nhkv"])
    >>> first = Evidence("newtonian", 10.0, 0.1, 200.0, 256, 0, 0.1)
    >>> second = Evidence("nhkv", 11.0, 0.1, 200.0, 256, 0, 0.1)
    >>> {model: round(error, 3) for model, error in probability_errors(prior, [first, second]).items()}
    {'newtonian': 0.028, 'nhkv': 0.028}
    """
    _check_models(prior, evidence)
    values = torch.tensor([(e.value, e.error) for e in evidence], dtype=torch.float64)
    after = torch.softmax(prior.log_probabilities + values[:, 0], dim=0)
    slopes = after[:, None] * (torch.eye(len(after), dtype=torch.float64) - after)
    errors = (slopes.square() @ values[:, 1].square()).sqrt()
    errors = errors.minimum(
        torch.maximum(after, 1.0 - after)
    )  # a probability cannot be farther off
    return dict(zip(prior.keys, errors.tolist(), strict=True))


def _check_models(prior: Belief, evidence: Sequence[Evidence]) -> None:
    if tuple(e.model for e in evidence) != prior.keys:
        raise InputDataError(
            f"Evidence of {[e.model for e in evidence]} does not match the belief over "
            f"{list(prior.keys)}."
        )
