"""Model evidence: the probability of the data under a model, with its Monte Carlo error.

``log p(y) = log int p(y | v, w) p(v) p(w) dv dw`` over the gel and the nuisances, from the draws that
:func:`imr_torch.assimilate.weigh` has weighed by the exact posterior; the same draws give moments and verdict.
"""

from dataclasses import dataclass

from imr_torch.assimilate import Assimilation, ModelFit
from imr_torch.assimilate.importance import reliable
from imr_torch.errors import InputDataError


@dataclass(frozen=True)
class Evidence:
    """Log evidence of one model.

    Args:
        model: key of the constitutive model.
        value: ``log p(y)``, nats.
        error: its Monte Carlo standard error, nats.
        effective_samples: Kish effective sample size; near ``samples`` when the proposal is the posterior.
        samples: importance samples.
        failed: samples whose solve failed; they count as data of probability 0.
        pareto_k: shape of the tail of the weights.
    """

    model: str
    value: float
    error: float
    effective_samples: float
    samples: int
    failed: int
    pareto_k: float

    @property
    def trusted(self) -> bool:
        """Whether value and error can be leant on."""
        return reliable(self.pareto_k, self.effective_samples, self.samples)


def log_evidence(fit: ModelFit) -> Evidence:
    """Evidence of a fitted model.

    Args:
        fit: a fit whose draws have been weighed.

    Raises:
        InputDataError: if they have not.
    """
    sample = fit.sample
    if sample is None:
        raise InputDataError(f"The fit of {fit.model!r} has no weighed draws; pass its assimilation through `weigh` first.")
    return Evidence(
        fit.model,
        sample.log_evidence,
        sample.log_evidence_error,
        sample.effective_samples,
        len(sample),
        sample.failed,
        sample.pareto_k,
    )


def evidences(assimilation: Assimilation) -> tuple[Evidence, ...]:
    """Evidence of every model of a weighed assimilation; see :func:`log_evidence`."""
    return tuple(log_evidence(fit) for fit in assimilation.fits)
