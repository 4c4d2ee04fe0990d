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
from torch import Tensor

from imr_torch.float64 import eye, zeros
from imr_torch.material import ModelBelief
from imr_torch.observe import ExperimentBatch, Film, predict
from imr_torch.observe.prediction import NodeTimes
from imr_torch.simulate import Simulator
from imr_torch.types import (
    BatchControls,
    BatchCoordinates,
    BatchFrames,
    BatchNuisances,
    BundleFrames,
    ColumnNumbers,
    GelSlopes,
    NuisanceSlopes,
)

STEP = 1e-6
"""Length of the differences, prior standard deviations of gel and nuisances."""


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

    gel: BatchControls
    nuisances: BatchNuisances

    def __getitem__(self, rows: Tensor | slice | int) -> "Point":
        return Point(self.gel[rows], self.nuisances[rows])


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
    >>> point = Point(torch.zeros(4, 2, dtype=torch.float64), forward.mean_nuisances(4))  # four times the prior median
    >>> tuple(forward.predict(point).shape)
    (4, 1, 3)
    >>> by_gel, by_nuisance = forward.slopes(forward.bundle(point))
    >>> tuple(by_gel.shape), tuple(by_nuisance.shape)
    ((4, 1, 3, 2), (4, 1, 3, 3))
    """

    prior: ModelBelief
    batch: ExperimentBatch | Film
    simulator: Simulator

    @cached_property
    def size(self) -> int:
        """Coordinates of the gel."""
        return len(self.prior.names)

    @cached_property
    def node_times(self) -> NodeTimes:
        """Collapse times of the gels that were last predicted."""
        return NodeTimes()

    @cached_property
    def uncertain(self) -> ColumnNumbers:
        """Columns of nuisances that are uncertain in any experiment."""
        return (self.batch.nuisance_sds > 0.0).any(0).nonzero()[:, 0]

    def coordinates_of(self, point: Point) -> BatchCoordinates:
        """The gel's coordinates, then the uncertain nuisances of each experiment."""
        return torch.cat((point.gel, point.nuisances[..., self.uncertain].flatten(-2)), -1)

    def point_at(self, coordinates: BatchCoordinates) -> Point:
        """The points at coordinates of :meth:`coordinates_of`.

        Other nuisances are at their prior means.
        """
        nuisances = self.mean_nuisances(*coordinates.shape[:-1])
        values = coordinates[..., self.size :].unflatten(-1, (nuisances.shape[-2], -1))
        nuisances[..., self.uncertain] = values
        return Point(coordinates[..., : self.size], nuisances)

    def mean_nuisances(self, *batch_shape: int) -> BatchNuisances:
        """Nuisances at their prior means, ``batch_shape x E x w``."""
        return zeros(*batch_shape, *self.batch.nuisance_sds.shape)

    def predict(
        self, point: Point, *, bundled: bool = False, precise: bool = True
    ) -> BatchFrames:
        """What the camera would see: ``batch_shape x E x T``, R/Rmax; 0 beyond the last frame, NaN
        where a bubble fails.

        Args:
            point: ``batch_shape`` points.
            bundled: whether the last batch dimension is that of a bundle, whose first point leads.
            precise: whether differences can be taken; else collapse times are kept, see ``kept`` of
                :func:`imr_torch.observe.predict`.
        """
        shifts = point.nuisances * self.batch.nuisance_sds if len(self.uncertain) else None
        prediction = predict(
            self.simulator,
            self.prior.to_si(point.gel),
            self.batch,
            shifts,
            bundled=bundled,
            kept=None if precise else self.node_times,
        )
        return torch.where(self.batch.mask, prediction, 0.0)

    def bundle(
        self, point: Point, *, moves_gel: bool = True, leader: Point | None = None
    ) -> BundleFrames:
        """Simulate points and the points beside them for finite differences, a bundle each.

        Args:
            point: ``batch_shape`` points.
            moves_gel: whether the gel is moved along each of its coordinates.
            leader: ``batch_shape`` points whose solver steps all others take; the points themselves
                when not given.

        Returns:
            The predictions of the point, of gels moved, of each uncertain nuisance moved.
        """
        width = point.nuisances.shape[-1]
        moves = STEP * eye(self.size)[: self.size * moves_gel]
        shifts = STEP * eye(width)[self.uncertain]
        steps = Point(
            torch.nn.functional.pad(moves, (0, 0, 1, len(shifts))),
            torch.nn.functional.pad(shifts, (0, 0, 1 + len(moves), 0)).unsqueeze(-2),
        )
        points = Point(
            point.gel.unsqueeze(-2) + steps.gel,
            point.nuisances.unsqueeze(-3) + steps.nuisances,
        )
        if leader is None or all(
            map(torch.equal, (leader.gel, leader.nuisances), (point.gel, point.nuisances))
        ):
            return self.predict(points, bundled=True)
        led = Point(
            torch.cat((leader.gel.unsqueeze(-2), points.gel), -2),
            torch.cat((leader.nuisances.unsqueeze(-3), points.nuisances), -3),
        )
        return self.predict(led, bundled=True)[..., 1:, :, :]

    def slopes(
        self, prediction: BundleFrames
    ) -> tuple[
        GelSlopes,
        NuisanceSlopes,
    ]:
        """Sensitivities to the gel (``batch_shape x E x T x d``) and to the nuisances
        (``batch_shape x E x T x w``); zero where they were not moved.

        Neighbours that failed, be it after some frames, give a slope of zero.

        Args:
            prediction: as of :meth:`bundle`.
        """
        slopes = (prediction[..., 1:, :, :] - prediction[..., :1, :, :]) / STEP
        good = slopes.isfinite().all(-1, keepdim=True)
        slopes = torch.where(good, slopes, 0.0).movedim(-3, -1)
        moved = slopes.shape[-1] - len(self.uncertain)
        by_gel = slopes.new_zeros(*slopes.shape[:-1], self.size)
        by_gel[..., :moved] = slopes[..., :moved]
        by_nuisance = slopes.new_zeros(*slopes.shape[:-1], self.batch.nuisance_sds.shape[1])
        by_nuisance[..., self.uncertain] = slopes[..., moved:]
        return by_gel, by_nuisance
