"""Sensitivities carried along a step without new bubbles: those of the point before, corrected by
what the step changed.

Finite differences cost a bubble for every parameter, a step costs one. After a step the change of
the prediction in its direction is known exactly, and Broyden's update (Math. Comp. 19, 1965, eq.
2.5; lengths by the Gauss-Newton Hessian) puts it into the sensitivities, experiment by experiment.
Steps by such sensitivities are taken only where they lower the exact cost.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.forward import STEP, Point
from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.posterior import Neighbourhood


def carried(
    near: Neighbourhood,
    equations: NormalEquations,
    point: Point,
    seen: Float[Tensor, "chains experiments frames"],
) -> Neighbourhood:
    """The neighbourhoods of chains after a step, by those before it.

    Args:
        near: of ``C`` points.
        equations: there.
        point: ``C`` points to which the steps led.
        seen: predictions at these.

    Returns:
        Neighbourhoods about the new points, with the same moves.
    """
    gel = point.gel - near.point.gel
    nuisances = point.nuisances - near.point.nuisances
    by_gel, by_nuisance = near.slopes
    expected = (by_gel @ gel[:, None, :, None] + by_nuisance @ nuisances[..., None])[..., 0]
    surprise = seen - near.centre - expected  # C x E x T
    gel_dual = (equations.gel_hessian @ gel[..., None])[..., 0]
    nuisance_dual = (equations.nuisance_hessian @ nuisances[..., None])[..., 0]
    square = (gel * gel_dual).sum(-1, keepdim=True) + (nuisances * nuisance_dual).sum(-1)  # C x E
    along_gel = (near.moves @ gel_dual[..., None]).expand(-1, -1, square.shape[1])  # C x N x E
    along_nuisance = STEP * nuisance_dual[..., near.posterior.uncertain].mT  # C x S x E
    share = torch.cat((along_gel, along_nuisance), 1) / square.clamp_min(1e-300)[:, None]
    prediction = near.prediction + (seen - near.centre)[:, None]
    prediction[:, 0] = seen
    prediction[:, 1:] += share[..., None] * surprise[:, None]
    return Neighbourhood(near.posterior, point, near.moves, prediction)
