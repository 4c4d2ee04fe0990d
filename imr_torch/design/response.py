"""How a planned experiment will be observed, what the camera would see of draws of a belief, and how
that changes with gel and nuisances.

Of this stage, only this module calls the simulator. An information gain is about the data that the
assimilation will use, so frames after the last collapse of the window do not count.

Controls ``v`` are those in which the belief is a standard normal, so a sensitivity is per standard
deviation of what is believed now, whatever the units of the parameters.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from imr_torch.assimilate import ForwardModel, Point
from imr_torch.errors import check_at_least
from imr_torch.float64 import linspace
from imr_torch.material import Belief, ModelBelief
from imr_torch.observe import Experiment, Film, Noise, Nuisance, collapse_time
from imr_torch.simulate import Simulator
from imr_torch.types import BatchControls, Designs, DrawnControls, FrameValues


@dataclass(frozen=True)
class Plan:
    """How a planned experiment will be observed.

    Args:
        times: dimensionless frame times.
        repeats: curves per design.
        noise: observation noise of one curve.
        nuisance: errors of the measured design and clock, marginalised.
        collapses: collapses in the window that will be assimilated; None for all frames.

    >>> from imr_torch.design import Plan
    >>> plan = Plan(repeats=10, collapses=1)
    >>> plan.frames_in_window(0.6 + 0.4 * torch.cos(3.0 * plan.times)).sum()  # frames up to the first minimum of a curve
    tensor(22)
    """

    times: FrameValues = field(default_factory=lambda: linspace(0.0, 4.0, 81))
    repeats: int = 1
    noise: Noise = field(default_factory=Noise)
    nuisance: Nuisance = field(default_factory=Nuisance)
    collapses: int | None = 2

    def __post_init__(self) -> None:
        check_at_least(self, 1, "repeats")
        check_at_least(self, 1, "collapses", note=", or None for all frames")

    def cut_to_window(self, experiment: Experiment) -> Experiment:
        """An experiment without the frames after the last collapse of the window."""
        if self.collapses is None:
            return experiment
        return experiment.until(
            collapse_time(experiment.times, experiment.mean, self.collapses)
        )

    def frames_in_window(
        self, radius: Float[Tensor, "*batch frames"]
    ) -> Bool[Tensor, "*batch frames"]:
        """Frames of each curve (``... x n_t``) up to the last collapse of the window: a boolean
        tensor of that shape.
        """
        if self.collapses is None:
            return torch.ones_like(radius, dtype=torch.bool)
        ends = [
            collapse_time(self.times, curve, self.collapses)
            for curve in radius.reshape(-1, len(self.times))
        ]
        last = torch.tensor(ends, dtype=self.times.dtype).reshape(*radius.shape[:-1], 1)
        return self.times <= last


@dataclass(frozen=True)
class Shot:
    """Designs shot with one belief, and how they are observed.

    Args:
        belief: what is thought of the gel now; models of negligible probability are left out.
        designs: (We, R_inf*).
        simulator: makes the bubbles.
        plan: how they are observed.
        negligible: probability below which a model is left out; 1e-4 changes the gain by less than
            .001 nats.

    >>> from imr_torch.design import Plan, Shot
    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> designs = torch.tensor([[400.0, 0.2], [700.0, 0.25]], dtype=torch.float64)
    >>> shot = Shot(reference_case("soft-pa").prior, designs, PolytropicSimulator(), Plan())
    >>> shot.film.times.shape  # 81 frames of each design
    torch.Size([2, 81])
    """

    belief: Belief
    designs: Designs
    simulator: Simulator
    plan: Plan
    negligible: float = 1e-4

    def __post_init__(self) -> None:
        log_probabilities = self.belief.log_probabilities
        likely = (log_probabilities.exp() > self.negligible).nonzero()[:, 0]
        models = tuple(self.belief.models[row] for row in likely)
        object.__setattr__(self, "belief", Belief(models, log_probabilities[likely]))

    @cached_property
    def film(self) -> Film:
        """What the camera will see of the designs, but for the gel."""
        q = len(self.designs)
        return Film(
            self.designs,
            self.plan.times.expand(q, -1),
            self.plan.nuisance.sds().expand(q, -1),
        )


class Rows:
    """A dataclass of tensors, one row of each for every gel."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, rows: Tensor | slice) -> Self:
        return type(self)(*(values[rows] for values in vars(self).values()))


@dataclass(frozen=True)
class Response(Rows):
    """Gels and what the camera would see of them.

    Args:
        controls: ``n x d`` tensor.
        radius: R/Rmax; NaN of gels of which a bubble, or one beside it, could not be simulated.
        by_gel: sensitivity to the controls; ``d = 0`` when not asked for.
        by_nuisance: per standard deviation of the nuisances that are not known exactly.
    """

    controls: DrawnControls
    radius: Float[Tensor, "draws designs frames"]
    by_gel: Float[Tensor, "draws designs frames slopes"]
    by_nuisance: Float[Tensor, "draws designs frames nuisances"]

    def at_designs(self, place: Int[Tensor, "shots"]) -> "Response":
        """The same gels at designs of some places."""
        seen = (self.radius, self.by_gel, self.by_nuisance)
        return Response(self.controls, *(values[:, place] for values in seen))

    @property
    def good(self) -> Bool[Tensor, "draws"]:
        """Gels all of whose bubbles could be simulated."""
        return self.radius.isfinite().flatten(1).all(1)

    def replace_rows(self, rows: Shaped[Tensor, "rows"], others: "Response") -> "Response":
        """These gels with others in the place of some rows."""
        pairs = zip(vars(self).values(), vars(others).values(), strict=True)
        return Response(*(mine.index_copy(0, rows, new) for mine, new in pairs))


def radii(
    shot: Shot, part: ModelBelief, controls: BatchControls
) -> Float[Tensor, "*batch designs frames"]:
    """R/Rmax of gels at controls; NaN where the solve failed.

    Args:
        shot: designs and how they are observed.
        part: the model.
        controls: in which the belief in the model is a standard normal.

    >>> from imr_torch.design import Plan, Shot, radii
    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> designs = torch.tensor([[400.0, 0.2], [700.0, 0.25]], dtype=torch.float64)
    >>> shot = Shot(reference_case("soft-pa").prior, designs, PolytropicSimulator(), Plan())
    >>> part = shot.belief.models[0]
    >>> radii(shot, part, torch.zeros(3, len(part.names)).double()).shape  # 81 frames
    torch.Size([3, 2, 81])
    """
    forward = ForwardModel(part, shot.film, shot.simulator)
    return forward.predict(Point(controls, forward.mean_nuisances(*controls.shape[:-1])))


def simulate_response(
    shot: Shot, part: ModelBelief, controls: DrawnControls, *, gel: bool = True
) -> Response:
    """Radii and their sensitivities: each gel with its moved copies is a bundle that the solver
    advances in lock step.

    Args:
        shot: designs and how they are observed.
        part: the model.
        controls: ``n x d`` tensor.
        gel: whether the sensitivity to the gel is wanted.
    """
    forward = ForwardModel(part, shot.film, shot.simulator)
    seen = forward.bundle(
        Point(controls, forward.mean_nuisances(len(controls))), moves_gel=gel
    )
    by_gel, by_nuisance = forward.slopes(seen)
    # of the gel and of all beside it
    good = seen.isfinite().flatten(1).all(1)[:, None, None]
    slopes = by_gel if gel else by_gel[..., :0]
    return Response(
        controls,
        torch.where(good, seen[:, 0], torch.nan),
        slopes,
        by_nuisance[..., forward.uncertain],
    )
