"""The integral over the scatters of Gaussian shots by quadrature: evidence and intervals without a
draw, to first order.

The cells of the grid are those that :mod:`imr_torch.population.sampling` proposes scatters from.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import HalfNormal

from imr_torch.material import ModelBelief
from imr_torch.population.closed_form import GaussianShots
from imr_torch.types import Controls

MOST = 4
"""Parameters that can differ from shot to shot, at most: the grid has as many axes."""

_CELLS = (1, 400, 48, 20, 11)  # along each axis, by the number of axes
_TOP = 6.0  # scales of the prior up to which the grid reaches
_CHUNK = 2000  # cells at once


@dataclass(frozen=True)
class Cells:
    """Cells of a grid over the scatters that vary, finer where these are small.

    Args:
        low: lower corners, of the controls.
        width: ``n x k`` tensor.
        middle: centres; 0 where a scatter does not vary.
        log_prior: log probability of each under half-normal priors.
        evidence: log density of all data in the middle of each, nats.
    """

    low: Float[Tensor, "cells varying"]
    width: Float[Tensor, "cells varying"]
    middle: Float[Tensor, "cells controls"]
    log_prior: Float[Tensor, "cells"]
    evidence: Float[Tensor, "cells"]

    @property
    def log_evidence(self) -> float:
        """The integral over the scatters, nats."""
        return float(torch.logsumexp(self.log_prior + self.evidence, 0))

    @property
    def weights(self) -> Float[Tensor, "cells"]:
        """``n`` tensor, posterior probability of each cell."""
        return torch.softmax(self.log_prior + self.evidence, 0)


def cells(shots: GaussianShots, prior: ModelBelief, scale: Controls) -> Cells:
    """The grid with its prior and the evidence of the shots.

    Args:
        shots: the shots.
        prior: of the population's centre, in the model's controls.
        scale: scale of the half-normal prior of each scatter; 0 where it does not vary.

    >>> import torch
    >>> from imr_torch import wide_prior
    >>> from imr_torch.population import GaussianShots
    >>> from imr_torch.population.quadrature import cells
    >>> values = torch.tensor([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]], dtype=torch.float64)  # G differs, mu does not
    >>> precision = 100.0 * torch.eye(2, dtype=torch.float64).expand(3, 2, 2)
    >>> shots = GaussianShots(precision, 100.0 * values, -50.0 * values.square().sum(1))
    >>> prior = wide_prior(["nhkv"])["nhkv"]
    >>> G, mu = (cells(shots, prior, scale).log_evidence for scale in 0.3 * torch.eye(2, dtype=torch.float64))
    >>> G > mu
    True
    """
    varying = torch.nonzero(scale)[:, 0].tolist()
    count = len(varying)
    size = len(scale)
    steps = torch.linspace(0.0, 1.0, _CELLS[count] + 1, dtype=torch.float64).square() * _TOP
    if count:
        corners = (
            torch.cartesian_prod(*[x] * count).reshape(-1, count)
            for x in (steps[:-1], steps.diff())
        )
        low, width = (x * scale[varying] for x in corners)
    else:
        low = width = torch.zeros(1, 0, dtype=torch.float64)
    middle = torch.zeros(len(low), size, dtype=torch.float64)
    middle[:, varying] = low + 0.5 * width
    log_prior = HalfNormal(scale[varying]).log_prob(middle[:, varying]).sum(1) + width.log().sum(1)
    precision = torch.cholesky_inverse(prior.chol)
    evidence = torch.cat(
        [shots.given(rows, prior.mean, precision).evidence for rows in middle.split(_CHUNK)]
    )
    return Cells(low, width, middle, log_prior, evidence)
