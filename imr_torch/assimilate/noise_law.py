"""Marginal likelihoods of noise laws about a fit, in closed form.

Under each law the posterior of gel and nuisances is nearly Gaussian about the fit, so its marginal
likelihood follows from the local sensitivities of the bubbles, which are the same for all laws
(residual maximum likelihood, Patterson & Thompson, Biometrika 58, 1971: what was fitted took part
of the residuals). The scale of each law is found separately.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.gauss_newton import NormalEquations, normal_equations
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.observe import Noise

_SEARCH = (
    0.5,
    0.15,
    0.05,
)  # half-widths of the parabolas through which the most probable scale is found, in its logarithm


@dataclass(frozen=True)
class LocalNoise:
    """What a linearisation about one point says about the noise, for each of ``J`` laws at scale 1.

    Args:
        square: ``J`` tensor, squared misfit of all experiments.
        normaliser: ``J`` tensor.
        size: observations.
        equations: normal equations at scale 1, ``J``, without the prior of gel and nuisances.
        point: one point.
    """

    square: Tensor
    normaliser: Tensor
    size: float
    equations: NormalEquations
    point: Point

    @classmethod
    def of(cls, near: Neighbourhood, laws: Sequence[Noise]) -> "LocalNoise":
        """At one point that was simulated, under laws whose scales are taken as 1."""
        squares = []
        normalisers = []
        equations = []
        by_gel, by_nuisance = (x.movedim(-1, 0) for x in near.slopes)
        for law in laws:
            batch = replace(
                near.posterior.batch, noise=replace(law, scale=1.0, widened=1.0), noise_laws=None
            )
            sd = batch.sd(near.centre)
            square, normaliser = batch.terms(near.centre, sd, batch.innovations)
            columns = torch.cat(((batch.mean - near.centre)[None], by_gel, by_nuisance))
            squares.append(square.sum())
            normalisers.append(normaliser.sum())
            equations.append(equations_of_columns(batch.whiten(columns, sd)[None], len(by_gel)))
        return cls(
            torch.stack(squares),
            torch.stack(normalisers),
            float(near.posterior.batch.sizes.sum()),
            concatenated(equations),
            near.point,
        )

    def posterior(self, log_scales: Tensor) -> NormalEquations:
        """Equations of the posterior, ``J x S``, for ``J x S`` logarithms of the scale."""
        precision = torch.exp(-2.0 * log_scales)
        blocks = [getattr(self.equations, block.name)[:, None] for block in fields(NormalEquations)]
        scaled = (precision.reshape(*precision.shape, *[1] * (x.ndim - 2)) * x for x in blocks)
        return NormalEquations(*scaled).with_prior(self.point.gel, self.point.nuisances)

    def marginal(self, log_scales: Tensor) -> Tensor:
        """Log marginal likelihood, gel and nuisances integrated out: ``J x S`` for ``J x S``
        logarithms of the scale.
        """
        equations = self.posterior(log_scales)
        precision = torch.exp(-2.0 * log_scales)
        likelihood = (
            -0.5 * self.square[:, None] * precision
            - self.normaliser[:, None]
            - self.size * log_scales
        )
        prior = 0.5 * (self.point.gel.square().sum() + self.point.nuisances.square().sum())
        determinant = (
            torch.linalg.slogdet(equations.reduced.hessian).logabsdet
            + equations.reduced.nuisance_log_det
        )
        return likelihood - prior + 0.5 * equations.whitened_gradient.square() - 0.5 * determinant


def equations_of_columns(whitened: Tensor, gel: int) -> NormalEquations:
    """Gauss-Newton equations, without the prior, from whitened columns.

    Args:
        whitened: ``J x C x E x T`` tensor: residual, slopes over the gel, slopes over the
            nuisances.
        gel: how many of the columns are those of the gel.
    """
    nuisances = whitened.shape[1] - 1 - gel
    residual, by_gel, by_nuisance = (
        x.movedim(1, -1) for x in whitened.split((1, gel, nuisances), 1)
    )
    gradients = -(by_gel.mT @ residual)[..., 0].sum(1), -(by_nuisance.mT @ residual)[..., 0]
    return normal_equations(gradients, (by_gel, by_nuisance))


def concatenated(parts: Sequence[NormalEquations]) -> NormalEquations:
    """The equations of several sets of laws together."""
    names = [block.name for block in fields(NormalEquations)]
    return NormalEquations(*(torch.cat([getattr(one, name) for one in parts]) for name in names))


def best_scales(fits: Sequence[LocalNoise]) -> tuple[Tensor, Tensor]:
    """Most probable log scale of each law, one for all fits, and its posterior standard deviation:
    two ``J`` tensors.
    """
    centre = (
        0.5
        * (torch.stack([fit.square for fit in fits]).sum(0) / sum(fit.size for fit in fits)).log()
    )
    width = torch.full_like(centre, 1.0)
    for half in _SEARCH:
        tried = centre[:, None] + torch.tensor([-half, 0.0, half]).double()
        low, middle, high = torch.stack([fit.marginal(tried) for fit in fits]).sum(0).unbind(1)
        slope = (high - low) / (2.0 * half)
        bend = (2.0 * middle - low - high) / half**2
        bend = bend.clamp_min(0.5)
        centre = centre + (slope / bend).clamp(-1.0, 1.0)
        width = bend.rsqrt()
    return centre, width
