"""What the camera would see of one model's gels, and how it changes with gel and nuisances.

Fits, information gain and gap tests get their sensitivities here, of measured experiments as of
planned designs. Points are in whitened coordinates, in which the prior is a standard normal: ``d``
of the gel, and ``w`` of each experiment (Rmax, time zero, R_inf, and deviations of its gel if it
has one of its own). Sensitivities are differences of bubbles that take the steps of one of them (a
bundle), so they are those of the solver itself.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.assimilate.gauss_newton import ensemble_sensitivity
from imr_torch.material import ModelBelief
from imr_torch.observe import ExperimentBatch, Film, predict
from imr_torch.simulate import Simulator

STEP = 1e-6
"""Length of the differences: of the gel in units of ``scale``, of nuisances in prior standard deviations."""


@dataclass(frozen=True)
class Point:
    """Whitened coordinates of one or many points.

    Args:
        gel: ``batch_shape x d`` tensor.
        nuisances: ``batch_shape x E x w`` tensor.

    >>> import torch
    >>> from imr_torch.assimilate import Point
    >>> point = Point(gel=torch.zeros(4, 2, dtype=torch.float64), nuisances=torch.zeros(4, 1, 3, dtype=torch.float64))
    >>> tuple(point[:2].gel.shape)  # the first two of four gels with one experiment
    (2, 2)
    """

    gel: Float[Tensor, "*batch controls"]
    nuisances: Float[Tensor, "*batch experiments nuisances"]

    def __getitem__(
        self, rows: Tensor | slice | int | tuple[Tensor | slice | int | None, ...]
    ) -> "Point":
        return Point(self.gel[rows], self.nuisances[rows])

    def put(self, rows: Int[Tensor, "rows"], other: "Point") -> "Point":
        """These points with others in the place of some rows."""
        return Point(
            self.gel.index_put((rows,), other.gel),
            self.nuisances.index_put((rows,), other.nuisances),
        )


@dataclass(frozen=True)
class ForwardModel:
    """One model's gels and nuisances in, predicted curves and their sensitivities out.

    Args:
        prior: of the gel.
        batch: the experiments, measured or planned, with the priors of their nuisances.
        simulator: makes the bubbles.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import ForwardModel, Point
    >>> from imr_torch.observe import Film
    >>> film = Film(torch.tensor([[400.0, 0.22]]).double(), torch.tensor([[0.0, 0.5, 1.0]]).double())
    >>> forward = ForwardModel(wide_prior(["nhkv"])["nhkv"], film, PolytropicSimulator())
    >>> point = Point(torch.zeros(4, 2, dtype=torch.float64), forward.still(4))  # four times the prior median
    >>> tuple(forward.predict(point).shape)
    (4, 1, 3)
    >>> by_gel, by_nuisance = forward.slopes(*forward.bundle(point))
    >>> tuple(by_gel.shape), tuple(by_nuisance.shape)
    ((4, 1, 3, 2), (4, 1, 3, 3))
    """

    prior: ModelBelief
    batch: ExperimentBatch | Film
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
        """``S x 1 x w`` tensor: the step of each uncertain nuisance, the same in all experiments."""
        steps = torch.zeros(
            len(self.uncertain), 1, self.batch.nuisance_sds.shape[1], dtype=torch.float64
        )
        steps[torch.arange(len(self.uncertain)), 0, self.uncertain] = STEP
        return steps

    def still(self, *batch_shape: int) -> Float[Tensor, "*batch experiments nuisances"]:
        """Nuisances at their prior means, ``batch_shape x E x w``."""
        return torch.zeros(*batch_shape, *self.batch.nuisance_sds.shape, dtype=torch.float64)

    def to_si(self, gel: Float[Tensor, "*batch controls"]) -> Float[Tensor, "*batch parameters"]:
        """Shared parameter vectors, SI."""
        return self.prior.to_si(gel)

    def predict(
        self, point: Point, *, bundled: bool = False
    ) -> Float[Tensor, "*batch experiments frames"]:
        """What the camera would see: ``batch_shape x E x T``, R/Rmax; 0 beyond the last frame, NaN
        where a bubble fails.

        Args:
            point: ``batch_shape`` points.
            bundled: whether the last batch dimension is that of a bundle, whose first point leads.
        """
        shifts = point.nuisances * self.batch.nuisance_sds if len(self.uncertain) else None
        prediction = predict(
            self.simulator, self.to_si(point.gel), self.batch, shifts, bundled=bundled
        )
        return torch.where(self.batch.mask, prediction, 0.0)

    def bundle(
        self,
        point: Point,
        scale: Float[Tensor, "*#batch controls directions"] | None = None,
        *,
        leader: Point | None = None,
    ) -> tuple[
        Float[Tensor, "*batch directions controls"],
        Float[Tensor, "*batch bundle experiments frames"],
    ]:
        """Simulate points and the points beside them for finite differences, a bundle each.

        Args:
            point: ``batch_shape`` points.
            scale: ``batch_shape x d x N`` tensor whose columns are the directions in which the gel
                is moved; one each along every coordinate when not given, none for ``N = 0``.
            leader: ``batch_shape`` points whose solver steps all others take; the points themselves
                when not given.

        Returns:
            By what the gel was moved, and the predictions of the point, of gels moved, of each
            uncertain nuisance moved.
        """
        gel = point.gel.unsqueeze(-2)
        nuisances = point.nuisances.unsqueeze(-3)
        directions = torch.eye(self.size, dtype=torch.float64) if scale is None else scale.mT
        moves = (STEP * directions).expand(*gel.shape[:-2], *directions.shape[-2:])
        shifts = self._nuisance_steps
        gels = [gel, gel + moves, gel.expand(*gel.shape[:-2], len(shifts), -1)]
        moved = [
            nuisances,
            nuisances.expand(*gel.shape[:-2], moves.shape[-2], -1, -1),
            nuisances + shifts,
        ]
        if leader is not None:
            gels.insert(0, leader.gel.unsqueeze(-2))
            moved.insert(0, leader.nuisances.unsqueeze(-3))
        prediction = self.predict(Point(torch.cat(gels, -2), torch.cat(moved, -3)), bundled=True)
        return moves, prediction if leader is None else prediction[..., 1:, :, :]

    def slopes(
        self,
        moves: Float[Tensor, "*batch directions controls"],
        prediction: Float[Tensor, "*batch bundle experiments frames"],
    ) -> tuple[
        Float[Tensor, "*batch experiments frames controls"],
        Float[Tensor, "*batch experiments frames nuisances"],
    ]:
        """Sensitivities to the gel (``batch_shape x E x T x d``) and to the nuisances
        (``batch_shape x E x T x w``).

        Neighbours that failed, be it after some frames, give a slope of zero.

        Args:
            moves: as of :meth:`bundle`.
            prediction: as of :meth:`bundle`.
        """
        count = moves.shape[-2]
        centre = prediction[..., :1, :, :]
        moved = prediction[..., 1 : 1 + count, :, :]
        shifted = prediction[..., 1 + count :, :, :]
        if count:
            by_gel = ensemble_sensitivity(
                moves.unsqueeze(-3), (moved - centre).transpose(-3, -2)
            )  # of ... x E x N x T
        else:
            by_gel = prediction.new_zeros(*prediction[..., 0, :, :].shape, moves.shape[-1])
        by_nuisance = prediction.new_zeros(
            *prediction[..., 0, :, :].shape, self.batch.nuisance_sds.shape[1]
        )
        slopes = (shifted - centre) / STEP
        good = torch.isfinite(slopes).all(-1, keepdim=True)
        by_nuisance[..., self.uncertain] = torch.where(good, slopes, 0.0).movedim(-3, -1)
        return by_gel, by_nuisance
