"""Model selection, and what the data say of each parameter.

Evidence is the probability of the data under a model, and the probabilities of models follow by
Bayes' rule, prior times evidence, both with their Monte Carlo error.
``log p(y) = log int p(y | v, w) p(v) p(w) dv dw`` over the gel and the nuisances is from the draws
that :func:`imr_torch.assimilate.weigh` has weighted by the exact posterior; the same draws give
moments and verdict.

A parameter is bounded by the data on both sides, on one, or not at all. Its marginal likelihood is
its posterior over its prior. Between Gaussians of the coordinate in which the prior is a standard
normal it is a Gaussian too, so how far it falls towards either end of the prior follows from two
moments (Raue et al., Bioinformatics 25, 2009, call a profile that does not fall a practical
non-identifiability).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import torch

from imr_torch.assimilate import Assimilation, ModelFit, Verdict
from imr_torch.errors import InputDataError
from imr_torch.float64 import eye, tensor
from imr_torch.material import PARAMETERS, Belief, ModelBelief, Parameter

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

FALL = 1.920729
"""Nats that the likelihood falls at the end of a 95 % interval: half the 95 % quantile of chi-square
with one degree of freedom."""


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
    error = sample.log_evidence_error
    if fit.verdict is Verdict.REFUSED:
        # The moments found are not those that the proposal was made for, so draws may lack a part of
        # the posterior, which their weights do not show: the divergence between the two is added,
        # 100 nats for one that cannot be computed.
        missed = sample.surprise if math.isfinite(sample.surprise) else 100.0
        error = math.hypot(sample.doubtful_error, max(missed, 0.0))
    return Evidence(
        fit.model,
        sample.log_evidence,
        error,
        sample.effective_samples,
        len(sample),
        sample.failed,
        sample.pareto_k,
    )


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
    # a probability cannot be farther off
    errors = errors.minimum(after.maximum(1.0 - after))
    return dict(zip(prior.keys, errors.tolist(), strict=True))


def _check_models(prior: Belief, evidence: Sequence[Evidence]) -> None:
    if tuple(e.model for e in evidence) != prior.keys:
        raise InputDataError(
            f"Evidence of {[e.model for e in evidence]} does not match the belief over "
            f"{list(prior.keys)}."
        )


class Bound(Enum):
    """What the data bound.

    >>> from imr_torch.select import Bound
    >>> Bound.ABOVE.value
    'only bounded from above'
    """

    BOTH = "bounded by the data on both sides"
    ABOVE = "only bounded from above"
    BELOW = "only bounded from below"
    NEITHER = "not determined: the interval is that of the prior"


@dataclass(frozen=True)
class Identifiability:
    """How far the data determine a parameter.

    Args:
        parameter: which.
        bound: on which sides.
        limit: the one-sided 95 % limit, SI; None where both sides are bounded, or neither.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.select import identifiability
    >>> prior = wide_prior(["nhkv"])["nhkv"]
    >>> [found.bound.name for found in identifiability(prior, prior)]  # nothing was learnt
    ['NEITHER', 'NEITHER']
    """

    parameter: Parameter
    bound: Bound
    limit: float | None

    @property
    def words(self) -> str:
        """A phrase such as ``"only bounded from above: below 0.07 (95 %); ..."``."""
        if self.limit is None:
            return self.bound.value
        value = (
            f"{self.parameter.display_scale * self.limit:.3g} {self.parameter.shown_unit}"
        )
        side = "below" if self.bound is Bound.ABOVE else "above"
        return f"{self.bound.value}: {side} {value.rstrip()} (95 %); the other end is the prior's"


def identifiability(
    prior: ModelBelief, posterior: ModelBelief, *, end: float = 2.5
) -> tuple[Identifiability, ...]:
    """What data say of each free parameter of a model.

    Args:
        prior: the model's belief before them.
        posterior: its belief after them.
        end: prior standard deviations from the prior median to the ends of what was thought
            possible.

    >>> import torch
    >>> from imr_torch import wide_prior
    >>> from imr_torch.select import identifiability
    >>> prior = wide_prior(["nhkv"])["nhkv"]
    >>> mean, sds = torch.tensor([-1.6, 0.1]).double(), torch.tensor([0.6, 0.05]).double()  # G is small, mu is known
    >>> for found in identifiability(prior, prior.with_gaussian(mean, torch.diag(sds))):
    ...     print(found.parameter.name, found.words)
    G only bounded from above: below 1.86 kPa (95 %); the other end is the prior's
    mu bounded by the data on both sides
    """
    before, after = (part.chol @ part.chol.mT for part in (prior, posterior))
    sds = before.diagonal().sqrt()
    mean = (posterior.mean - prior.mean) / sds
    variance = after.diagonal() / sds.square()
    precision = (1.0 / variance - 1.0).clamp_min(0.0)  # of the likelihood
    centre = torch.where(
        precision > 0.0, mean / (variance * precision.clamp_min(1e-300)), 0.0
    )
    inside = centre.clamp(-end, end)  # where the likelihood is largest within the prior
    largest = 0.5 * precision * (inside - centre).square()
    falls = [
        0.5 * precision * (side - centre).square() - largest > FALL for side in (-end, end)
    ]
    kinds = {
        (True, True): Bound.BOTH,
        (True, False): Bound.BELOW,
        (False, True): Bound.ABOVE,
        (False, False): Bound.NEITHER,
    }
    falls = torch.stack(falls, 1).tolist()
    limits = posterior.quantile([0.05, 0.95]).T.tolist()
    found = []
    for name, sides, (least, most) in zip(prior.names, falls, limits, strict=True):
        bound = kinds[tuple(sides)]
        limit = {Bound.BELOW: least, Bound.ABOVE: most}.get(bound)
        found.append(Identifiability(PARAMETERS[name], bound, limit))
    return tuple(found)
