"""How far an observed radius lies from the true one: the published noise law, and one fitted to residuals.

The law of Chu, Estrada & Bryngelson (arXiv 2409.00011) is ``sigma = |R* - 1|/50 + t*/160``; it vanishes at ``t* = 0``, so
a floor is added in quadrature. Real residuals are larger and correlated in time, because a fit of a wrong model errs
smoothly; :func:`fit_noise` estimates a common scale and a correlation time from them by maximum likelihood.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imr_torch.errors import InputDataError

_CORRELATION_TIMES = (0.0, 0.02, 0.04, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4)


@dataclass(frozen=True)
class Noise:
    """Gaussian observation noise ``scale * sqrt((slope |R*-1| + drift t*)^2 + floor^2)``, independent between repeats.

    Args:
        scale: common factor.
        floor: smallest standard deviation, in R*.
        slope: part in proportion to ``|R* - 1|``.
        drift: part in proportion to ``t*``.
        correlation_time: e-folding time of an exponential correlation within a curve, in t*; 0 for independent frames.
    """

    scale: float = 1.0
    floor: float = 0.002
    slope: float = 1.0 / 50.0
    drift: float = 1.0 / 160.0
    correlation_time: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive = name in ("scale", "floor")
            if not (0.0 <= value < math.inf) or (positive and value == 0.0):
                raise InputDataError(f"Noise.{name} is {value}; expected a finite number {'> 0' if positive else '>= 0'}.")

    def sd(self, radius: Tensor, times: Tensor) -> Tensor:
        """Standard deviation of one frame; arguments dimensionless and broadcastable."""
        law = self.slope * (radius - 1.0).abs() + self.drift * times.abs()
        return self.scale * torch.sqrt(law.square() + self.floor**2)

    def decorrelation(self, times: Tensor, mask: Tensor) -> Tensor | None:
        """Inverse Cholesky factors of the correlation matrices: ``E x T x T``, or None for independent frames.

        Args:
            times: ``E x T`` tensor, dimensionless.
            mask: ``E x T`` boolean tensor, frames that count; the others are left independent.
        """
        if self.correlation_time == 0.0:
            return None
        gap = (times[:, :, None] - times[:, None, :]).abs()
        both = mask[:, :, None] & mask[:, None, :]
        correlation = torch.where(both, torch.exp(-gap / self.correlation_time), 0.0)
        eye = torch.eye(times.shape[1], dtype=times.dtype, device=times.device)
        correlation = torch.where(eye.bool(), eye, correlation)
        return torch.linalg.solve_triangular(torch.linalg.cholesky(correlation), eye, upper=False)

    def draw(self, radius: Tensor, times: Tensor, repeats: int, *, generator: torch.Generator) -> Tensor:
        """Noisy curves of one experiment: ``repeats x n_t`` from a true curve ``n_t``."""
        noise = torch.randn(repeats, times.shape[0], generator=generator, dtype=radius.dtype)
        decorrelate = self.decorrelation(times[None], torch.ones_like(times[None], dtype=torch.bool))
        if decorrelate is not None:
            noise = torch.linalg.solve_triangular(decorrelate[0], noise.mT, upper=False).mT
        return radius + self.sd(radius, times) * noise


def fit_noise(noise: Noise, residuals: list[Tensor], predictions: list[Tensor], times: list[Tensor]) -> Noise:
    """Maximum-likelihood scale and correlation time of residuals, keeping the shape of ``noise``.

    Args:
        noise: the law whose shape is kept.
        residuals: one ``n_t`` tensor per experiment, observed minus predicted R*.
        predictions: the predicted R* of each.
        times: their times, dimensionless.

    Returns:
        The law with its ``scale`` and ``correlation_time`` replaced.
    """
    unit = replace(noise, scale=1.0, correlation_time=0.0)
    count = sum(r.numel() for r in residuals)
    best: tuple[float, Noise] | None = None
    for correlation_time in _CORRELATION_TIMES:
        law = replace(unit, correlation_time=correlation_time)
        square, log_det = 0.0, 0.0
        for residual, prediction, t in zip(residuals, predictions, times, strict=True):
            whitened = residual / unit.sd(prediction, t)
            factor = law.decorrelation(t[None], torch.ones_like(t[None], dtype=torch.bool))
            if factor is not None:
                whitened = factor[0] @ whitened
                log_det -= 2.0 * float(factor[0].diagonal().log().sum())
            square += float(whitened.square().sum())
        cost = 0.5 * count * math.log(square / count) + 0.5 * log_det
        if best is None or cost < best[0]:
            best = cost, replace(law, scale=math.sqrt(square / count))
    assert best is not None
    return best[1]
