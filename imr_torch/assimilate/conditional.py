"""Nuisances given the gel: for each gel a Gauss-Newton step of its own, in place of one linearisation for all.

In go gels and a guess of the nuisances of each in every experiment, out come a better centre and the precision there. Far
from the fit, or where many repeats leave the data so exact that nuisances bend within their own uncertainty, the fit's
linearisation is not good enough to draw from. The result is a function of the gel alone, so weights stay exact.
"""

import torch
from torch import Tensor

from imr_torch.observe import ExperimentBatch, displaced, predict
from imr_torch.simulate import Simulator

_EARLIEST = -0.5  # time from which bubbles can be simulated
_SIDE = 1e-4  # prior standard deviations by which nuisances are moved for their sensitivity
_LONGEST = 4.0  # prior standard deviations in one step


def possible_nuisances(shifts: Tensor, batch: ExperimentBatch) -> Tensor:
    """Whether nuisances ``... x E x 3`` leave a bubble that can be simulated; a wild draw must not end the batch."""
    _, times, scale = displaced(batch.designs, batch.times, shifts)
    return (scale[..., 0] > 0.1) & (times[..., 0] > _EARLIEST)


def conditional_nuisances(
    parameters: Tensor, guess: Tensor, chol: Tensor, batch: ExperimentBatch, simulator: Simulator
) -> tuple[Tensor, Tensor]:
    """Most probable nuisances of each gel and their precision, by one Gauss-Newton step.

    Args:
        parameters: ``n x p`` tensor, gels, SI.
        guess: ``n x E x 3`` tensor of standardised nuisances to start from.
        chol: ``n x E x 3 x 3`` tensor, lower Cholesky factors of their Hessian, kept where a bubble fails.
        batch: the data.
        simulator: makes the bubbles, one and one for each uncertain nuisance of every gel and experiment.

    Returns:
        Nuisances and Cholesky factors, of the same shapes.
    """
    columns = torch.nonzero((batch.nuisance_sds > 0.0).any(0))[:, 0]
    sides = torch.zeros(1 + len(columns), 1, 3, dtype=guess.dtype)
    sides[torch.arange(1, len(sides)), 0, columns] = _SIDE
    points = guess[:, None] + sides
    possible = possible_nuisances(points * batch.nuisance_sds, batch).all(1)
    shifts = torch.where(possible[:, None, :, None], points * batch.nuisance_sds, 0.0)
    prediction = predict(simulator, parameters[:, None].expand(-1, len(sides), -1), batch, shifts, bundled=True)
    prediction = torch.where(batch.mask, prediction, 0.0)
    known = possible & torch.isfinite(prediction).all(-1).all(1)
    prediction = torch.where(known[:, None, :, None], prediction, 0.5)
    response = torch.zeros(*guess.shape, prediction.shape[-1], dtype=guess.dtype)  # n x E x 3 x T
    response[:, :, columns] = ((prediction[:, 1:] - prediction[:, :1]) / _SIDE).transpose(1, 2)
    centre = prediction[:, 0]
    gradient = guess + (response @ _slope(centre, batch)[..., None])[..., 0]
    white = batch.whiten(response.movedim(2, 0), batch.sd(centre)).movedim(0, 2)
    root = torch.linalg.cholesky(white @ white.mT + torch.eye(3, dtype=guess.dtype))
    step = -torch.cholesky_solve(gradient[..., None], root)[..., 0]
    step = step * (_LONGEST / step.norm(dim=-1, keepdim=True).clamp_min(1e-300)).clamp_max(1.0)
    return torch.where(known[..., None], guess + step, guess), torch.where(known[..., None, None], root, chol)


def _slope(prediction: Tensor, batch: ExperimentBatch) -> Tensor:
    """Gradient of the negative log likelihood over predictions ``n x E x T``."""
    with torch.enable_grad():
        point = prediction.detach().requires_grad_()
        (slope,) = torch.autograd.grad(-batch.log_likelihood(point).sum(), point)
    return slope
