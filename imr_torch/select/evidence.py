"""Model evidence: the probability of the data under a model, with its Monte Carlo error.

``log p(y) = log int p(y | v) p(v) dv`` by importance sampling from the assimilated Gaussian with heavier tails
(multivariate Student t). Nuisances are integrated analytically about their conditional optimum (Laplace). The effective
sample size says how far the Gaussian can be trusted (Kish 1965).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.assimilate import Assimilation, ModelFit
from imr_torch.errors import ConvergenceError
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator

_FREEDOM = 7.0  # degrees of freedom of the proposal


@dataclass(frozen=True)
class Evidence:
    """Log evidence of one model.

    Args:
        model: key of the constitutive model.
        value: ``log p(y)``, nats.
        error: its Monte Carlo standard error, nats.
        effective_samples: Kish effective sample size; near ``samples`` when the Gaussian is right.
        samples: importance samples that could be simulated.
        failed: samples whose solve failed; they count as data of probability 0.
    """

    model: str
    value: float
    error: float
    effective_samples: float
    samples: int
    failed: int

    @property
    def trusted(self) -> bool:
        """Whether at least a tenth of the samples, and 20 of them, effectively count."""
        return self.effective_samples >= max(20.0, 0.1 * self.samples)


def log_evidence(fit: ModelFit, batch: ExperimentBatch, simulator: Simulator, *, seed: int, samples: int = 256) -> Evidence:
    """Evidence of a fitted model by importance sampling.

    Args:
        fit: the model's fit to ``batch``.
        batch: the data.
        simulator: the simulator the fit was made with.
        seed: of the proposal.
        samples: importance samples, one simulation per experiment each.

    Raises:
        ConvergenceError: if no sample could be simulated.
    """
    controls, log_proposal = _propose(fit, samples, child(seed, "evidence", fit.model))
    deviation = controls - fit.mean
    nuisances = fit.nuisances + (fit.nuisance_response @ deviation[:, None, :, None])[..., 0]
    shifts = nuisances * batch.nuisance_sds if bool((batch.nuisance_sds > 0.0).any()) else None
    prediction = torch.where(batch.mask, predict(simulator, fit.parameters(controls), batch, shifts), 0.0)
    likelihood = batch.log_likelihood(prediction).sum(-1)
    likelihood = likelihood - 0.5 * nuisances.square().sum((-2, -1)) - 0.5 * fit.nuisance_log_det
    prior = -0.5 * controls.square().sum(-1) - 0.5 * controls.shape[1] * math.log(2.0 * math.pi)
    weights = likelihood + prior - log_proposal
    return _summarise(fit.model, weights)


def _propose(fit: ModelFit, samples: int, seed: int) -> tuple[Tensor, Tensor]:
    """Student-t draws about the fit (``samples x d``) and their log density."""
    source, size = generator(seed), fit.mean.shape[0]
    normal = torch.randn(samples, size, generator=source, dtype=torch.float64)
    squares = torch.randn(samples, int(_FREEDOM), generator=source, dtype=torch.float64).square().sum(1)
    whitened = normal * (_FREEDOM / squares).sqrt()[:, None]
    half = 0.5 * (_FREEDOM + size)
    constant = math.lgamma(half) - math.lgamma(0.5 * _FREEDOM) - 0.5 * size * math.log(_FREEDOM * math.pi)
    log_density = constant - half * torch.log1p(whitened.square().sum(1) / _FREEDOM)
    return fit.mean + whitened @ fit.chol.mT, log_density - fit.chol.diagonal().log().sum()


def _summarise(model: str, log_weights: Tensor) -> Evidence:
    """Mean of the weights in log space, with the delta-method error."""
    count, failed = log_weights.numel(), int(torch.isinf(log_weights).sum())
    if failed == count:
        raise ConvergenceError(f"{model}: none of {count} evidence samples could be simulated; its fit is not usable.")
    top = log_weights.amax()
    weights = torch.exp(log_weights - top)
    mean = float(weights.mean())
    error = float(weights.std()) / math.sqrt(count) / mean
    effective = float(weights.sum().square() / weights.square().sum())
    return Evidence(model, float(top) + math.log(mean), error, effective, count, failed)


def evidences(assimilation: Assimilation, simulator: Simulator, *, seed: int, samples: int = 256) -> tuple[Evidence, ...]:
    """Evidence of every model of an assimilation; see :func:`log_evidence`."""
    return tuple(log_evidence(fit, assimilation.batch, simulator, seed=seed, samples=samples) for fit in assimilation.fits)
