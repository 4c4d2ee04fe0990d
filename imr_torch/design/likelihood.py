"""The likelihood of planned data: repeats, heteroscedastic and correlated noise, windows, nuisances
as Gaussian directions.

Data are the mean curves of all repeats, within each datum's own window. Nuisances are marginalised
in their linear approximation: ``y = f(v) + B w + e`` with ``w`` standard normal, by the Woodbury
identity. What is left out is the scatter of the repeats about their mean, which tells of the gel
through the noise law alone (``2 slope^2`` of the information, .1 %).

Constants common to all gels and models are left out of log densities.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.design.plan import Plan
from imr_torch.design.response import Response
from imr_torch.types import BroadcastValues, DrawnControls, DrawnValues

_BLOCK = 4_000_000  # numbers in one block of pairs


@dataclass(frozen=True)
class Data:
    """Mean curves of planned experiments.

    Args:
        radius: R/Rmax.
        window: frames that will be assimilated.
    """

    radius: Float[Tensor, "*draws designs frames"]
    window: Bool[Tensor, "*draws designs frames"]

    def __len__(self) -> int:
        return len(self.radius)

    def __getitem__(self, rows: Tensor | slice) -> "Data":
        return Data(self.radius[rows], self.window[rows])


def observe(seen: Response, plan: Plan, source: torch.Generator) -> Data:
    """One datum of each gel, with nuisances and noise drawn."""
    noise = torch.randn(seen.radius.shape, generator=source, dtype=torch.float64)
    if plan.decorrelation is not None:
        noise = torch.linalg.solve_triangular(plan.decorrelation, noise.mT, upper=False).mT
    nuisance = torch.randn(
        *seen.by_nuisance.shape[:2],
        seen.by_nuisance.shape[-1],
        1,
        generator=source,
        dtype=torch.float64,
    )
    noise = noise * plan.noise.sd(seen.radius, plan.times) / plan.repeats**0.5
    return Data(
        seen.radius + (seen.by_nuisance @ nuisance)[..., 0] + noise, plan.window(seen.radius)
    )


def _whiten(columns: Tensor, sd: Tensor, window: Tensor, plan: Plan) -> Tensor:
    """Columns ``... x q x T x c`` in units of independent noise of the mean curve, 0 outside the
    window.
    """
    scaled = columns / sd[..., None] * plan.repeats**0.5
    if plan.decorrelation is not None:
        scaled = plan.decorrelation @ scaled
    return torch.where(window[..., None], scaled, 0.0)


def _gram(
    columns: Tensor, by_nuisance: Tensor, at: Tensor, window: Tensor, plan: Plan
) -> tuple[Tensor, Tensor]:
    """``X^T C^-1 X`` and ``log det C`` of noise and nuisances together, for a gel that shows
    ``at``.

    Args:
        columns: ``... x q x T x c`` tensor ``X``.
        by_nuisance: ``... x q x T x k`` tensor.
        at: ``... x q x T`` tensor, the prediction that sets the noise.
        window: ``... x q x T`` boolean tensor.
        plan: how experiments are observed.

    Returns:
        ``... x c x c`` and ``...`` tensors, summed over the ``q`` experiments.
    """
    sd = plan.noise.sd(at, plan.times)
    white = _whiten(columns, sd, window, plan)
    gram = (white.mT @ white).sum(-3)
    log_det = 2.0 * torch.where(window, sd.log(), 0.0).sum((-2, -1))
    if by_nuisance.shape[-1] == 0:
        return gram, log_det
    nuisance = _whiten(by_nuisance, sd, window, plan)
    chol = torch.linalg.cholesky(
        torch.eye(nuisance.shape[-1], dtype=sd.dtype) + nuisance.mT @ nuisance
    )
    shared = torch.linalg.solve_triangular(chol, nuisance.mT @ white, upper=False)
    log_det = log_det + 2.0 * chol.diagonal(dim1=-2, dim2=-1).log().sum((-2, -1))
    return gram - (shared.mT @ shared).sum(-3), log_det


def log_likelihood(
    data: Data,
    radius: Float[Tensor, "*#batch designs frames"],
    by_nuisance: Float[Tensor, "*#batch designs frames nuisances"],
    plan: Plan,
) -> BroadcastValues:
    """Log density of data given gels that show ``radius``.

    All shapes ``... x q x T`` broadcast, the result is ``...``.
    """
    square, log_det = _gram(
        (data.radius - radius)[..., None], by_nuisance, radius, data.window, plan
    )
    return -0.5 * (square[..., 0, 0] + log_det)


def pairwise(data: Data, gels: Response, plan: Plan) -> Float[Tensor, "data gels"]:
    """``n x m`` log densities of every datum given every gel."""
    per_row = gels.radius.numel() * (1 + gels.by_nuisance.shape[-1])
    rows = max(1, _BLOCK // max(1, per_row))
    blocks = [data[i : i + rows] for i in range(0, max(1, len(data)), rows)]
    return torch.cat(
        [
            log_likelihood(
                Data(b.radius[:, None], b.window[:, None]), gels.radius, gels.by_nuisance, plan
            )
            for b in blocks
        ]
    )


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
    def averaging(self) -> Float[Tensor, "draws controls controls"]:
        """``n x d x d`` tensor ``G (1 + G)^-1`` with ``G = J^T C^-1 J``: share of the posterior
        that is from the data.
        """
        eye = torch.eye(self.chol.shape[-1], dtype=self.chol.dtype)
        return eye - torch.cholesky_inverse(self.chol)


def infer(data: Data, at: Response, plan: Plan) -> Linear:
    """Bayesian inference with the model linearised at a gel: ``f(v) = f + J (v - v_at)``, ``v``
    standard normal.

    Args:
        data: ``n`` data.
        at: ``n`` gels, or one for all data.
        plan: how they are observed.
    """
    columns = torch.cat(
        ((data.radius - at.radius)[..., None], at.by_gel.expand(len(data), -1, -1, -1)), dim=-1
    )
    gram, log_det = _gram(columns, at.by_nuisance, at.radius, data.window, plan)
    square = gram[:, 0, 0]
    score = gram[:, 1:, 0]
    normal = gram[:, 1:, 1:]
    v = at.controls.expand(len(data), -1)
    moved = (normal @ v[..., None])[..., 0]
    from_origin = square + ((2.0 * score + moved) * v).sum(
        -1
    )  # the residual that the gel v = 0 would leave
    score = score + moved
    chol = torch.linalg.cholesky(torch.eye(v.shape[1], dtype=v.dtype) + normal)
    mean = torch.cholesky_solve(score[..., None], chol)[..., 0]
    fitted = from_origin - (score * mean).sum(-1)
    log_evidence = -0.5 * (fitted + log_det) - chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return Linear(-0.5 * (square + log_det), log_evidence, mean, chol)
