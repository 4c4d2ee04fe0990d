"""How far the evidence of effects can be relied on: by importance sampling, and under other prior
scales.

The evidence of every effect is that of the Gaussian approximation. Those of the leading effects,
where they are near each other, are computed again by importance sampling
(:mod:`imr_torch.assimilate.weighing`). A prior of another scale changes the evidence by the mean
over the posterior of the ratio of the two prior densities.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imr_torch.assimilate import Assimilation, ModelFit, weigh
from imr_torch.errors import ConvergenceError
from imr_torch.material import Belief, Effect, Marginal, TruncatedNormal
from imr_torch.observe import ExperimentBatch
from imr_torch.random import generator
from imr_torch.simulate import Simulator

NEAR = 5.0
"""Nats behind the best up to which an evidence is computed again."""

_MOST = 4  # hypotheses whose evidence is computed again
_SAMPLES = 48
_HEAVY, _UNCERTAIN = (
    0.7,
    0.5,
)  # tail of the weights, and standard error in nats, from which on an evidence is not used
_DRAWS = 512


@dataclass(frozen=True)
class CheckedEvidence:
    """An evidence by importance sampling.

    Args:
        laplace: of the Gaussian approximation, nats.
        sampled: by importance sampling, nats, on the same scale.
        error: its Monte Carlo standard error.
        reliable: whether the weights allow to use it; else the Gaussian one is kept.
    """

    laplace: float
    sampled: float
    error: float
    reliable: bool


def check_evidence(
    fits: Mapping[str, ModelFit],
    evidence: Mapping[str, float],
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
) -> dict[str, CheckedEvidence]:
    """Evidence of the leading hypotheses by importance sampling.

    Args:
        fits: hypothesis -> fit.
        evidence: hypothesis -> nats, by the Gaussian approximation.
        batch: the data.
        simulator: makes the bubbles.
        seed: of the draws.

    Returns:
        Hypothesis -> evidence of all within ``NEAR`` nats of the best (four at most); empty where
        the best is alone, or where no draw of one of them could be simulated.
    """
    best = max(evidence.values())
    near = sorted(
        (name for name in evidence if evidence[name] > best - NEAR),
        key=lambda name: -evidence[name],
    )[:_MOST]
    if len(near) < 2:
        return {}
    own = tuple(fits[name] for name in near)
    belief = Belief(tuple(fit.prior for fit in own), torch.zeros(len(own), dtype=torch.float64))
    try:
        weighted = weigh(
            Assimilation(belief, batch, own),
            simulator,
            seed=seed,
            samples=_SAMPLES,
            rounds=1,
            refit=False,
        )
    except ConvergenceError:
        return {}
    found = {}
    for name, fit in zip(near, weighted.fits, strict=True):
        assert fit.sample is not None
        error = fit.sample.log_evidence_error
        found[name] = CheckedEvidence(
            evidence[name],
            fit.sample.log_evidence,
            error,
            fit.sample.pareto_k < _HEAVY and error < _UNCERTAIN,
        )
    return found


def rescaled_evidence(fit: ModelFit, effect: Effect, factor: float, *, seed: int = 0) -> float:
    """Change of the evidence, nats, when the prior scale of an effect's amplitude is multiplied by
    a factor.

    Args:
        fit: of a hypothesis with the effect.
        effect: the effect; 0 is returned for an amplitude whose prior is no truncated normal.
        factor: on the prior's standard deviation.
        seed: of the posterior draws.
    """
    name = effect.names[0]
    before = effect.priors[name]
    if not isinstance(before, TruncatedNormal):
        return 0.0
    place = fit.prior.names.index(name)
    noise = torch.randn(_DRAWS, len(fit.mean), generator=generator(seed), dtype=torch.float64)
    amplitude = before.to_physical((fit.mean + noise @ fit.chol.mT)[:, place])
    after = replace(before, sd=factor * before.sd)
    ratio = _log_density(after, amplitude) - _log_density(before, amplitude)
    return float(torch.logsumexp(ratio, 0) - torch.tensor(float(_DRAWS)).log())


def _log_density(prior: Marginal, value: Tensor) -> Tensor:
    """Log density of a physical value, but for a constant that is the same for every prior."""
    z = prior.to_control(value)
    return -0.5 * z.square() - prior.log_slope(z)
