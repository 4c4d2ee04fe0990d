"""The joint cost of gel and nuisances: its value, and its Gauss-Newton linearisation from a neighbourhood of a point.

A neighbourhood is one bundle of bubbles: the point, members with moved controls, and one with each uncertain nuisance moved.
Costs are negative log of likelihood x prior, without the constants of the priors, nats.
"""

import torch
from torch import Tensor

from imr_torch.assimilate.gauss_newton import NormalEquations, ensemble_sensitivity, normal_equations
from imr_torch.observe import ExperimentBatch

SIDE = 1e-6  # prior standard deviations by which nuisances are moved for their sensitivity; posterior ones may be 50 x less


def joint_cost(batch: ExperimentBatch, gel: Tensor, nuisances: Tensor, prediction: Tensor) -> Tensor:
    """``...`` tensor from controls ``... x d``, nuisances ``... x E x 3`` and predictions ``... x E x T``."""
    likelihood = batch.log_likelihood(prediction).sum(-1)
    return 0.5 * gel.square().sum(-1) + 0.5 * nuisances.square().sum((-2, -1)) - likelihood


def likelihood_slope(batch: ExperimentBatch, prediction: Tensor) -> Tensor:
    """Gradient of the negative log likelihood over predictions ``... x E x T``."""
    with torch.enable_grad():
        point = prediction.detach().requires_grad_()
        (slope,) = torch.autograd.grad(-batch.log_likelihood(point).sum(), point)
    return slope


def uncertain(batch: ExperimentBatch) -> Tensor:
    """Columns of nuisances that are uncertain in any experiment."""
    return torch.nonzero((batch.nuisance_sds > 0.0).any(0))[:, 0]


def sides(batch: ExperimentBatch) -> Tensor:
    """``S x 1 x 3`` tensor, what is added to the nuisances of all experiments for the sensitivity to each uncertain one."""
    columns = uncertain(batch)
    moved = torch.zeros(len(columns), 1, 3, dtype=torch.float64)
    moved[torch.arange(len(columns)), 0, columns] = SIDE
    return moved


def equations_at(
    batch: ExperimentBatch, gel: Tensor, nuisances: Tensor, anomalies: Tensor, prediction: Tensor
) -> NormalEquations:
    """Normal equations at a point.

    Args:
        batch: the data.
        gel: ``... x d`` tensor, controls.
        nuisances: ``... x E x 3`` tensor.
        anomalies: ``... x N x d`` tensor, members' controls less the point's.
        prediction: ``... x (1 + N + S) x E x T`` tensor: of the point, the members and the moved nuisances (:func:`sides`).
    """
    count = anomalies.shape[-2]
    centre, members, moved = prediction.split([1, count, prediction.shape[-3] - count - 1], dim=-3)
    centre = centre.squeeze(-3)
    responses = (members - centre.unsqueeze(-3)).transpose(-3, -2)  # ... x E x N x T
    by_gel = ensemble_sensitivity(anomalies.unsqueeze(-3), responses)
    by_nuisance = torch.zeros(*centre.shape, 3, dtype=torch.float64)
    by_nuisance[..., uncertain(batch)] = ((moved - centre.unsqueeze(-3)) / SIDE).nan_to_num().movedim(-3, -1)
    slope = likelihood_slope(batch, centre)[..., None]
    gradients = (by_gel.mT @ slope)[..., 0].sum(-2), (by_nuisance.mT @ slope)[..., 0]
    sd = batch.sd(centre)
    whitened = [batch.whiten(x.movedim(-1, 0), sd[None]).movedim(0, -1) for x in (by_gel, by_nuisance)]
    return normal_equations(gel, nuisances, gradients, (whitened[0], whitened[1]))
