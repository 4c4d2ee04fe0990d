"""Proposal distributions for importance sampling: Student-t mixtures about a fit, along its ridge,
or about earlier draws.

A proposal is made anew from the draws so far as a mixture of kernels (West, JRSS B 55, 1993), with
all of them weighted by the mixture of their proposals (Owen & Zhou, JASA 95, 2000).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Real
from torch import Tensor

from imr_torch.assimilate.gauss_newton import half_log_det
from imr_torch.assimilate.importance import effective_size, weighted_moments
from imr_torch.float64 import ones, randn, tensor
from imr_torch.types import ControlMatrix, Controls, DrawnControls, DrawnValues, Values


@dataclass(frozen=True)
class Kernels:
    """A proposal for a posterior: a mixture of multivariate Student-t kernels.

    Args:
        centres: ``J x d`` tensor.
        weights: their probabilities.
        chols: their scales.
        mean: mean of the posterior that the proposal is made for.
        chol: Cholesky factor of the covariance of that posterior.
        effective: effective draws that these two rest on; infinite where on none.
        precisions: tensor ``d x d`` for each of the first centres, of that posterior about them;
            None where not known.
        freedom: degrees of freedom of the kernels: with 7 their tails are heavier than a
            Gaussian's, with moments up to the sixth.
    """

    centres: Float[Tensor, "kernels controls"]
    weights: Float[Tensor, "kernels"]
    chols: Float[Tensor, "kernels controls controls"]
    mean: Controls
    chol: ControlMatrix
    effective: float = math.inf
    precisions: Float[Tensor, "known controls controls"] | None = None
    freedom: int = 7

    @classmethod
    def about_mean(cls, mean: Controls, chol: ControlMatrix) -> "Kernels":
        """A single kernel about ``mean`` (``d``) with scale ``chol`` (``d x d``)."""
        return cls(mean[None], ones(1), chol[None], mean, chol)

    @classmethod
    def through_draws(
        cls,
        points: DrawnControls,
        log_weights: DrawnValues,
        *,
        wide_share: float = 0.5,
        widest: float = 4.0,
    ) -> "Kernels":
        """Kernels on weighted points (``n x d``, ``n``), of the width of Silverman's rule (1986,
        equation 4.14).

        One wide kernel about them all covers places without a point. Weights with an effective
        sample size below ten a dimension are tempered first, and the kernels widened in turn: such
        points lie at the edge of the earlier proposal, and the posterior beyond it.

        Args:
            points: draws so far.
            log_weights: theirs.
            wide_share: probability of the wide kernel.
            widest: most by which kernels are widened.
        """
        size = points.shape[1]
        weights, power = _temper_weights(log_weights, 10.0 * (size + 1))
        mean, covariance = weighted_moments(points, weights)
        chol = min(power**-0.5, widest) * torch.linalg.cholesky(covariance)
        effective = float(effective_size(weights))
        width = (4.0 / ((size + 2) * effective)) ** (1.0 / (size + 4))
        kept = weights > 0.0
        chols = width * chol.expand(int(kept.sum()), -1, -1)
        kernels = cls(points[kept], weights[kept], chols, mean, chol, effective)
        return kernels.with_wide_kernel(wide_share)

    def with_wide_kernel(self, share: float, *, scale: float = 1.5) -> "Kernels":
        """With one wide kernel about all, which covers what the others do not.

        It takes ``share`` of the probability, and is ``scale`` standard deviations wide.
        """
        return replace(
            self,
            centres=torch.cat((self.centres, self.mean[None])),
            weights=torch.cat(
                ((1.0 - share) * self.weights, self.weights.new_tensor([share]))
            ),
            chols=torch.cat((self.chols, scale * self.chol[None])),
        )

    def precisions_at(
        self, points: DrawnControls
    ) -> Float[Tensor, "draws controls controls"] | None:
        """Of the posterior about ``n x d`` points, ``n x d x d``, as about the nearest centre.

        None where not known.
        """
        if self.precisions is None:
            return None
        return self.precisions[
            self._square_distances(points)[: len(self.precisions)].argmin(0)
        ]

    def _square_distances(self, points: Tensor) -> Tensor:
        """``J x n`` tensor, from each kernel in its own scale."""
        whiten = torch.linalg.inv(self.chols)
        gaps = torch.einsum("jab,jnb->jna", whiten, points - self.centres[:, None])
        return gaps.square().sum(-1)

    def draw_points(
        self, count: int, source: torch.Generator
    ) -> Float[Tensor, "count controls"]:
        """``count x d`` independent draws."""
        deviation = student_draws((count, self.centres.shape[1]), self.freedom, source)
        kernel = torch.multinomial(self.weights, count, replacement=True, generator=source)
        return self.centres[kernel] + (self.chols[kernel] @ deviation[..., None])[..., 0]

    def log_prob(self, points: DrawnControls, *, pairs: int = 1_000_000) -> DrawnValues:
        """Log density at ``n x d`` points: ``n`` tensor; so many pairs with kernels at once."""
        heights = (self.weights.log() - half_log_det(self.chols))[:, None]
        size = points.shape[1]
        rows = []
        for some in points.split(max(1, pairs // len(self.centres))):
            density = student_log_prob(self._square_distances(some), size, self.freedom)
            rows.append(torch.logsumexp(heights + density, dim=0))
        return torch.cat(rows)


def student_draws(
    shape: Sequence[int], freedom: int, source: torch.Generator
) -> Float[Tensor, "*shape"]:
    """Independent draws of the standard multivariate Student t, in as many dimensions as the last
    of ``shape``.
    """
    normal = randn(*shape, generator=source)
    squares = randn(*shape[:-1], freedom, generator=source).square().sum(-1, keepdim=True)
    return normal * (freedom / squares).sqrt()


def student_log_prob(
    square: Values, size: int | Real[Tensor, "..."], freedom: int
) -> Values:
    """Log density of the standard multivariate Student t in ``size`` dimensions at points of a
    squared length.
    """
    size = torch.as_tensor(size, dtype=square.dtype)
    half = 0.5 * (freedom + size)
    constant = (
        torch.lgamma(half)
        - math.lgamma(0.5 * freedom)
        - 0.5 * size * math.log(freedom * math.pi)
    )
    return constant - half * torch.log1p(square / freedom)


def mixture_log_prob(
    proposals: Sequence[Kernels], counts: Sequence[int], points: DrawnControls
) -> DrawnValues:
    """Log density of all proposals together, each in proportion to its draws: ``n`` tensor at ``n x
    d`` points.
    """
    shares = tensor(counts).log() - math.log(sum(counts))
    return torch.logsumexp(
        torch.stack([p.log_prob(points) for p in proposals]) + shares[:, None], dim=0
    )


def _temper_weights(log_weights: Tensor, least: float) -> tuple[Tensor, float]:
    """Normalised weights, raised to the largest power up to 1 that leaves an effective sample size
    of ``least``; the power.
    """
    low = 0.0
    high = 1.0
    power = 1.0
    for _ in range(40):
        enough = float(effective_size(torch.softmax(power * log_weights, dim=0))) >= least
        if enough and power == 1.0:
            break
        low, high = (power, high) if enough else (low, power)
        power = 0.5 * (low + high)
    return torch.softmax(power * log_weights, dim=0), power
