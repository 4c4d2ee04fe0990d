"""The likelihood of planned data: repeats, heteroscedastic and correlated noise, windows, nuisances
as Gaussian directions.

Data are the mean curves of all repeats, within each datum's own window. Nuisances are marginalised
in their linear approximation: ``y = f(v) + B w + e`` with ``w`` standard normal, by the normal
equations that fits use. What is left out is the scatter of the repeats about their mean, which
tells of the gel through the noise law alone (``2 slope^2`` of the information, .1 %).

Constants common to all gels and models are left out of log densities.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.assimilate.gauss_newton import NormalEquations, normal_equations
from imr_torch.design.plan import Plan
from imr_torch.design.response import Response, Rows
from imr_torch.float64 import randn
from imr_torch.types import BroadcastValues, DrawnControls, DrawnValues


@dataclass(frozen=True)
class Data(Rows):
    """Mean curves of planned experiments.

    Args:
        radius: R/Rmax.
        window: frames that will be assimilated.
    """

    radius: Float[Tensor, "*draws designs frames"]
    window: Bool[Tensor, "*draws designs frames"]


def observe_gels(seen: Response, plan: Plan, source: torch.Generator) -> Data:
    """One datum of each gel, with nuisances and noise drawn."""
    noise = randn(seen.radius.shape, generator=source)
    if plan.decorrelation is not None:
        noise = torch.linalg.solve_triangular(plan.decorrelation, noise.mT, upper=False).mT
    nuisance = randn(*seen.by_nuisance.shape[:2], seen.by_nuisance.shape[-1], 1, generator=source)
    noise = noise * plan.noise.sd(seen.radius, plan.times) / plan.repeats**0.5
    return Data(
        seen.radius + (seen.by_nuisance @ nuisance)[..., 0] + noise,
        plan.frames_in_window(seen.radius),
    )


def linearise_data(
    data: Data,
    radius: Float[Tensor, "*#batch designs frames"],
    by_gel: Float[Tensor, "*#batch designs frames slopes"],
    by_nuisance: Float[Tensor, "*#batch designs frames nuisances"],
    plan: Plan,
) -> tuple[BroadcastValues, NormalEquations]:
    """Log density of data given gels that show ``radius`` with the nuisances at their means, and
    normal equations of that likelihood.

    >>> from imr_torch.design import Plan
    >>> from imr_torch.design.likelihood import Data, linearise_data
    >>> plan = Plan(times=torch.tensor([0.0, 1.0], dtype=torch.float64))
    >>> radius = torch.ones(5, 1, 2, dtype=torch.float64)  # 5 draws of one design with two frames
    >>> data = Data(radius, plan.frames_in_window(radius))
    >>> log, _ = linearise_data(data, radius, radius[..., None], radius[..., None], plan)
    >>> log.shape
    torch.Size([5])
    """
    sd = plan.noise.sd(radius, plan.times)

    def whiten_columns(columns: Tensor) -> Tensor:
        """In units of independent noise of the mean curve, 0 outside the window."""
        scaled = columns / sd[..., None] * plan.repeats**0.5
        if plan.decorrelation is not None:
            scaled = plan.decorrelation @ scaled
        return torch.where(data.window[..., None], scaled, 0.0)

    residual = whiten_columns((data.radius - radius)[..., None])
    slopes = whiten_columns(by_gel), whiten_columns(by_nuisance)
    of_gel, of_nuisances = (-(slope.mT @ residual)[..., 0] for slope in slopes)
    log_det = torch.where(data.window, sd.log(), 0.0).sum((-2, -1))
    log = -0.5 * residual.square().sum((-3, -2, -1)) - log_det
    return log, normal_equations((of_gel.sum(-2), of_nuisances), slopes)


@dataclass(frozen=True)
class Linear:
    """Linear-Gaussian inference from each datum about a gel of its own.

    Args:
        log_likelihood: of the datum given the gel itself.
        log_evidence: of the datum under the linearised model.
        mean: posterior mean.
        chol: Cholesky factor of the posterior precision.
    """

    log_likelihood: DrawnValues
    log_evidence: DrawnValues
    mean: DrawnControls
    chol: Float[Tensor, "draws controls controls"]

    @property
    def information(self) -> DrawnValues:
        """``n`` tensor: ``1/2 log det(1 + J^T C^-1 J)``."""
        return self.chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)

    @property
    def fisher(self) -> Float[Tensor, "draws controls controls"]:
        """``n x d x d`` tensor ``J^T C^-1 J``, what the data add to the precision."""
        return self.chol @ self.chol.mT - torch.eye(self.chol.shape[-1], dtype=self.chol.dtype)


def infer_linear(data: Data, at: Response, plan: Plan) -> Linear:
    """Bayesian inference with the model linearised at a gel: ``f(v) = f + J (v - v_at)``, ``v``
    standard normal.

    Args:
        data: ``n`` data.
        at: ``n`` gels, or one for all data.
        plan: how they are observed.
    """
    log, likelihood = linearise_data(data, at.radius, at.by_gel, at.by_nuisance, plan)
    _, q, _, k = at.by_nuisance.shape
    still = at.by_nuisance.new_zeros(q, k)
    posterior = likelihood.with_prior(at.controls, still)
    return Linear(
        log + posterior.log_nuisance_integral,
        log - 0.5 * at.controls.square().sum(-1) + posterior.log_integral,
        at.controls + posterior.step[0],
        posterior.gel_chol,
    )
