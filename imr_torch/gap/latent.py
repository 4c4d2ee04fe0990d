"""Estimate of a far-field pressure that would explain the residual (weak-constraint 4D-Var).

The Keller-Miksis balance is given a pressure ``w(t*)`` (over p_inf) that is the same in all
experiments, with a Gaussian process prior (Matern 3/2), and it is estimated together with
everything that was fitted; its size and its correlation time are those of largest evidence (type
II). Linear: the response to ``w`` is that to small pulses at the fit. After Tremolet (Q. J. R.
Meteorol. Soc. 132, 2006) for the weak constraint, Rasmussen & Williams (2006), section 5.4.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.errors import InputDataError
from imr_torch.goodness.linear import Linearisation, curves
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator

CAVEAT = (
    "A latent pressure measures driving that the model lacks (a sound field, a reflected pulse). "
    "It does not measure an error "
    "of the constitutive law: modulus and viscosity take that up."
)

_PULSE = (
    0.005  # amplitude of the pulses, of p_inf: small against all that moves a collapse by a frame
)
_SIZES = (0.001, 0.003, 0.01, 0.03, 0.1)  # standard deviations of w, of p_inf
_LENGTHS = (0.1, 0.2, 0.4, 0.8)  # correlation times, in Rmax/U_c


@dataclass(frozen=True)
class LatentPressure:
    """A pressure in the far field, over p_inf, common to all experiments.

    Args:
        times: ``K`` tensor of knots, dimensionless.
        mean: ``K`` tensor, posterior mean of ``w``.
        sd: ``K`` tensor, its posterior standard deviation.
        size: standard deviation of the prior that has the largest evidence.
        length: its correlation time.
        log_bayes: log evidence over that of no latent pressure, nats (the best of the priors tried;
            0 if none gains).
        caveat: what the result does not say.
    """

    times: Float[Tensor, "knots"]
    mean: Float[Tensor, "knots"]
    sd: Float[Tensor, "knots"]
    size: float
    length: float
    log_bayes: float
    caveat: str = CAVEAT


def latent_pressure(
    fit: ModelFit,
    line: Linearisation,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    knots: int = 27,
) -> LatentPressure:
    """The far-field pressure that would explain the residual of a fit, with everything that was
    fitted free as well.

    Args:
        fit: the base model's fit.
        line: local sensitivities at the fit.
        batch: the data.
        simulator: makes the bubbles, one a knot and experiment.
        knots: times at which the pressure is estimated.

    Raises:
        InputDataError: with fewer than four knots.
    """
    if knots < 4:
        raise InputDataError(f"latent_pressure needs at least 4 knots, got {knots}.")
    times = torch.linspace(0.0, float(batch.times[batch.mask].max()), knots, dtype=torch.float64)
    response = line.project(_responses(fit, line, batch, simulator, times))
    information = response @ response.mT
    score = response @ line.residual
    best: tuple[float, float, float, Tensor, Tensor] | None = None
    for size in _SIZES:
        for length in _LENGTHS:
            evidence, mean, covariance = _posterior(
                information, score, size * matern(times, length)
            )
            if best is None or evidence > best[0]:
                best = evidence, size, length, mean, covariance
    assert best is not None
    evidence, size, length, mean, covariance = best
    return LatentPressure(
        times, mean, covariance.diagonal().clamp_min(0.0).sqrt(), size, length, max(evidence, 0.0)
    )


def matern(times: Float[Tensor, "knots"], length: float) -> Float[Tensor, "knots knots"]:
    """Cholesky factor of the Matern-3/2 correlation at times (``K`` tensor) for a correlation time:
    ``K x K``.
    """
    gap = math.sqrt(3.0) * (times[:, None] - times).abs() / length
    eye = torch.eye(len(times), dtype=times.dtype)
    return torch.linalg.cholesky((1.0 + gap) * torch.exp(-gap) + 1e-10 * eye)


def _responses(
    fit: ModelFit, line: Linearisation, batch: ExperimentBatch, simulator: Simulator, times: Tensor
) -> Tensor:
    """Whitened change of the curves by a unit of ``w`` at each knot, between which it is
    interpolated by pulses: ``K x N``.
    """
    width = float(times[1] - times[0])
    changes = [
        {"pulse": sign * _PULSE, "pulse_time": t, "pulse_width": math.log(width)}
        for t in times.tolist()
        for sign in (1, -1)
    ]
    both = curves(fit, batch, simulator, changes)
    pulses = line.whiten(((both[0::2] - both[1::2]) / (2.0 * _PULSE)).nan_to_num())
    values = torch.exp(
        -(((times[:, None] - times) / width) ** 2)
    )  # of each pulse (column) at each knot
    return torch.linalg.solve(values.mT, pulses)


def _posterior(information: Tensor, score: Tensor, root: Tensor) -> tuple[float, Tensor, Tensor]:
    """Log evidence over none, mean and covariance of ``w = root u``, ``u ~ N(0, 1)``."""
    precision = torch.eye(len(root), dtype=root.dtype) + root.mT @ information @ root
    chol = torch.linalg.cholesky(precision)
    half = torch.linalg.solve_triangular(chol, (root.mT @ score)[:, None], upper=False)
    evidence = 0.5 * float(half.square().sum()) - float(chol.diagonal().log().sum())
    factor = torch.linalg.solve_triangular(chol, root.mT, upper=False)
    return evidence, (factor.mT @ half)[:, 0], factor.mT @ factor
