"""Deeper valleys of the nuisances of single experiments, at the gel where a search ended.

A frame next to a collapse gives the cost a valley for either side of it: in time zero, with Rmax and R_inf to match. Starts of
a search differ in the gel and not in these, so all of them may agree on the wrong valley. At a fixed gel experiments are
independent, and each can be searched through for little: time zero is set out on both sides of where it ended, a few
Gauss-Newton steps of all nuisances follow from each place, and the lowest end counts.
"""

import torch
from torch import Tensor

from imr_torch.assimilate.conditional import conditional_nuisances, possible_nuisances
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator

_TIME_ZERO = 1  # column of the nuisances
_REACH, _PLACES = 3.0, 16  # prior standard deviations on either side, and places in all: .4 apart
_STEPS = 3
_DEEPER = 0.5  # nats by which a valley must be deeper; each solve's own steps make some .3 of it where single curves are sharp


def deeper_nuisances(parameters: Tensor, nuisances: Tensor, batch: ExperimentBatch, simulator: Simulator) -> Tensor:
    """Nuisances in the deepest valley of each experiment that is found at a fixed gel.

    Args:
        parameters: ``M x p`` tensor, gels, SI.
        nuisances: ``M x E x 3`` standardised nuisances of each, in a valley.
        batch: the data.
        simulator: makes the bubbles, some 200 for each gel and experiment whose time zero is uncertain.

    Returns:
        Nuisances of the same shape; those of experiments without a deeper valley are the same numbers.
    """
    movable = batch.nuisance_sds[:, _TIME_ZERO] > 0.0
    if not bool(movable.any()):
        return nuisances
    shifts = torch.linspace(-_REACH, _REACH, _PLACES, dtype=torch.float64)
    places = nuisances[:, None].repeat(1, _PLACES, 1, 1)
    places[..., _TIME_ZERO] += shifts[:, None] * movable
    gels, flat = parameters.repeat_interleave(_PLACES, 0), places.flatten(0, 1)
    unit = torch.eye(3, dtype=torch.float64).expand(*flat.shape[:2], 3, 3)
    for _ in range(_STEPS):
        flat = conditional_nuisances(gels, flat, unit, batch, simulator)[0]
    before = _cost(parameters, nuisances, batch, simulator)  # M x E
    cost, place = _cost(gels, flat, batch, simulator).unflatten(0, places.shape[:2]).min(1)
    found = flat.unflatten(0, places.shape[:2]).gather(1, place[:, None, :, None].expand(-1, 1, -1, 3))[:, 0]
    return torch.where((cost < before - _DEEPER)[..., None], found, nuisances)


def _cost(parameters: Tensor, nuisances: Tensor, batch: ExperimentBatch, simulator: Simulator) -> Tensor:
    """Negative log of likelihood x prior of the nuisances of each experiment, ``n x E``; infinite where there is no bubble."""
    shifts = nuisances * batch.nuisance_sds
    possible = possible_nuisances(shifts, batch)
    prediction = predict(simulator, parameters, batch, torch.where(possible[..., None], shifts, 0.0))
    cost = 0.5 * nuisances.square().sum(-1) - batch.log_likelihood(torch.where(batch.mask, prediction, 0.0))
    return torch.where(possible, cost, torch.inf).nan_to_num(nan=torch.inf)
