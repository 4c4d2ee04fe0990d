"""Marginal likelihoods of noise laws about a fit, in closed form.

Under each law the posterior of gel and nuisances is nearly Gaussian about the fit, so its marginal
likelihood follows from the local sensitivities of the bubbles, which are the same for all laws
(residual maximum likelihood, Patterson & Thompson, Biometrika 58, 1971: what was fitted took part
of the residuals). The scale of each law is found separately.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imr_torch.assimilate.gauss_newton import NormalEquations
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
        point: whitened gel ``d`` and nuisances ``E x w``.
    """

    square: Tensor
    normaliser: Tensor
    size: float
    equations: NormalEquations
    point: tuple[Tensor, Tensor]

    @classmethod
    def of(cls, near: Neighbourhood, laws: Sequence[Noise]) -> "LocalNoise":
        """At one point that was simulated, under laws whose scales are taken as 1."""
        squares = []
        normalisers = []
        blocks = []
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
            blocks.append(equation_blocks(batch.whiten(columns, sd)[None], len(by_gel)))
        equations = NormalEquations(*(torch.cat(parts) for parts in zip(*blocks, strict=True)))
        size = float(near.posterior.batch.sizes.sum())
        return cls(
            torch.stack(squares),
            torch.stack(normalisers),
            size,
            equations,
            (near.point.gel, near.point.nuisances),
        )

    def posterior(self, log_scales: Tensor) -> NormalEquations:
        """Equations of the posterior, ``J x S``, for ``J x S`` logarithms of the scale."""
        gel, nuisances = self.point
        precision = torch.exp(-2.0 * log_scales)  # J x S

        def scaled(x: Tensor) -> Tensor:
            return precision.reshape(*precision.shape, *[1] * (x.ndim - 1)) * x[:, None]

        one = self.equations
        eye_of_gel, eye_of_nuisances = (
            torch.eye(x.shape[-1], dtype=torch.float64) for x in (gel, nuisances)
        )
        return NormalEquations(
            gel + scaled(one.gel_gradient),
            nuisances + scaled(one.nuisance_gradient),
            eye_of_gel + scaled(one.gel_hessian),
            eye_of_nuisances + scaled(one.nuisance_hessian),
            scaled(one.cross),
        )

    def marginal(self, log_scales: Tensor) -> Tensor:
        """Log marginal likelihood, gel and nuisances integrated out: ``J x S`` for ``J x S``
        logarithms of the scale.
        """
        (gel, nuisances), equations = self.point, self.posterior(log_scales)
        precision = torch.exp(-2.0 * log_scales)
        likelihood = (
            -0.5 * self.square[:, None] * precision
            - self.normaliser[:, None]
            - self.size * log_scales
        )
        prior = 0.5 * (gel.square().sum() + nuisances.square().sum())
        determinant = (
            torch.linalg.slogdet(equations.reduced.hessian).logabsdet
            + equations.reduced.nuisance_log_det
        )
        return likelihood - prior + 0.5 * equations.whitened_gradient.square() - 0.5 * determinant


def equation_blocks(whitened: Tensor, gel: int) -> tuple[Tensor, ...]:
    """Blocks of Gauss-Newton equations, without the prior, from whitened columns.

    Args:
        whitened: ``J x C x E x T`` tensor: residual, slopes over the gel, slopes over the
            nuisances.
        gel: how many of the columns are those of the gel.

    Returns:
        Tensors as :class:`NormalEquations` has them, with ``J`` rows each.
    """
    nuisances = whitened.shape[1] - 1 - gel
    residual, by_gel, by_nuisance = (
        x.movedim(1, -1) for x in whitened.split((1, gel, nuisances), 1)
    )
    return (
        -(by_gel.mT @ residual)[..., 0].sum(1),
        -(by_nuisance.mT @ residual)[..., 0],
        (by_gel.mT @ by_gel).sum(1),
        by_nuisance.mT @ by_nuisance,
        by_nuisance.mT @ by_gel,
    )


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
