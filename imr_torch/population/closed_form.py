"""The hierarchy of Gaussian shots in closed form: evidence, population centre and each shot, given
the scatter.

A shot's likelihood is ``exp(c - z A z / 2 + b z)`` of its controls ``z``, and ``z ~ N(m, T)`` with
the diagonal ``T`` of squared scatters; ``m`` has a Gaussian prior. Everything but ``T`` is then
integrated out exactly (Lindley & Smith, JRSS B 34, 1972). No inverse of ``A`` or ``T`` is taken, so
a shot may leave a direction open, and a scatter may be zero. The scatters that vary are integrated
over on a grid, whose cells :mod:`imr_torch.population.sampling` proposes scatters from.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import HalfNormal

from imr_torch.assimilate.gauss_newton import half_log_det
from imr_torch.float64 import eye, linspace, zeros
from imr_torch.material import ModelBelief
from imr_torch.types import (
    BatchControlMatrix,
    BatchControls,
    ControlMatrix,
    Controls,
    DrawnControls,
    DrawnValues,
    Values,
)

MOST = 4
"""Parameters that can differ from shot to shot, at most: the grid has as many axes."""


@dataclass(frozen=True)
class GaussianShots:
    """Likelihoods of the shots, Gaussian in the controls of each.

    Args:
        precision: ``E x d x d`` tensor ``A``, positive semidefinite.
        linear: ``E x d`` tensor ``b``.
        constant: ``E`` tensor ``c``, nats.

    >>> import torch
    >>> from imr_torch.population import GaussianShots
    >>> values = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)  # three shots seen with a standard error of .5
    >>> shots = GaussianShots(torch.full((3, 1, 1), 4.0).double(), 4.0 * values[:, None], -2.0 * values.square())
    >>> none, some = shots.given(torch.tensor([[0.0], [1.0]]).double(), torch.zeros(1).double(), torch.eye(1).double()).evidence
    >>> bool(some > none)  # they differ by more than their errors
    True
    """

    precision: BatchControlMatrix
    linear: BatchControls
    constant: Values

    def given(
        self,
        scatter: DrawnControls,
        mean: Controls,
        precision: ControlMatrix,
    ) -> "GivenScatter":
        """Evidence and posterior for given scatters.

        Args:
            scatter: standard deviations of the shots' controls about the population's.
            mean: prior mean of the population's controls.
            precision: prior precision of them.
        """
        A = self.precision
        b = self.linear
        root = scatter[:, None, :]
        inner = eye(A.shape[-1]) + root[..., :, None] * A * root[..., None, :]
        chol = torch.linalg.cholesky(inner)  # n x E x d x d
        # of the covariance of a shot given the centre
        factor = root[..., :, None] * torch.linalg.inv(chol).mT
        covariance = factor @ factor.mT
        moved = (covariance @ b[..., None])[..., 0]
        constant = self.constant - half_log_det(chol) + 0.5 * (b * moved).sum(-1)
        total = precision + (A - A @ covariance @ A).sum(1)
        slope = precision @ mean + (b - (A @ moved[..., None])[..., 0]).sum(1)
        total_chol = torch.linalg.cholesky(total)
        centre = torch.cholesky_solve(slope[..., None], total_chol)[..., 0]
        evidence = (
            constant.sum(1)
            + 0.5 * (slope * centre).sum(-1)
            - half_log_det(total_chol)
            + 0.5 * torch.logdet(precision)
            - 0.5 * mean @ precision @ mean
        )
        return GivenScatter(self, evidence, centre, total_chol, covariance, factor)


@dataclass(frozen=True)
class GivenScatter:
    """What follows from the shots for ``n`` given scatters.

    Args:
        shots: the shots.
        evidence: log density of all data, nats.
        centre: posterior mean of the population's controls.
        chol: Cholesky factor of their posterior precision.
        covariance: ``n x E x d x d`` tensor, of each shot's controls given the population's.
        factor: a square root of it.
    """

    shots: GaussianShots
    evidence: DrawnValues
    centre: DrawnControls
    chol: Float[Tensor, "draws controls controls"]
    covariance: BatchControlMatrix
    factor: BatchControlMatrix

    def shot_means(self, centre: DrawnControls) -> BatchControls:
        """Mean of each shot's controls given the population's: ``n x E x d``."""
        A = self.shots.precision
        b = self.shots.linear
        pull = b - (A @ centre[:, None, :, None])[..., 0]
        return centre[:, None] + (self.covariance @ pull[..., None])[..., 0]


@dataclass(frozen=True)
class Cells:
    """Cells of a grid over the scatters that vary, finer where these are small.

    Args:
        low: lower corners, of the controls.
        width: ``n x k`` tensor.
        log_prior: log probability of each under half-normal priors.
        evidence: log density of all data in the middle of each, nats.
    """

    low: Float[Tensor, "cells varying"]
    width: Float[Tensor, "cells varying"]
    log_prior: Float[Tensor, "cells"]
    evidence: Float[Tensor, "cells"]

    @property
    def weights(self) -> Float[Tensor, "cells"]:
        """``n`` tensor, posterior probability of each cell."""
        return torch.softmax(self.log_prior + self.evidence, 0)


def grid_scatters(
    shots: GaussianShots,
    prior: ModelBelief,
    scale: Controls,
    *,
    steps: Sequence[int] = (1, 400, 48, 20, 11),
    top: float = 6.0,
) -> Cells:
    """The grid with its prior and the evidence of the shots.

    Args:
        shots: the shots.
        prior: of the population's centre, in the model's controls.
        scale: scale of the half-normal prior of each scatter; 0 where it does not vary.
        steps: cells along each axis, by the number of axes.
        top: scales of the prior up to which the grid reaches.

    >>> import torch
    >>> from imr_torch import wide_prior
    >>> from imr_torch.population import GaussianShots
    >>> from imr_torch.population.closed_form import grid_scatters
    >>> values = torch.tensor([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]], dtype=torch.float64)  # G differs, mu does not
    >>> precision = 100.0 * torch.eye(2, dtype=torch.float64).expand(3, 2, 2)
    >>> shots = GaussianShots(precision, 100.0 * values, -50.0 * values.square().sum(1))
    >>> prior = wide_prior(["nhkv"])["nhkv"]
    >>> cells = [grid_scatters(shots, prior, scale) for scale in 0.3 * torch.eye(2, dtype=torch.float64)]
    >>> G, mu = (float((grid.log_prior + grid.evidence).logsumexp(0)) for grid in cells)  # log evidence, nats
    >>> G > mu
    True
    """
    varying = scale.nonzero()[:, 0]
    count = len(varying)
    ends = linspace(0.0, 1.0, steps[count] + 1).square() * top
    low = width = zeros(1, 0)
    if count:
        low, width = (
            torch.cartesian_prod(*[x] * count).reshape(-1, count) * scale[varying]
            for x in (ends[:-1], ends.diff())
        )
    middle = zeros(len(low), len(scale))
    middle[:, varying] = low + 0.5 * width
    log_prior = HalfNormal(scale[varying]).log_prob(middle[:, varying]).sum(
        1
    ) + width.log().sum(1)
    parts = [
        shots.given(x, prior.mean, prior.precision).evidence for x in middle.split(2000)
    ]
    return Cells(low, width, log_prior, torch.cat(parts))


def without_prior(
    mean: Controls,
    covariance: ControlMatrix,
    prior: ModelBelief,
) -> tuple[ControlMatrix, Controls]:
    """Precision and linear term of the likelihood whose posterior has these moments; directions
    wider than the prior are flat.

    Args:
        mean: of the controls.
        covariance: ``d x d`` tensor.
        prior: what is divided out.
    """
    precision = positive_part(torch.linalg.inv(covariance) - prior.precision)
    return precision, precision @ mean + prior.precision @ (mean - prior.mean)


def positive_part(matrix: ControlMatrix) -> ControlMatrix:
    """A symmetric matrix with its negative eigenvalues replaced by zero."""
    values, vectors = torch.linalg.eigh(matrix)
    return (vectors * values.clamp_min(0.0)) @ vectors.mT
