"""Nuisances given the gel: for each gel a Gauss-Newton step of its own, in place of one
linearisation for all.

From points with a guess of the nuisances follow a better centre and the precision there. Far from
the fit, or where many repeats make the data so exact that the cost is not quadratic in the
nuisances within their uncertainty, the fit's linearisation is not good enough to draw from. The
result is a function of the gel alone, so importance weights stay exact.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.posterior import Posterior

_LONGEST = 4.0  # prior standard deviations in one step


def conditional_nuisances(
    posterior: Posterior, point: Point, chol: Float[Tensor, "draws experiments nuisances nuisances"]
) -> tuple[
    Float[Tensor, "draws experiments nuisances"],
    Float[Tensor, "draws experiments nuisances nuisances"],
]:
    """Most probable nuisances of each gel and their precision, by one Gauss-Newton step.

    Args:
        posterior: gel and nuisances are of it; simulates one bubble, and one for each uncertain
            nuisance of every experiment.
        point: ``n`` gels, with nuisances to start from.
        chol: lower Cholesky factors of their Hessian, kept where a bubble fails.

    Returns:
        Nuisances ``n x E x w`` and Cholesky factors ``n x E x w x w``.
    """
    near = posterior.neighbourhood(point, moves_gel=False)
    known = torch.isfinite(near.prediction).all(-1).all(1)
    equations = replace(
        near, prediction=torch.where(known[:, None, :, None], near.prediction, 0.5)
    ).equations
    root = torch.linalg.cholesky(equations.nuisance_hessian)
    step = -torch.cholesky_solve(equations.nuisance_gradient[..., None], root)[..., 0]
    step = step * (_LONGEST / step.norm(dim=-1, keepdim=True).clamp_min(1e-300)).clamp_max(1.0)
    moved = torch.where(known[..., None], point.nuisances + step, point.nuisances)
    return moved, torch.where(known[..., None, None], root, chol)
