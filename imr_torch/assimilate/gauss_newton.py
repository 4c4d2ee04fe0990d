"""Gauss-Newton algebra of one gel seen in several experiments, each with nuisances of its own.

The controls are ``v`` (the gel, shared by all experiments) and ``w_e`` (three nuisances of experiment ``e``), all with
standard normal priors. The normal matrix is an arrow: nuisances of different experiments meet only through the gel, so
they are eliminated one experiment at a time (Schur complement), and any number of experiments costs the same per piece.
"""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class NormalEquations:
    """Linearisation of the joint cost at one point, nuisances eliminated.

    Args:
        gradient: ``... x d`` tensor, gradient over the gel with the nuisances at their conditional optimum.
        hessian: ``... x d x d`` tensor, its Gauss-Newton Hessian (prior included).
        nuisance_step: ``... x E x 3`` tensor, step of the nuisances when the gel stays.
        nuisance_response: ``... x E x 3 x d`` tensor, how the nuisances' optimum moves with the gel.
        nuisance_log_det: ``...`` tensor, log determinant of the nuisances' own Hessian.
    """

    gradient: Tensor
    hessian: Tensor
    nuisance_step: Tensor
    nuisance_response: Tensor
    nuisance_log_det: Tensor

    @property
    def whitened_gradient(self) -> Tensor:
        """``...`` tensor: length of the gradient in posterior standard deviations; 0 at the optimum."""
        chol = torch.linalg.cholesky(self.hessian)
        return torch.linalg.solve_triangular(chol, self.gradient[..., None], upper=False)[..., 0].norm(dim=-1)

    @property
    def posterior_chol(self) -> Tensor:
        """``... x d x d`` lower Cholesky factor of the inverse Hessian."""
        return torch.linalg.cholesky(torch.linalg.inv(self.hessian))

    def step(self, damping: Tensor) -> tuple[Tensor, Tensor]:
        """Levenberg-Marquardt steps of gel and nuisances; ``damping`` broadcasts against ``...``."""
        scaled = self.hessian + damping[..., None, None] * torch.diag_embed(self.hessian.diagonal(dim1=-2, dim2=-1))
        gel = -torch.linalg.solve(scaled, self.gradient[..., None])[..., 0]
        return gel, self.nuisance_step + (self.nuisance_response @ gel[..., None, :, None])[..., 0]


def normal_equations(
    gel: Tensor, nuisances: Tensor, gradients: tuple[Tensor, Tensor], sensitivities: tuple[Tensor, Tensor]
) -> NormalEquations:
    """Assemble the arrow and eliminate the nuisances.

    Args:
        gel: ``... x d`` tensor, controls ``v``.
        nuisances: ``... x E x 3`` tensor, controls ``w``.
        gradients: of the negative log likelihood over ``v`` (``... x d``) and ``w`` (``... x E x 3``).
        sensitivities: of the whitened predictions over ``v`` (``... x E x T x d``) and ``w`` (``... x E x T x 3``).

    Returns:
        The reduced normal equations.
    """
    by_gel, by_nuisance = sensitivities
    own = torch.eye(nuisances.shape[-1], dtype=gel.dtype, device=gel.device) + by_nuisance.mT @ by_nuisance
    cross = by_nuisance.mT @ by_gel
    pull = nuisances + gradients[1]
    chol = torch.linalg.cholesky(own)
    response = -torch.cholesky_solve(cross, chol)
    step = -torch.cholesky_solve(pull[..., None], chol)[..., 0]
    gradient = gel + gradients[0] + (response.mT @ pull[..., None])[..., 0].sum(-2)
    prior = torch.eye(gel.shape[-1], dtype=gel.dtype, device=gel.device)
    hessian = prior + (by_gel.mT @ by_gel + cross.mT @ response).sum(-3)
    log_det = 2.0 * chol.diagonal(dim1=-2, dim2=-1).log().sum(-1).sum(-1)
    return NormalEquations(gradient, 0.5 * (hessian + hessian.mT), step, response, log_det)


def ensemble_sensitivity(anomalies: Tensor, responses: Tensor) -> Tensor:
    """Sensitivity of predictions to controls by regression over an ensemble.

    Exact for a linear model and any ensemble of more members than controls (the bundle form of the iterative ensemble
    Kalman smoother: Bocquet & Sakov, Nonlin. Processes Geophys. 20, 2013, section 2).

    Args:
        anomalies: ``... x N x d`` tensor, members' controls minus the centre.
        responses: ``... x N x m`` tensor, members' predictions minus the centre's; a member with NaN does not count.

    Returns:
        ``... x m x d`` tensor.
    """
    good = torch.isfinite(responses).all(-1, keepdim=True)
    controls = torch.where(good, anomalies, 0.0)
    values = torch.where(good, responses, 0.0)
    gram = controls.mT @ controls
    ridge = 1e-13 * gram.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
    gram = gram + ridge * torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    return torch.linalg.solve(gram, controls.mT @ values).mT
