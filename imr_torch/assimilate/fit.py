"""Results of an assimilation: the fitted Gaussian of each model, whether the fit converged, and
whether a Gaussian suffices.

The certificate says whether the optimum was found; the importance sample, once
:func:`imr_torch.assimilate.weigh` has drawn it, says whether the Gaussian about the optimum
approximates the posterior, and gives corrected moments where not.
"""

from dataclasses import dataclass, replace
from enum import Enum

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.gauss_newton import half_log_det
from imr_torch.assimilate.importance import (
    ImportanceSample,
    largest_shape,
    weighted_quantiles,
)
from imr_torch.assimilate.posterior import Neighbourhood, Posterior
from imr_torch.float64 import tensor
from imr_torch.material import Belief, Cloud, ModelBelief
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator
from imr_torch.types import (
    BatchControls,
    BatchNuisances,
    BatchParameters,
    ColumnNumbers,
    ControlMatrix,
    Controls,
    CoordinateMatrix,
    ExperimentFrames,
    Nuisances,
)

PROMISED = 2.0
"""Times the square of its gradient (in posterior standard deviations) that the cost of a start may still fall, nats: four times
what a Gauss-Newton step predicts."""

NEARLY = 0.1
"""Gradient in posterior standard deviations, and nats between starts, below which a fit has nearly converged: its cost can fall
by about a hundredth of a nat."""

ONE_MINIMUM = 0.5
"""Cost difference, nats, within which two fits are of one minimum: solver steps alone change costs by up to some .3."""

CONFIRMED = 0.05
"""Nats between Gaussians up to which draws confirm a fit: a mean a third of an sd off, or an sd
20 % off."""

REPEATED = 0.1
"""The same between two rounds of draws, each with its error."""

CLOUD_DRAWS = 64
"""Draws that represent a curved posterior in a belief."""


@dataclass(frozen=True)
class Certificate:
    """Convergence of a fit: the gradient at its end, and the agreement between its two best starts.

    Args:
        gradient: length of the gradient in posterior standard deviations; below the tolerance at a
            minimum.
        agreement: cost of the second best start minus that of the best, in nats; ``inf`` when only
            one start ended well. Of ensemble 4D-Var, the difference between the costs at the ends
            of the last two cycles.
        iterations: Gauss-Newton iterations of the best start.
        failed_members: share of ensemble members whose solve failed.
        converged: whether gradient and agreement are within the tolerances asked for.
        compared: what the agreement is of, ``"starts"`` or ``"cycles"``.

    >>> from imr_torch.assimilate import Certificate
    >>> certificate = Certificate(gradient=2e-4, agreement=1e-3, iterations=9, failed_members=0.0, converged=True)
    >>> print(certificate)
    converged (gradient 2.0e-04 sd, starts agree within 0.001 nats, 9 iterations, 0.0 % of members
    failed)
    """

    gradient: float
    agreement: float
    iterations: int
    failed_members: float
    converged: bool
    compared: str = "starts"

    @property
    def nearly_converged(self) -> bool:
        """Whether gradient and agreement are below 0.1: the cost can then fall by about a hundredth
        of a nat.
        """
        return self.gradient < NEARLY and self.agreement < NEARLY

    @property
    def usable(self) -> bool:
        """Whether it has converged or nearly so: no conclusion would change by the hundredth of a
        nat that is left.
        """
        return self.converged or self.nearly_converged

    def __str__(self) -> str:
        word = "converged" if self.converged else "NOT CONVERGED"
        return (
            f"{word} (gradient {self.gradient:.1e} sd, {self.compared} agree within "
            f"{self.agreement:.2g} nats, "
            f"{self.iterations} iterations, {100 * self.failed_members:.1f} % of members failed)"
        )


class Verdict(Enum):
    """Whether the Gaussian approximation of a posterior is to be used.

    >>> from imr_torch.assimilate import Verdict
    >>> Verdict.REPAIRED.value
    'repaired'
    """

    UNCHECKED = "unchecked"
    TRUSTED = "trusted"
    REPAIRED = "repaired"
    REFUSED = "not reliable"


@dataclass(frozen=True)
class ModelFit:
    """The fit of one model. The control ``v`` is the prior's own standard normal: ``z = mean + chol
    v``.

    Args:
        prior: the model's belief before the data.
        mean: most probable ``v``.
        chol: Cholesky factor of its covariance, nuisances marginalised.
        nuisances: standardised nuisances at the optimum.
        nuisance_response: how they move with ``v``.
        nuisance_chol: lower Cholesky factors of the nuisances' Hessian.
        cost: negative log of likelihood x prior at the optimum, without the constants of the
            priors.
        prediction: R/Rmax at the optimum.
        certificate: whether it converged.
        sample: draws weighted by the exact posterior; None before
            :func:`imr_torch.assimilate.weigh`.
        near: the simulated optimum and the points beside it; None where they were not.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions, assimilate
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> options = SearchOptions(raw_samples=16, starts=2)
    >>> fits = assimilate(case.prior, ExperimentBatch((shot,)), simulator, seed=0, options=options)
    >>> posterior = fits["nhkv"].posterior
    >>> posterior.names, [round(float(sd / mean), 2) for mean, sd in zip(posterior.means, posterior.sds)]
    (('G', 'mu'), [0.01, 0.01])
    """

    prior: ModelBelief
    mean: Controls
    chol: ControlMatrix
    nuisances: Nuisances
    nuisance_response: Float[Tensor, "experiments nuisances controls"]
    nuisance_chol: Float[Tensor, "experiments nuisances nuisances"]
    cost: float
    prediction: ExperimentFrames
    certificate: Certificate
    sample: ImportanceSample | None = None
    near: Neighbourhood | None = None

    @classmethod
    def about(cls, near: Neighbourhood, certificate: Certificate) -> "ModelFit":
        """The fit of a point that was simulated, with the Gaussian of its local sensitivities."""
        equations = near.equations
        return cls(
            near.posterior.prior,
            near.point.gel,
            equations.posterior_chol,
            near.point.nuisances,
            equations.reduced.nuisance_response,
            torch.linalg.cholesky(equations.nuisance_hessian),
            -float(near.log_joint),
            near.centre,
            certificate,
            near=near,
        )

    def linearise(self, batch: ExperimentBatch, simulator: Simulator) -> Neighbourhood:
        """The optimum with its local sensitivities under the noise of a batch.

        Those that the fit ended with where they are of the same bubbles; simulated anew where not.

        Args:
            batch: the data that were fitted, perhaps with another noise.
            simulator: makes the bubbles.
        """
        posterior = Posterior(self.prior, batch, simulator)
        near = self.near
        if near is None or not near.is_of(posterior, self.point):
            return posterior.neighbourhood(self.point)
        return replace(near, posterior=posterior)

    def far_behind(
        self, best: float, *, converged: float = 20.0, unconverged: float = 100.0
    ) -> bool:
        """Whether the cost is far above another, by more than further fitting can lower it.

        Args:
            best: the lowest cost of all models, nats.
            converged: nats above it from which a nearly converged fit is discarded.
            unconverged: the same of another, after the decrease that its gradient allows.
        """
        if self.certificate.nearly_converged:
            return self.cost > best + converged
        return self.cost - PROMISED * self.certificate.gradient**2 > best + unconverged

    @property
    def point(self) -> Point:
        """The optimum."""
        return Point(self.mean, self.nuisances)

    @property
    def model(self) -> str:
        """Key of the constitutive model."""
        return self.prior.model

    def of_curves(self, batch: ExperimentBatch) -> "tuple[ModelFit, ExperimentBatch]":
        """The fit and its data without shots of collapse times, as if the curves alone had been
        fitted; no draws if any left.

        Args:
            batch: the data.
        """
        rows = ~batch.collapse
        if rows.all():
            return self, batch
        part = replace(
            self,
            nuisances=self.nuisances[rows],
            nuisance_response=self.nuisance_response[rows],
            nuisance_chol=self.nuisance_chol[rows],
            prediction=self.prediction[rows, : int(batch.mask[rows].sum(1).max())],
            sample=None,
            near=None,
        )
        return part, replace(batch, experiments=batch.curves)

    @property
    def nuisance_log_det(self) -> float:
        """Log determinant of the nuisances' Hessian."""
        return 2.0 * float(half_log_det(self.nuisance_chol).sum())

    @property
    def posterior(self) -> ModelBelief:
        """The belief after the data, in controls a Gaussian.

        ``TRUSTED``: the fitted one with its mean and covariance corrected by the weighted draws.
        ``REPAIRED``: with the moments of the weighted draws, and 64 of these for its shape. Else
        the fitted one.
        """
        if self.verdict is not Verdict.REPAIRED:
            mean = self.mean
            chol = self.chol
            if self.sample is not None and self.verdict is Verdict.TRUSTED:
                mean, chol = self.sample.correct_gaussian(mean, chol)
            return self._with_gaussian(mean, chol @ chol.mT)
        sample = self.sample
        assert sample is not None
        belief = self._with_gaussian(sample.mean, sample.covariance)
        if sample.precisions is None:
            return belief
        chosen = sample.space_draws(CLOUD_DRAWS)
        unscale = torch.linalg.inv(self.prior.chol)
        levels = torch.special.ndtr(tensor(Cloud.SCORES))
        columns = self.prior.unwhitened(sample.controls).unbind(1)
        marginals = torch.stack(
            [weighted_quantiles(column, sample.weights, levels) for column in columns], 1
        )
        precisions = unscale.mT @ sample.precisions[chosen] @ unscale
        return belief.with_cloud(
            Cloud(self.prior.unwhitened(sample.controls[chosen]), precisions, marginals)
        )

    def _with_gaussian(self, mean: Tensor, covariance: Tensor) -> ModelBelief:
        """The prior with a Gaussian of ``v``."""
        covariance = self.prior.chol @ covariance @ self.prior.chol.mT
        return self.prior.with_gaussian(
            self.prior.unwhitened(mean), torch.linalg.cholesky(covariance)
        )

    @property
    def verdict(self) -> Verdict:
        """Whether the fitted Gaussian has the moments of the posterior.

        ``TRUSTED``: importance weights are reliable and, with the noise that the fit was made with,
        confirm its mean and covariance. ``REPAIRED``: they are reliable and give other moments,
        which agree with those of the round before, or those that the proposal was made for.
        ``REFUSED``: neither.
        """
        sample = self.sample
        if sample is None:
            return Verdict.UNCHECKED
        if (
            sample.reliable
            and sample.as_fitted.divergence_from(self.mean, self.chol) < CONFIRMED
        ):
            return Verdict.TRUSTED
        return (
            Verdict.REPAIRED
            if sample.reliable and sample.surprise < REPEATED
            else Verdict.REFUSED
        )

    @property
    def trust(self) -> str:
        """The verdict with its reasons and what to quote, one line."""
        if self.sample is None:
            return "no draws were weighted: the intervals are those of a Gaussian about the optimum"
        sample = self.sample
        shape = f"k {sample.pareto_k:.2f}"
        if sample.rounds > 1:
            shape = f"k {sample.first_shape:.2f}, {sample.pareto_k:.2f} after {sample.rounds} rounds"
        shape += f", effective {sample.effective_samples:.0f} of {len(sample)}"
        if self.verdict is Verdict.TRUSTED:
            return f"interval computation checked: weighted draws confirm the Gaussian fit ({shape})"
        if self.verdict is Verdict.REPAIRED:
            moved = (
                (sample.mean - self.mean).abs() / torch.linalg.norm(self.chol, dim=1)
            ).amax()
            return (
                f"interval computation repaired: from weighted draws, {float(moved):.2f} sd from the "
                f"Gaussian fit at most ({shape})"
            )
        limit = largest_shape(len(sample))
        why = "their moments are not yet those of the round before"
        if sample.pareto_k > limit:
            why = f"k is above {limit:.2f}"
        elif not sample.reliable:
            why = "too few are effective"
        return f"intervals not reliable: quote none of this model ({shape}; {why})"

    def nuisances_at(self, controls: BatchControls) -> BatchNuisances:
        """Most probable nuisances given the gel, linearised."""
        deviation = controls - self.mean
        return (
            self.nuisances
            + (self.nuisance_response @ deviation[..., None, :, None])[..., 0]
        )

    def joint_chol(self, columns: ColumnNumbers) -> CoordinateMatrix:
        """Cholesky factor of the covariance of the gel and some nuisances of each experiment, in the
        order of :meth:`imr_torch.assimilate.ForwardModel.coordinates_of`.
        """
        hessian = self.nuisance_chol[:, columns][:, :, columns]
        own = torch.block_diag(*torch.linalg.cholesky(torch.cholesky_inverse(hessian)))
        along = self.nuisance_response[:, columns].flatten(0, 1) @ self.chol
        above = along.new_zeros(len(self.chol), len(along))
        return torch.cat((torch.cat((self.chol, above), 1), torch.cat((along, own), 1)))

    def parameters(self, controls: BatchControls) -> BatchParameters:
        """Shared parameter vectors at controls ``v``, SI."""
        return self.prior.to_si(controls)


@dataclass(frozen=True)
class Assimilation:
    """The fits of all models to one batch of experiments.

    Args:
        prior: belief before the data.
        batch: the data.
        fits: one per model, in the order of the belief.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions, assimilate
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> options = SearchOptions(raw_samples=16, starts=2)
    >>> fits = assimilate(case.prior, ExperimentBatch((shot,)), simulator, seed=0, options=options)
    >>> fits.converged, [fit.model for fit in fits.fits]
    (True, ['nhkv', 'gen_qkv'])
    >>> round(fits.rmse("nhkv"), 4)  # in R*
    0.0105
    """

    prior: Belief
    batch: ExperimentBatch
    fits: tuple[ModelFit, ...]

    @property
    def converged(self) -> bool:
        """Whether every model's fit converged, or has a cost so far above the best that its
        probability is practically zero.

        A model that misses the data has large residuals, with which Gauss-Newton may not reach the
        tolerance of the gradient, and its starts may have been dropped
        (``SearchOptions.drop_behind``).
        """
        return all(
            fit.certificate.converged or fit.far_behind(self.lowest.cost)
            for fit in self.fits
        )

    @property
    def lowest(self) -> ModelFit:
        """The fit of lowest cost."""
        return min(self.fits, key=lambda fit: fit.cost)

    def __getitem__(self, model: str) -> ModelFit:
        self.prior[model]  # which names those that there are, if it is none of them
        return next(fit for fit in self.fits if fit.model == model)

    def rmse(self, model: str) -> float:
        """Root mean square residual of the mean curves in R*, over all frames in the window.

        Of collapse times alone in t*.
        """
        mask = self.batch.mask
        curves = mask & ~self.batch.collapse[:, None]
        frames = curves if curves.any() else mask
        return float(self._residual(model)[frames].square().mean().sqrt())

    def rmse_by_experiment(self, model: str) -> dict[str, float]:
        """The same for each curve, or each shot if there are none.

        One that stands out is of another gel, or wrongly scaled.
        """
        square = self._residual(model).square().sum(1)
        values = (square / self.batch.mask.sum(1)).sqrt().tolist()
        times = self.batch.collapse.tolist()
        rows = zip(self.batch.experiments, values, times, strict=True)
        return {e.label: value for e, value, is_time in rows if not is_time or all(times)}

    def _residual(self, model: str) -> ExperimentFrames:
        return torch.where(self.batch.mask, self.batch.mean - self[model].prediction, 0.0)
