"""Evidence of the leading effects by importance sampling.

The evidence of every effect is that of the Gaussian approximation. Those of the leading effects,
where they are near each other, are computed again by importance sampling
(:mod:`imr_torch.assimilate.weighing`).
"""

from collections.abc import Mapping
from dataclasses import dataclass

from imr_torch.assimilate import Assimilation, ModelFit, WeighingOptions, weigh
from imr_torch.errors import ConvergenceError
from imr_torch.material.belief import even_belief
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator

NEAR = 5.0
"""Nats behind the best up to which an evidence is computed again."""

_MOST = 4  # hypotheses whose evidence is computed again
_SAMPLES = 48
_HEAVY, _UNCERTAIN = (
    0.7,
    0.5,
)  # tail of the weights, and standard error in nats, from which on an evidence is not used


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
    ranked = sorted(evidence, key=lambda name: -evidence[name])[:_MOST]
    near = [name for name in ranked if evidence[name] > evidence[ranked[0]] - NEAR]
    if len(near) < 2:
        return {}
    own = tuple(fits[name] for name in near)
    try:
        weighted = weigh(
            Assimilation(even_belief(fit.prior for fit in own), batch, own),
            simulator,
            seed=seed,
            samples=_SAMPLES,
            rounds=1,
            options=WeighingOptions(refits=0),
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
