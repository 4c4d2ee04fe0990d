"""Model evidence, the probability of the data under a model, and the probabilities of models by
Bayes' rule, prior times evidence, both with their Monte Carlo error.

``log p(y) = log int p(y | v, w) p(v) p(w) dv dw`` over the gel and the nuisances, from the draws
that :func:`imr_torch.assimilate.weigh` has weighted by the exact posterior; the same draws give
moments and verdict.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from imr_torch.assimilate import Assimilation, ImportanceSample, ModelFit, Verdict
from imr_torch.errors import InputDataError
from imr_torch.float64 import eye, tensor
from imr_torch.material import Belief


@dataclass(frozen=True)
class Evidence:
    """Log evidence of one model.

    Args:
        model: key of the constitutive model.
        value: ``log p(y)``, nats.
        error: its Monte Carlo standard error, nats.
        effective_samples: Kish effective sample size; near ``samples`` when the proposal is the
            posterior.
        samples: importance samples.
        failed: samples whose solve failed; they count as data of probability 0.
        pareto_k: shape of the tail of the weights.

    >>> from imr_torch.select import Evidence
    >>> evidence = Evidence("nhkv", value=120.3, error=0.05, effective_samples=180.0, samples=256, failed=0, pareto_k=0.2)
    >>> evidence.value
    120.3
    """

    model: str
    value: float
    error: float
    effective_samples: float
    samples: int
    failed: int
    pareto_k: float


def log_evidence(fit: ModelFit) -> Evidence:
    """Evidence of a fitted model.

    Args:
        fit: a fit whose draws have been weighted.

    Raises:
        InputDataError: if they have not.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions, assimilate, weigh
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> from imr_torch.select import log_evidence
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> options = SearchOptions(raw_samples=16, starts=2)
    >>> fits = assimilate(case.prior, ExperimentBatch((shot,)), simulator, seed=0, options=options)
    >>> weighted = weigh(fits, simulator, seed=0, samples=64)
    >>> log_evidence(weighted["nhkv"]).model, log_evidence(weighted["nhkv"]).pareto_k < 0.5
    ('nhkv', True)
    """
    sample = fit.sample
    if sample is None:
        raise InputDataError(
            f"The fit of {fit.model!r} has no weighted draws; pass its assimilation through "
            "`weigh` first."
        )
    return Evidence(
        fit.model,
        sample.log_evidence,
        _standard_error(fit, sample),
        sample.effective_samples,
        len(sample),
        sample.failed,
        sample.pareto_k,
    )


def _standard_error(fit: ModelFit, sample: ImportanceSample) -> float:
    """Standard error of a log evidence, nats.

    Where the moments found are not those that the proposal was made for, draws may lack a part of
    the posterior, and their weights do not show it: the divergence between the two is added.
    """
    if fit.verdict is not Verdict.REFUSED:
        return sample.log_evidence_error
    # 100 nats for a divergence that cannot be computed
    missed = sample.surprise if math.isfinite(sample.surprise) else 100.0
    return math.hypot(sample.doubtful_error, max(missed, 0.0))


def evidences(assimilation: Assimilation) -> tuple[Evidence, ...]:
    """Evidence of every model of a weighted assimilation; see :func:`log_evidence`.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions, assimilate, weigh
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> from imr_torch.select import evidences
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> options = SearchOptions(raw_samples=16, starts=2)
    >>> fits = assimilate(case.prior, ExperimentBatch((shot,)), simulator, seed=0, options=options)
    >>> nhkv, gen_qkv = evidences(weigh(fits, simulator, seed=0, samples=64))
    >>> nhkv.value > gen_qkv.value  # the data are of NHKV
    True
    """
    return tuple(log_evidence(fit) for fit in assimilation.fits)


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
    logs = assimilation.prior.log_probabilities + tensor([e.value for e in evidence])
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
    values = tensor([(e.value, e.error) for e in evidence])
    after = torch.softmax(prior.log_probabilities + values[:, 0], dim=0)
    slopes = after[:, None] * (eye(len(after)) - after)
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
