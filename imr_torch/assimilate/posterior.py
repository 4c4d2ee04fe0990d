"""The posterior of one model's gel and of the nuisances of every experiment: its density and its linearisation at any point.

Prior, data and simulator are combined here and nowhere else: fits, importance sampling, Hamiltonian Monte Carlo and the tests
of the model's misfit all ask this object. Points are in whitened coordinates, in which the prior is a standard normal: ``d`` of
the gel, and three of each experiment (Rmax, time zero, R_inf). Sensitivities are differences of bubbles that take the steps of
one of them (a bundle), so they are those of the solver itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.assimilate.gauss_newton import NormalEquations, ensemble_sensitivity, normal_equations
from imr_torch.material import ModelBelief
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator, coarser

STEP = 1e-6
"""Length of the differences: of the gel in units of ``scale``, of nuisances in prior standard deviations."""


@dataclass(frozen=True)
class Point:
    """Whitened coordinates of one or many points.

    Args:
        gel: ``batch_shape x d`` tensor.
        nuisances: ``batch_shape x E x 3`` tensor.

    >>> import torch
    >>> from imr_torch.assimilate import Point
    >>> point = Point(gel=torch.zeros(4, 2, dtype=torch.float64), nuisances=torch.zeros(4, 1, 3, dtype=torch.float64))
    >>> tuple(point[:2].gel.shape)  # the first two of four gels with one experiment
    (2, 2)
    """

    gel: Float[Tensor, "*batch controls"]
    nuisances: Float[Tensor, "*batch experiments 3"]

    def __getitem__(self, rows: Tensor | slice | int | tuple[Tensor | slice | int | None, ...]) -> "Point":
        return Point(self.gel[rows], self.nuisances[rows])

    def put(self, rows: Int[Tensor, "rows"], other: "Point") -> "Point":
        """These points with others in the place of some rows."""
        return Point(self.gel.index_put((rows,), other.gel), self.nuisances.index_put((rows,), other.nuisances))


@dataclass(frozen=True)
class Posterior:
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
    >>> [round(x) for x in posterior.log_joint(Point(gels, posterior.still(2))).tolist()]
    [4, -17]
    """

    prior: ModelBelief
    batch: ExperimentBatch
    simulator: Simulator

    @property
    def size(self) -> int:
        """Coordinates of the gel."""
        return len(self.prior.names)

    @cached_property
    def uncertain(self) -> Int[Tensor, "columns"]:
        """Columns of nuisances that are uncertain in any experiment."""
        return torch.nonzero((self.batch.nuisance_sds > 0.0).any(0))[:, 0]

    @cached_property
    def _nuisance_steps(self) -> Tensor:
        """``S x 1 x 3`` tensor: the step of each uncertain nuisance, the same in all experiments."""
        steps = torch.zeros(len(self.uncertain), 1, 3, dtype=torch.float64)
        steps[torch.arange(len(self.uncertain)), 0, self.uncertain] = STEP
        return steps

    def still(self, *batch_shape: int) -> Float[Tensor, "*batch experiments 3"]:
        """Nuisances at their prior means, ``batch_shape x E x 3``."""
        return torch.zeros(*batch_shape, *self.batch.nuisance_sds.shape, dtype=torch.float64)

    def to_si(self, gel: Float[Tensor, "*batch controls"]) -> Float[Tensor, "*batch parameters"]:
        """Shared parameter vectors, SI."""
        return self.prior.to_si(gel)

    @cached_property
    def coarse(self) -> "Posterior":
        """The same with bubbles of :func:`imr_torch.simulate.coarser`; itself where there are none."""
        simulator = coarser(self.simulator)
        return self if simulator is self.simulator else replace(self, simulator=simulator)

    def predict(self, point: Point, *, bundled: bool = False) -> Float[Tensor, "*batch experiments frames"]:
        """What the camera would see: ``batch_shape x E x T``, R/Rmax; 0 beyond the last frame, NaN where a bubble fails.

        Args:
            point: ``batch_shape`` points.
            bundled: whether the last batch dimension is that of a bundle, whose first point leads.
        """
        shifts = point.nuisances * self.batch.nuisance_sds if len(self.uncertain) else None
        prediction = predict(self.simulator, self.to_si(point.gel), self.batch, shifts, bundled=bundled)
        return torch.where(self.batch.mask, prediction, 0.0)

    def log_joint(
        self, point: Point, prediction: Float[Tensor, "*batch experiments frames"] | None = None
    ) -> Float[Tensor, "*batch"]:
        """Log of likelihood times prior, nats, without the constants of the priors; ``-inf`` where a bubble fails.

        Args:
            point: ``batch_shape`` points.
            prediction: what the camera would see there, if it is known already.
        """
        likelihood = self.batch.log_likelihood(self.predict(point) if prediction is None else prediction).sum(-1)
        return likelihood - 0.5 * point.gel.square().sum(-1) - 0.5 * point.nuisances.square().sum((-2, -1))

    def neighbourhood(
        self, point: Point, scale: Float[Tensor, "*batch controls directions"] | None = None, *, leader: Point | None = None
    ) -> "Neighbourhood":
        """Simulate points and the points beside them for finite differences, a bundle each.

        Args:
            point: ``batch_shape`` points.
            scale: ``batch_shape x d x N`` tensor whose columns are the directions in which the gel is moved; one each along
                every coordinate when not given, none for ``N = 0``.
            leader: ``batch_shape`` points whose solver steps all others take; the points themselves when not given.
        """
        gel, nuisances = point.gel.unsqueeze(-2), point.nuisances.unsqueeze(-3)
        directions = torch.eye(self.size, dtype=torch.float64) if scale is None else scale.mT
        moves = (STEP * directions).expand(*gel.shape[:-2], *directions.shape[-2:])
        shifts = self._nuisance_steps
        gels = [gel, gel + moves, gel.expand(*gel.shape[:-2], len(shifts), -1)]
        moved = [nuisances, nuisances.expand(*gel.shape[:-2], moves.shape[-2], -1, -1), nuisances + shifts]
        if leader is not None:
            gels.insert(0, leader.gel.unsqueeze(-2))
            moved.insert(0, leader.nuisances.unsqueeze(-3))
        prediction = self.predict(Point(torch.cat(gels, -2), torch.cat(moved, -3)), bundled=True)
        return Neighbourhood(self, point, moves, prediction if leader is None else prediction[..., 1:, :, :])

    def equations(
        self,
        point: Point,
        prediction: Float[Tensor, "*batch experiments frames"],
        by_gel: Float[Tensor, "*batch experiments frames controls"],
        by_nuisance: Float[Tensor, "*batch experiments frames 3"],
    ) -> NormalEquations:
        """Gauss-Newton normal equations from given sensitivities.

        Args:
            point: ``batch_shape`` points.
            prediction: there.
            by_gel: its sensitivity to the gel.
            by_nuisance: to the nuisances.
        """
        slope = _likelihood_slope(self.batch, prediction)[..., None]
        gradients = (by_gel.mT @ slope)[..., 0].sum(-2), (by_nuisance.mT @ slope)[..., 0]
        sd = self.batch.sd(prediction)
        whitened = [self.batch.whiten(x.movedim(-1, 0), sd[None]).movedim(0, -1) for x in (by_gel, by_nuisance)]
        return normal_equations(point.gel, point.nuisances, gradients, (whitened[0], whitened[1]))

    def linearise(self, point: Point) -> NormalEquations:
        """Gauss-Newton normal equations at points."""
        return self.neighbourhood(point).equations


@dataclass(frozen=True)
class Neighbourhood:
    """Simulated points and the points beside them, from which local sensitivities follow by finite differences.

    Args:
        posterior: whose.
        point: ``batch_shape`` points.
        moves: by which the gel was moved.
        prediction: of the point, of gels moved, of each uncertain nuisance moved.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import Point, Posterior
    >>> from imr_torch.observe import Experiment, ExperimentBatch
    >>> times, radius = torch.tensor([[0.0, 0.5, 1.0], [1.0, 0.84, 0.31]], dtype=torch.float64)
    >>> batch = ExperimentBatch((Experiment("shot 1", (400.0, 0.22), times, radius[None]),))
    >>> posterior = Posterior(wide_prior(["nhkv"])["nhkv"], batch, PolytropicSimulator())
    >>> near = posterior.neighbourhood(Point(torch.zeros(1, 2, dtype=torch.float64), posterior.still(1)))
    >>> tuple(near.prediction.shape)  # 1 point, with one neighbour along G and one along mu
    (1, 3, 1, 3)
    """

    posterior: Posterior
    point: Point
    moves: Float[Tensor, "*batch directions controls"]
    prediction: Float[Tensor, "*batch bundle experiments frames"]

    @staticmethod
    def stack(parts: "Sequence[Neighbourhood]") -> "Neighbourhood":
        """Neighbourhoods of single points as those of ``C`` points."""
        gel, nuisances, moves, prediction = (
            torch.stack(x) for x in zip(*((n.point.gel, n.point.nuisances, n.moves, n.prediction) for n in parts), strict=True)
        )
        return Neighbourhood(parts[0].posterior, Point(gel, nuisances), moves, prediction)

    def __getitem__(self, row: int) -> "Neighbourhood":
        return replace(self, point=self.point[row], moves=self.moves[row], prediction=self.prediction[row])

    def take(self, rows: Int[Tensor, "rows"]) -> "Neighbourhood":
        """Those of some of ``C`` points."""
        return replace(self, point=self.point[rows], moves=self.moves[rows], prediction=self.prediction[rows])

    @property
    def centre(self) -> Float[Tensor, "*batch experiments frames"]:
        """``batch_shape x E x T`` tensor, the prediction at the points."""
        return self.prediction[..., 0, :, :]

    @property
    def log_joint(self) -> Float[Tensor, "*batch"]:
        """``batch_shape`` tensor, at the points."""
        return self.posterior.log_joint(self.point, self.centre)

    @cached_property
    def slopes(
        self,
    ) -> tuple[Float[Tensor, "*batch experiments frames controls"], Float[Tensor, "*batch experiments frames 3"]]:
        """Sensitivities of the prediction to the gel (``batch_shape x E x T x d``) and nuisances (``batch_shape x E x T x 3``).

        Neighbours that failed give a slope of zero.
        """
        count, centre = self.moves.shape[-2], self.centre.unsqueeze(-3)
        moved, shifted = self.prediction[..., 1 : 1 + count, :, :], self.prediction[..., 1 + count :, :, :]
        responses = (moved - centre).transpose(-3, -2)  # ... x E x N x T
        if count:
            by_gel = ensemble_sensitivity(self.moves.unsqueeze(-3), responses)
        else:
            by_gel = centre.new_zeros(*self.centre.shape, self.moves.shape[-1])
        by_nuisance = torch.zeros(*self.centre.shape, 3, dtype=torch.float64)
        by_nuisance[..., self.posterior.uncertain] = ((shifted - centre) / STEP).nan_to_num().movedim(-3, -1)
        return by_gel, by_nuisance

    @property
    def equations(self) -> NormalEquations:
        """Gauss-Newton normal equations at the points, with the exact gradient."""
        return self.posterior.equations(self.point, self.centre, *self.slopes)


def _likelihood_slope(batch: ExperimentBatch, prediction: Tensor) -> Tensor:
    """Gradient of the negative log likelihood over predictions ``... x E x T``."""
    with torch.enable_grad():
        point = prediction.detach().requires_grad_()
        (slope,) = torch.autograd.grad(-batch.log_likelihood(point).sum(), point)
    return slope
