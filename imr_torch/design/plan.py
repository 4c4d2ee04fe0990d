"""How a planned experiment will be observed: frames, repeats, noise, nuisances, and the window that
will be assimilated.

An information gain is about the data that the assimilation will use, so frames after the last
collapse of the window do not count.
"""

from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.float64 import linspace
from imr_torch.observe import Experiment, Noise, Nuisance, collapse_time
from imr_torch.types import FrameValues


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
        if self.repeats < 1:
            raise InputDataError(
                f"Plan.repeats is {self.repeats}; at least 1 curve per design is needed."
            )
        if self.collapses is not None and self.collapses < 1:
            raise InputDataError(
                f"Plan.collapses is {self.collapses}; expected at least 1, or None for all frames."
            )

    @cached_property
    def decorrelation(self) -> Float[Tensor, "frames frames"] | None:
        """``n_t x n_t`` inverse Cholesky factor of the frames' correlation; None for independent
        frames.

        It is lower triangular: what it makes of the first frames does not depend on later ones, so
        a window can be cut after it.
        """
        factor = self.noise.decorrelation(
            self.times[None], torch.ones(1, len(self.times), dtype=torch.bool)
        )
        return None if factor is None else factor[0]

    def cut_to_window(self, experiment: Experiment) -> Experiment:
        """An experiment without the frames after the last collapse of the window."""
        if self.collapses is None:
            return experiment
        return experiment.until(collapse_time(experiment.times, experiment.mean, self.collapses))

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
