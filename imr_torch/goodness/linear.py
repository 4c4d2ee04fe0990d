"""Local sensitivities at a fit: the residual and its derivatives in all that was fitted, whitened.

At a fit everything that was fitted (gel, effects, nuisances, each with its prior) spans a space of
directions in which the fit has absorbed the residual. Of a test direction only the part orthogonal
to them counts. Data and priors are stacked as rows of unit variance: ``r ~ N(0, 1 - Q Q^T)`` if the
model is right.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit, Neighbourhood
from imr_torch.float64 import eye, zeros
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator
from imr_torch.types import BatchFrames, ExperimentFrames

Rows = Float[Tensor, "*batch rows"]
"""Whitened curves, and the priors behind them."""


@dataclass(frozen=True)
class Linearisation:
    """A fit and its directions.

    Args:
        residual: ``N`` tensor, whitened; data first, then the priors of gel and nuisances.
        fitted: ``N x k`` tensor, sensitivities to all that was fitted.
        near: the bubbles at the fit and beside it.
    """

    residual: Float[Tensor, "rows"]
    fitted: Float[Tensor, "rows fitted"]
    near: Neighbourhood

    @property
    def batch(self) -> ExperimentBatch:
        """The data."""
        return self.near.posterior.batch

    @property
    def prediction(self) -> ExperimentFrames:
        """``E x T`` tensor, R/Rmax at the fit."""
        return self.near.centre

    @cached_property
    def sd(self) -> ExperimentFrames:
        """``E x T`` tensor, noise of one repeat at the fit."""
        return self.batch.sd(self.prediction)

    @property
    def basis(self) -> Float[Tensor, "rows fitted"]:
        """``N x k`` orthonormal basis of the fitted directions."""
        return self._factors[0]

    @cached_property
    def to_shift(self) -> Float[Tensor, "fitted rows"]:
        """``k x N`` matrix that makes, from a residual, the shift of everything fitted in a linear
        refit to it.
        """
        q, r = self._factors
        return torch.linalg.solve_triangular(r, q.mT, upper=True)

    @cached_property
    def _factors(self) -> tuple[Tensor, Tensor]:
        return torch.linalg.qr(self.fitted)

    def noise_ratios(
        self, count: int, *, generator: torch.Generator
    ) -> Float[Tensor, "draws rows"]:
        """Noise drawn from what is known of it, over that by which rows are whitened.

        1 for priors and 0 in the padding.
        """
        ratios = self.batch.log_noise_ratios(
            self.prediction, count, generator=generator
        ).exp()
        return self.pad_rows(torch.where(self.batch.mask, ratios, 0.0).flatten(1), 1.0)

    def pad_rows(self, rows: Float[Tensor, "*batch data"], value: float = 0.0) -> Rows:
        """Rows of data with those of the priors, which have one value."""
        missing = len(self.residual) - rows.shape[-1]
        return torch.nn.functional.pad(rows, (0, missing), value=value)

    def explained_rows(self, shift: Float[Tensor, "*batch fitted"]) -> Rows:
        """What shifts ``... x k`` of everything fitted change in the data, to first order: rows
        ``... x N``.
        """
        rows = shift @ self.fitted.mT
        return self.pad_rows(rows[..., : self.batch.mask.numel()])

    def whiten(self, curves: BatchFrames) -> Rows:
        """Curves ``... x E x T`` in R* as rows ``... x N``, with zeros for the priors."""
        seen = torch.where(self.batch.mask, curves, 0.0)
        return self.pad_rows(self.batch.whiten(seen, self.sd).flatten(-2))

    def project_out(self, rows: Rows) -> Rows:
        """What is left of rows ``... x N`` beside the fitted directions."""
        return rows - (rows @ self.basis) @ self.basis.mT


def predict_changes(
    line: Linearisation,
    changes: Sequence[dict[str, float]],
    shift: Float[Tensor, "moved fitted"] | float = 0.0,
) -> Float[Tensor, "moved experiments frames"]:
    """What other values of parameters change in the prediction at a fit, one row a change: ``K x E
    x T``; NaN where a solve failed.

    Args:
        line: the fit.
        changes: parameters that take other values.
        shift: ``K x k`` tensor by which everything fitted is moved besides.
    """
    batch = line.batch
    if not changes:
        return zeros(0, *batch.times.shape)
    posterior = line.near.posterior
    coordinates = line.near.coordinates.expand(len(changes), -1)
    point = posterior.point_at(coordinates + shift)
    parameters = posterior.prior.to_si(point.gel).clone()
    for row, change in zip(parameters, changes, strict=True):
        for name, value in change.items():
            row[PARAMETERS.index([name])[0]] = value
    shifts = point.nuisances * batch.nuisance_sds
    return predict(posterior.simulator, parameters, batch, shifts) - line.prediction


def linearise_fit(
    fit: ModelFit, batch: ExperimentBatch, simulator: Simulator
) -> Linearisation:
    """Local sensitivities at a fit, by finite differences of bubbles that take the same solver
    steps.
    """
    return whiten_rows(fit.linearise(batch, simulator))


def whiten_rows(near: Neighbourhood) -> Linearisation:
    """The residual and the sensitivities of a point as rows of unit variance."""
    batch = near.posterior.batch
    sd = batch.sd(near.centre)
    data = batch.whiten(near.jacobian, sd).nan_to_num().flatten(1).mT
    fitted = torch.cat((data, -eye(data.shape[1])))
    observed = batch.whiten(batch.mean - near.centre, sd).flatten()
    residual = torch.cat((observed, near.coordinates))
    return Linearisation(residual, fitted, near)
