"""Nuisances given the gel: for each gel a Gauss-Newton step of its own, in place of one linearisation for all.

In go gels and a guess of the nuisances of each in every experiment, out come a better centre and the precision there. Far
from the fit, or where many repeats leave the data so exact that nuisances bend within their own uncertainty, the fit's
linearisation is not good enough to draw from. The result is a function of the gel alone, so weights stay exact.
"""

import torch
from torch import Tensor

from imr_torch.assimilate.cost import equations_at, sides
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator

_LONGEST = 4.0  # prior standard deviations in one step


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
    points = guess[:, None] + torch.cat((guess.new_zeros(1, 1, 3), sides(batch)))
    gels = parameters[:, None].expand(-1, points.shape[1], -1)
    prediction = predict(simulator, gels, batch, points * batch.nuisance_sds, bundled=True)
    prediction = torch.where(batch.mask, prediction, 0.0)
    known = torch.isfinite(prediction).all(-1).all(1)
    prediction = torch.where(known[:, None, :, None], prediction, 0.5)
    count = len(guess)
    equations = equations_at(batch, guess.new_zeros(count, 0), guess, guess.new_zeros(count, 0, 0), prediction)
    root = torch.linalg.cholesky(equations.nuisance_hessian)
    step = -torch.cholesky_solve(equations.nuisance_gradient[..., None], root)[..., 0]
    step = step * (_LONGEST / step.norm(dim=-1, keepdim=True).clamp_min(1e-300)).clamp_max(1.0)
    return torch.where(known[..., None], guess + step, guess), torch.where(known[..., None, None], root, chol)
