"""How much wider the intervals of a fit must be than independent frames say, for what its residuals have in common.

The variance of an estimate by weights that take frames as independent, under residuals of covariance ``S``, is
``H^-1 (J^T W S W J) H^-1`` (White, Econometrica 50, 1982). What ``S`` holds beside the noise of single frames is not known but
by its posterior (:mod:`imr_torch.assimilate.frame_noise`), so the estimate's error is a mixture of normal distributions, and
the factor is the one by which its central 90 % are wider.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from scipy.optimize import root_scalar
from torch import Tensor

from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.matern import MATERN
from imr_torch.assimilate.noise_law import LocalNoise, equation_blocks
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.observe import Noise

_Z = 1.6448536  # a normal variable lies within this of its mean with probability .9


@dataclass(frozen=True)
class Deviations:
    """What residuals may have in common beside the noise of single frames: ``K`` possibilities.

    Args:
        log_weights: log probabilities, to a constant.
        smooth: variances of a smooth deviation, R*^2.
        durations: lags at which its correlation has fallen to 1/e, t*.
        bends: sizes of deviations next to collapses, over the bend of the curve there.
    """

    log_weights: Tensor
    smooth: Tensor
    durations: Tensor
    bends: Tensor


@dataclass(frozen=True)
class WhitenedFit:
    """A fit's local sensitivities under a law of the noise, dense over the frames that are used.

    Args:
        residual: ``E x T x 1`` tensor, whitened.
        by_gel: ``E x T x d`` tensor, whitened.
        by_nuisance: ``E x T x w`` tensor, whitened.
        whitening: ``E x T x T`` tensor, from residuals to whitened ones.
        times: ``E x T`` tensor.
        bend: ``E x T`` tensor (:func:`imr_torch.assimilate.spikes.bends`).
        stride: frames for each that is used.
    """

    residual: Tensor
    by_gel: Tensor
    by_nuisance: Tensor
    whitening: Tensor
    times: Tensor
    bend: Tensor
    stride: float

    @classmethod
    def of(cls, near: Neighbourhood, law: Noise, rows: Tensor, bend: Tensor, factors: Tensor) -> "WhitenedFit":
        """About one point; ``rows`` are the frames that are used, ``factors`` the noise of each curve over the law."""
        batch, used = near.posterior.batch, rows.any(0)
        sd = law.sd(near.centre, batch.times) * factors[:, None]
        if law.correlation_time:
            whole = replace(batch, noise=law, noise_laws=None)
            eye = torch.eye(batch.times.shape[1], dtype=torch.float64)[:, None].expand(-1, *batch.times.shape)
            whitening = whole.whiten(eye, sd).permute(1, 2, 0)[:, used][:, :, used]
        else:
            whitening = torch.diag_embed(torch.where(rows, batch.counts.sqrt() / sd, 0.0)[:, used])
        residual = torch.where(rows, batch.mean - near.centre, 0.0)[:, used, None]
        by_gel, by_nuisance = (torch.where(rows[..., None], x, 0.0)[:, used].nan_to_num() for x in near.slopes)
        stride = float(batch.mask.sum()) / float(rows.sum())
        return cls(
            whitening @ residual,
            whitening @ by_gel,
            whitening @ by_nuisance,
            whitening,
            batch.times[:, used],
            bend[:, used],
            stride,
        )

    def own(self) -> Tensor:
        """``E x T x d`` tensor, sensitivities to the gel that nuisances do not take up."""
        eye = torch.eye(self.by_nuisance.shape[-1], dtype=torch.float64)
        square = eye + self.by_nuisance.mT @ self.by_nuisance
        return self.by_gel - self.by_nuisance @ torch.linalg.solve(square, self.by_nuisance.mT @ self.by_gel)

    def smooth(self, duration: float) -> Tensor:
        """``E x T x T`` tensor, correlation matrices of a smooth deviation."""
        lag = MATERN / duration * (self.times[:, :, None] - self.times[:, None, :]).abs()
        return (1.0 + lag) * torch.exp(-lag)


def interval_factor(fits: Sequence[WhitenedFit], deviations: Deviations) -> float:
    """The factor on 90 % intervals of the gel; where fits have gels of their own, one for all.

    Args:
        fits: under the central law of the noise of single frames.
        deviations: what residuals may have in common.
    """
    told, by_smooth, by_bend = 0.0, torch.zeros_like(deviations.durations), 0.0
    for fit in fits:
        own = fit.own()
        precision = (own.mT @ own).sum(0)
        inverse = torch.linalg.inv(torch.eye(len(precision), dtype=torch.float64) + precision)
        told += float((inverse @ precision).trace())
        moved = fit.whitening.mT @ own
        for duration in deviations.durations.unique().tolist():
            scatter = (moved.mT @ fit.smooth(duration) @ moved).sum(0)
            own_scatter = float((inverse @ scatter).trace())
            by_smooth[deviations.durations == duration] += fit.stride * own_scatter  # pairs of frames go as its square
        bent = (moved.mT @ (fit.bend.square()[..., None] * moved)).sum(0)
        by_bend += float((inverse @ bent).trace())
    added = deviations.smooth * by_smooth + deviations.bends.square() * by_bend
    widths = (1.0 + added / max(told, 1e-300)).sqrt()
    weights = torch.softmax(deviations.log_weights, 0)

    def beyond(factor: float) -> float:
        return float(weights @ torch.erf(_Z * factor / widths / 2.0**0.5)) - 0.9

    largest = float(widths.max())
    return 1.0 if largest < 1.0 + 1e-9 else float(root_scalar(beyond, bracket=(0.5, largest + 1.0)).root)


def log_marginals(fit: WhitenedFit, near: Neighbourhood, deviations: Deviations) -> Tensor:
    """Log marginal likelihood of each possibility, to a constant: ``K`` tensor, gel and nuisances integrated out.

    Args:
        fit: under a law of the noise that is known.
        near: the same fit.
        deviations: the possibilities; their weights are not used.
    """
    columns = torch.cat((fit.residual, fit.by_gel, fit.by_nuisance), -1)
    eye = torch.eye(columns.shape[1], dtype=torch.float64)
    bent = fit.whitening @ (fit.bend.square()[..., None] * fit.whitening.mT)
    shapes = {lag: fit.whitening @ fit.smooth(lag) @ fit.whitening.mT for lag in deviations.durations.unique().tolist()}
    values = []
    for smooth, lag, bend in zip(deviations.smooth, deviations.durations.tolist(), deviations.bends, strict=True):
        root = torch.linalg.cholesky(eye + smooth * shapes[lag] + bend.square() * bent)
        seen = torch.linalg.solve_triangular(root, columns, upper=False).permute(2, 0, 1)
        log_det = root.diagonal(dim1=-2, dim2=-1).log().sum()
        blocks = NormalEquations(*equation_blocks(seen[None], fit.by_gel.shape[-1]))
        local = LocalNoise(seen[0].square().sum()[None], log_det[None], 0.0, blocks, (near.point.gel, near.point.nuisances))
        values.append(local.marginal(torch.zeros(1, 1, dtype=torch.float64))[0, 0])
    return torch.stack(values)
