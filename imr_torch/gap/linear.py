"""The neighbourhood of a fit: residual, fitted directions and test directions, whitened and side by side.

At a fit everything that was fitted (gel, effects, nuisances, each with its prior) spans a space of directions in which a
residual says nothing. A test direction counts by what of it is left beside them. Data and priors are stacked as rows of unit
variance: ``r ~ N(0, 1 - Q Q^T)`` if the model is right.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator

_STEP = 1e-4  # control step of lock-step differences


@dataclass(frozen=True)
class Linearisation:
    """A fit and its directions.

    Args:
        residual: ``N`` tensor, whitened; data first, then the priors of gel and nuisances.
        fitted: ``N x k`` tensor, sensitivities to all that was fitted.
        prediction: ``E x T`` tensor, R/Rmax.
        sd: ``E x T`` tensor, noise of one repeat.
        batch: the data.
    """

    residual: Tensor
    fitted: Tensor
    prediction: Tensor
    sd: Tensor
    batch: ExperimentBatch

    @cached_property
    def basis(self) -> Tensor:
        """``N x k`` orthonormal basis of the fitted directions."""
        return torch.linalg.qr(self.fitted).Q

    def whiten(self, curves: Tensor) -> Tensor:
        """Curves ``... x E x T`` in R* as rows ``... x N``, with zeros for the priors."""
        rows = self.batch.whiten(torch.where(self.batch.mask, curves, 0.0), self.sd).flatten(-2)
        return torch.nn.functional.pad(rows, (0, self.residual.shape[0] - rows.shape[-1]))

    def project(self, rows: Tensor) -> Tensor:
        """What is left of rows ``... x N`` beside the fitted directions."""
        return rows - (rows @ self.basis) @ self.basis.mT


def controls_of(fit: ModelFit, values: dict[str, float] | None = None) -> Tensor:
    """The fit's parameters (``p`` tensor, SI), with some set to other values."""
    parameters = fit.parameters(fit.mean).clone()
    for name, value in (values or {}).items():
        parameters[PARAMETERS.index([name])[0]] = value
    return parameters


def curves(fit: ModelFit, batch: ExperimentBatch, simulator: Simulator, changes: Sequence[dict[str, float]]) -> Tensor:
    """Predictions at the fit with parameters changed, one row a change: ``K x E x T``; NaN where a solve failed."""
    if not changes:
        return torch.empty(0, *batch.times.shape, dtype=torch.float64)
    parameters = torch.stack([controls_of(fit, change) for change in changes])
    shifts = (fit.nuisances * batch.nuisance_sds).expand(len(changes), -1, -1)
    return predict(simulator, parameters, batch, shifts)


def linearise(fit: ModelFit, batch: ExperimentBatch, simulator: Simulator) -> Linearisation:
    """The neighbourhood of a fit, by differences of bubbles in lock step."""
    size, experiments = len(fit.mean), len(batch.experiments)
    columns = torch.nonzero((batch.nuisance_sds > 0.0).any(0))[:, 0].tolist()
    count = 1 + size + len(columns)
    controls = fit.mean.expand(count, -1).clone()
    nuisances = fit.nuisances.expand(count, -1, -1).clone()
    controls[1 : 1 + size] += _STEP * torch.eye(size, dtype=torch.float64)
    for row, column in enumerate(columns, start=1 + size):
        nuisances[row, :, column] += _STEP
    parameters, shifts = fit.parameters(controls), nuisances * batch.nuisance_sds
    prediction = predict(simulator, parameters[None], batch, shifts[None], bundled=True)[0]
    prediction = torch.where(batch.mask, prediction, 0.0)
    sd = batch.sd(prediction[0])
    slopes = batch.whiten((prediction[1:] - prediction[0]) / _STEP, sd)  # k x E x T
    by_gel = slopes[:size].flatten(1).mT
    own = torch.eye(experiments, dtype=torch.float64)[:, :, None] * slopes[size:, None]  # C x E x E x T
    by_nuisance = own.flatten(0, 1).flatten(1).mT
    data = torch.cat((by_gel, by_nuisance), 1)
    fitted = torch.cat((data, -torch.eye(data.shape[1], dtype=torch.float64)))
    priors = torch.cat((fit.mean, fit.nuisances[:, columns].mT.flatten()))
    residual = torch.cat((batch.whiten(batch.mean - prediction[0], sd).flatten(), priors))
    return Linearisation(residual, fitted, prediction[0], sd, batch)
