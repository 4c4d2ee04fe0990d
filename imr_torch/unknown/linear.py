"""Linear refits beside what may be missing: whitened rows of data and priors, their least squares
and evidence.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.float64 import eye, zeros


@dataclass(frozen=True)
class Refit:
    """A linear refit beside what may be missing.

    Args:
        solution: change of what is fitted, then the unknown's weights in standard deviations.
        chol: Cholesky factor of their precision.
        misfit: whitened squared residual that is left, the priors' part included.

    >>> import torch
    >>> from imr_torch.unknown.linear import LinearSystem
    >>> one = torch.ones(1, 1, dtype=torch.float64)
    >>> refit = LinearSystem(one[0], 0.0 * one[:, :0], one).solve(1.0)  # as much noise as unknown
    >>> round(float(refit.solution), 3), round(float(refit.root.square()), 3)
    (0.5, 0.5)
    """

    solution: Float[Tensor, "columns"]
    chol: Float[Tensor, "columns columns"]
    misfit: float

    @property
    def log_volume(self) -> float:
        """Log evidence, nats, but for the misfit and a constant that all unknowns share."""
        return -float(self.chol.diagonal().log().sum())

    @property
    def log_evidence(self) -> float:
        """Nats, without that constant."""
        return self.log_volume - 0.5 * self.misfit

    @cached_property
    def root(self) -> Float[Tensor, "columns columns"]:
        """A square root of the covariance of the solution."""
        return torch.linalg.solve_triangular(
            self.chol.mT, eye(len(self.solution)), upper=True
        )


@dataclass(frozen=True)
class LinearSystem:
    """Whitened rows of all data and priors about a state: ``residual = fitted d + unknown w +
    noise``, with ``d`` a change, whose prior is among the rows, and ``w`` whole.

    Args:
        residual: of data and priors.
        fitted: changes by everything that is fitted.
        unknown: changes by what may be missing, at its usual size.
    """

    residual: Float[Tensor, "rows"]
    fitted: Float[Tensor, "rows coordinates"]
    unknown: Float[Tensor, "rows weights"]

    def solve(self, size: float) -> Refit:
        """The refit with an unknown of so many usual sizes."""
        columns = torch.cat((self.fitted, size * self.unknown), 1)
        free = zeros(columns.shape[1])
        free[self.fitted.shape[1] :] = 1.0
        chol = torch.linalg.cholesky(columns.mT @ columns + free.diag())
        seen = columns.mT @ self.residual
        solution = torch.cholesky_solve(seen[:, None], chol)[:, 0]
        return Refit(solution, chol, float(self.residual.square().sum() - seen @ solution))
