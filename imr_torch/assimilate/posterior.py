"""The posterior of one model's gel and of the nuisances of every experiment: its density and its
linearisation at any point.

Prior, data and simulator are combined here and nowhere else: fits, importance sampling, Hamiltonian
Monte Carlo and the tests of the model's misfit all ask this object. Coordinates and sensitivities
are those of :mod:`imr_torch.assimilate.forward`.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate.forward import ForwardModel, Point
from imr_torch.assimilate.gauss_newton import NormalEquations, normal_equations
from imr_torch.float64 import eye
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import coarser
from imr_torch.types import (
    BatchCoordinates,
    BatchFrames,
    BundleFrames,
    GelSlopes,
    NuisanceSlopes,
    RowNumbers,
    Values,
)


@dataclass(frozen=True)
class Posterior(ForwardModel):
    """Likelihood times prior of one model.

    Args:
        prior: of the gel.
        batch: the experiments, with their noise and the priors of their nuisances.
        simulator: makes the bubbles.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import Point, Posterior
    >>> from imr_torch.observe import Experiment, ExperimentBatch
    >>> times, radius = torch.tensor([[0.0, 0.5, 1.0], [1.0, 0.84, 0.31]], dtype=torch.float64)
    >>> batch = ExperimentBatch((Experiment("shot 1", (400.0, 0.22), times, radius[None]),))
    >>> posterior = Posterior(wide_prior(["nhkv"])["nhkv"], batch, PolytropicSimulator())
    >>> gels = torch.tensor([[0.0, 0.0], [0.5, 0.0]], dtype=torch.float64)  # the prior median, and a stiffer gel
    >>> [round(x) for x in posterior.log_joint(Point(gels, posterior.mean_nuisances(2))).tolist()]
    [4, -17]
    """

    batch: ExperimentBatch

    @cached_property
    def coarse(self) -> "Posterior":
        """The same with bubbles of :func:`imr_torch.simulate.coarser`.

        Itself where there are none.
        """
        simulator = coarser(self.simulator)
        return self if simulator is self.simulator else replace(self, simulator=simulator)

    @cached_property
    def least_cost(self) -> float:
        """Nats of a prediction that meets the mean of every frame: no gel has less, but for what a
        law of noise that follows the prediction gives back.
        """
        return -float(self.batch.log_likelihood(self.batch.mean).sum())

    def of_experiments(self, rows: RowNumbers) -> "Posterior":
        """That of some of the experiments."""
        experiments = tuple(self.batch.experiments[row] for row in rows.tolist())
        return replace(self, batch=replace(self.batch, experiments=experiments))

    def log_joint(self, point: Point, prediction: BatchFrames | None = None) -> Values:
        """Log of likelihood times prior, nats, without the constants of the priors; ``-inf`` where
        a bubble fails.

        Args:
            point: ``batch_shape`` points.
            prediction: what the camera would see there, if it is known already.
        """
        likelihood = self.batch.log_likelihood(
            self.predict(point) if prediction is None else prediction
        ).sum(-1)
        return (
            likelihood
            - 0.5 * point.gel.square().sum(-1)
            - 0.5 * point.nuisances.square().sum((-2, -1))
        )

    def neighbourhood(
        self, point: Point, *, moves_gel: bool = True, leader: Point | None = None
    ) -> "Neighbourhood":
        """Simulate points and the points beside them for finite differences; arguments as of
        :meth:`bundle`.
        """
        prediction = self.bundle(point, moves_gel=moves_gel, leader=leader)
        return Neighbourhood(self, point, prediction)

    def equations(
        self,
        point: Point,
        prediction: BatchFrames,
        by_gel: GelSlopes,
        by_nuisance: NuisanceSlopes,
    ) -> NormalEquations:
        """Gauss-Newton normal equations from given sensitivities.

        Args:
            point: ``batch_shape`` points.
            prediction: there.
            by_gel: its sensitivity to the gel.
            by_nuisance: to the nuisances.
        """
        slope = self.likelihood_slope(prediction)[..., None]
        gradients = (by_gel.mT @ slope)[..., 0].sum(-2), (by_nuisance.mT @ slope)[..., 0]
        sd = self.batch.sd(prediction)
        whitened_gel, whitened_nuisance = (
            self.batch.whiten(x.movedim(-1, 0), sd[None]).movedim(0, -1)
            for x in (by_gel, by_nuisance)
        )
        likelihood = normal_equations(gradients, (whitened_gel, whitened_nuisance))
        return likelihood.with_prior(point.gel, point.nuisances)

    def fit_nuisances(
        self,
        point: Point,
        *,
        beside: "Neighbourhood | None" = None,
        longest: float = 4.0,
    ) -> tuple[
        Float[Tensor, "draws experiments nuisances"],
        Float[Tensor, "draws experiments nuisances nuisances"],
    ]:
        """Most probable nuisances of each gel and their precision, by one Gauss-Newton step each.

        Far from a fit, or where many repeats make the data so exact that the cost is not quadratic
        in the nuisances within their uncertainty, the fit's linearisation is not good enough to
        draw from. The result is a function of the gel alone, so importance weights stay exact.

        Args:
            point: ``n`` gels, with nuisances to start from, kept where a bubble fails.
            beside: a fitted point whose sensitivities serve all gels, a quarter of the bubbles;
                those about each gel when not given.
            longest: most prior standard deviations of nuisances in one step.

        Returns:
            Nuisances ``n x E x w`` and lower Cholesky factors of their Hessian ``n x E x w x w``.
        """
        if beside is None:
            near = self.neighbourhood(point, moves_gel=False)
            known = near.prediction.isfinite().all(-1).all(-2)[..., None]
            equations = near.equations
        else:
            prediction = self.predict(point, precise=False)
            known = prediction.isfinite().all(-1, keepdim=True)
            slopes = (x.expand(len(point.gel), *x.shape) for x in beside.slopes)
            equations = self.equations(point, torch.where(known, prediction, 0.5), *slopes)
        step = equations.reduced.nuisance_step
        step = step * (
            longest / step.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        ).clamp_max(1.0)
        root = torch.linalg.cholesky(equations.nuisance_hessian)
        return torch.where(known, point.nuisances + step, point.nuisances), root

    def likelihood_slope(self, prediction: BatchFrames) -> BatchFrames:
        """Gradient of the negative log likelihood over predictions."""
        with torch.enable_grad():
            point = prediction.detach().requires_grad_()
            (slope,) = torch.autograd.grad(-self.batch.log_likelihood(point).sum(), point)
        return slope


@dataclass(frozen=True)
class Neighbourhood:
    """Simulated points and the points beside them, from which local sensitivities follow by finite
    differences.

    Args:
        posterior: whose.
        point: ``batch_shape`` points.
        prediction: of the point, of gels moved, of each uncertain nuisance moved.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import Point, Posterior
    >>> from imr_torch.observe import Experiment, ExperimentBatch
    >>> times, radius = torch.tensor([[0.0, 0.5, 1.0], [1.0, 0.84, 0.31]], dtype=torch.float64)
    >>> batch = ExperimentBatch((Experiment("shot 1", (400.0, 0.22), times, radius[None]),))
    >>> posterior = Posterior(wide_prior(["nhkv"])["nhkv"], batch, PolytropicSimulator())
    >>> near = posterior.neighbourhood(Point(torch.zeros(1, 2, dtype=torch.float64), posterior.mean_nuisances(1)))
    >>> tuple(near.prediction.shape)  # 1 point, with one neighbour along G and one along mu
    (1, 3, 1, 3)
    """

    posterior: Posterior
    point: Point
    prediction: BundleFrames

    def is_of(self, posterior: Posterior, point: Point) -> bool:
        """Whether its bubbles are those of a posterior at a point, whatever the noise."""
        mine, others = (
            (at.gel, at.nuisances, b.times, b.mask, b.designs, b.nuisance_sds)
            for at, b in ((self.point, self.posterior.batch), (point, posterior.batch))
        )
        same = self.posterior.simulator is posterior.simulator
        return same and all(map(torch.equal, mine, others))

    def of_experiments(self, rows: RowNumbers) -> "Neighbourhood":
        """That of some of the experiments, without a bubble."""
        posterior = self.posterior.of_experiments(rows)
        point = Point(self.point.gel, self.point.nuisances[..., rows, :])
        frames = posterior.batch.times.shape[1]
        return Neighbourhood(posterior, point, self.prediction[..., rows, :frames])

    @cached_property
    def jacobian(self) -> Float[Tensor, "coordinates experiments frames"]:
        """Sensitivities of one point to all coordinates, in the order of
        :meth:`ForwardModel.coordinates_of`.
        """
        by_gel, by_nuisance = self.slopes
        own = by_nuisance[..., self.posterior.uncertain].movedim(-1, 0)  # S x E x T
        apart = own * eye(own.shape[1])[:, None, :, None]
        return torch.cat((by_gel.movedim(-1, 0), apart.flatten(0, 1)))

    @cached_property
    def coordinates(self) -> BatchCoordinates:
        """Gel and uncertain nuisances, as :attr:`jacobian` has them."""
        return self.posterior.coordinates_of(self.point)

    @cached_property
    def centre(self) -> BatchFrames:
        """``batch_shape x E x T`` tensor, the prediction at the points."""
        return self.prediction[..., 0, :, :]

    @cached_property
    def log_joint(self) -> Values:
        """``batch_shape`` tensor, at the points."""
        return self.posterior.log_joint(self.point, self.centre)

    @cached_property
    def slopes(
        self,
    ) -> tuple[
        GelSlopes,
        NuisanceSlopes,
    ]:
        """Sensitivities of the prediction to the gel (``batch_shape x E x T x d``) and nuisances
        (``batch_shape x E x T x w``).

        Neighbours that failed give a slope of zero.
        """
        return self.posterior.slopes(self.prediction)

    @cached_property
    def columns(self) -> Float[Tensor, "columns experiments frames"]:
        """Residual of one point, then its sensitivities to the gel and to the nuisances."""
        by_gel, by_nuisance = (x.movedim(-1, 0) for x in self.slopes)
        residual = self.posterior.batch.mean - self.centre
        return torch.cat((residual[None], by_gel, by_nuisance))

    @cached_property
    def equations(self) -> NormalEquations:
        """Gauss-Newton normal equations at the points, with the exact gradient; an experiment whose
        bubble fails tells nothing.
        """
        known = self.centre.isfinite().all(-1, keepdim=True)
        centre = torch.where(known, self.centre, 0.5)
        return self.posterior.equations(self.point, centre, *self.slopes)
