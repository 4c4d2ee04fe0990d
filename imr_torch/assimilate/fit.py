"""What an assimilation returns: for each model the fitted Gaussian, and the certificate that says whether to lean on it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.material import Belief, ModelBelief
from imr_torch.observe import ExperimentBatch


@dataclass(frozen=True)
class Certificate:
    """Evidence that a minimum was found, and found twice.

    Args:
        gradient: length of the gradient in posterior standard deviations; below the tolerance at a minimum.
        agreement: cost of the second best start minus that of the best, in nats; ``inf`` when only one start ended well.
        iterations: Gauss-Newton iterations of the best start.
        failed_members: share of ensemble members whose solve failed.
        converged: whether gradient and agreement are within the tolerances asked for.
    """

    gradient: float
    agreement: float
    iterations: int
    failed_members: float
    converged: bool

    def __str__(self) -> str:
        word = "converged" if self.converged else "NOT CONVERGED"
        return (
            f"{word} (gradient {self.gradient:.1e} sd, starts agree within {self.agreement:.2g} nats, "
            f"{self.iterations} iterations, {100 * self.failed_members:.1f} % of members failed)"
        )


@dataclass(frozen=True)
class ModelFit:
    """The fit of one model. The control ``v`` is the prior's own standard normal: ``z = mean + chol v``.

    Args:
        prior: the model's belief before the data.
        mean: ``d`` tensor, most probable ``v``.
        chol: ``d x d`` tensor, Cholesky factor of its covariance, nuisances marginalised.
        nuisances: ``E x 3`` tensor, standardised nuisances at the optimum.
        nuisance_response: ``E x 3 x d`` tensor, how they move with ``v``.
        nuisance_log_det: log determinant of the nuisances' Hessian.
        cost: negative log of likelihood x prior at the optimum, without the constants of the priors.
        prediction: ``E x T`` tensor, R/Rmax at the optimum.
        certificate: whether it converged.
    """

    prior: ModelBelief
    mean: Tensor
    chol: Tensor
    nuisances: Tensor
    nuisance_response: Tensor
    nuisance_log_det: float
    cost: float
    prediction: Tensor
    certificate: Certificate

    @property
    def model(self) -> str:
        """Key of the constitutive model."""
        return self.prior.model

    @property
    def posterior(self) -> ModelBelief:
        """The model's belief after the data."""
        mean = self.prior.mean + self.prior.chol @ self.mean
        return self.prior.with_gaussian(mean, torch.linalg.cholesky(_covariance(self.prior.chol @ self.chol)))

    def parameters(self, controls: Tensor) -> Tensor:
        """Shared parameter vectors at controls ``v``: ``... x d`` to ``... x p``, SI."""
        return self.prior.parameters(self.prior.mean + controls @ self.prior.chol.mT)


def _covariance(factor: Tensor) -> Tensor:
    return factor @ factor.mT


@dataclass(frozen=True)
class Assimilation:
    """The fits of all models to one batch of experiments.

    Args:
        prior: belief before the data.
        batch: the data.
        fits: one per model, in the order of the belief.
    """

    prior: Belief
    batch: ExperimentBatch
    fits: tuple[ModelFit, ...]

    @property
    def converged(self) -> bool:
        """Whether every model's fit carries a clean certificate."""
        return all(fit.certificate.converged for fit in self.fits)

    def __getitem__(self, model: str) -> ModelFit:
        return next(fit for fit in self.fits if fit.model == model)

    def rmse(self, model: str) -> float:
        """Root mean square residual of the mean curves in R*, over all frames in the window."""
        residual = (self.batch.mean - self[model].prediction)[self.batch.mask]
        return float(residual.square().mean().sqrt())

    def rmse_by_experiment(self, model: str) -> dict[str, float]:
        """The same for each experiment: one that stands out is of another gel, or wrongly scaled."""
        square = torch.where(self.batch.mask, self.batch.mean - self[model].prediction, 0.0).square().sum(1)
        values = (square / self.batch.mask.sum(1)).sqrt().tolist()
        return {e.label: value for e, value in zip(self.batch.experiments, values, strict=True)}
