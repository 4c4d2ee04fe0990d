"""The maximum mean discrepancy of the data to the prior predictive, the score by which sbi tells
misspecified simulators.

Schmitt et al. (Detecting model misspecification in amortized Bayesian inference, GCPR 2023): the
    squared discrepancy between
observed data sets and simulated ones, with its null distribution from simulated ones in the place
of the observed. Kernel: Gaussian, of the median distance (Gretton et al., J. Mach. Learn. Res. 13,
2012, Eq. 3 for the unbiased estimate).
"""

import torch
from torch import Tensor

from imr_torch.material import ModelBelief
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator

_SIMULATIONS = 500
_SHUFFLES = 400


def mmd_p_value(
    observed: Tensor, simulated: Tensor, *, seed: int, shuffles: int = _SHUFFLES
) -> float:
    """How often simulated sets lie as far from the others as the observed ones.

    Args:
        observed: ``n x m`` tensor, one data set a row.
        simulated: ``N x m`` tensor, of the model's prior predictive.
        seed: of the shuffles.
        shuffles: how many sets of ``n`` simulated rows take the place of the observed.
    """
    source = generator(seed)
    rows = torch.cat((observed, simulated))
    distance = torch.cdist(rows, rows).square()
    own = distance[len(observed) :, len(observed) :]
    kernel = torch.exp(-distance / own[own > 0.0].median())
    n = len(observed)
    count = len(rows)
    found = _mmd(kernel, torch.arange(n), torch.arange(n, count))
    null = []
    for _ in range(shuffles):
        order = n + torch.randperm(count - n, generator=source)
        null.append(_mmd(kernel, order[:n], order[n:]))
    return (1.0 + sum(value >= found for value in null)) / (1.0 + shuffles)


def _mmd(kernel: Tensor, first: Tensor, second: Tensor) -> float:
    """Unbiased square of the discrepancy between two sets of rows.

    Without the first term where the first set is one row.
    """
    across = float(kernel[first][:, second].mean())
    return _within(kernel, first) + _within(kernel, second) - 2.0 * across


def _within(kernel: Tensor, rows: Tensor) -> float:
    part = kernel[rows][:, rows]
    n = len(rows)
    return float((part.sum() - part.diagonal().sum()) / (n * (n - 1))) if n > 1 else 0.0


def prior_predictive_mmd(
    prior: ModelBelief,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    simulations: int = _SIMULATIONS,
) -> float:
    """:func:`mmd_p_value` of the mean curves of a batch, all designs side by side, in units of the
    spread of each frame.

    Args:
        prior: of the base model.
        batch: the data.
        simulator: makes the bubbles.
        seed: of gels, nuisances, noise and shuffles.
        simulations: data sets of the prior predictive; those that fail are left out.
    """
    source = generator(child(seed, "mmd"))
    gels = prior.parameters(
        torch.randn(simulations, len(prior.names), generator=source, dtype=torch.float64)
    )
    shifts = torch.stack([shot.nuisance.sds() for shot in batch.experiments])
    drawn = shifts * torch.randn(simulations, *shifts.shape, generator=source, dtype=torch.float64)
    seen = predict(simulator, gels, batch, drawn)
    noise = torch.randn(seen.shape, generator=source, dtype=torch.float64)
    seen = seen + batch.sd(seen) / batch.counts.clamp(min=1.0).sqrt() * noise
    rows = seen[:, batch.mask]
    observed = batch.mean[batch.mask]
    rows = rows[torch.isfinite(rows).all(1)]
    spread = rows.std(0).clamp(min=1e-6)
    return mmd_p_value((observed / spread)[None], rows / spread, seed=child(seed, "shuffles"))
