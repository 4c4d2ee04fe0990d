"""A simulator whose bubbles are a formula: what those of tests have in common."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from imr_torch.simulate import Conditions, Solution, Status, broadcast_batch


@dataclass(frozen=True)
class FormulaSimulator:
    """Radii by ``formula``, NaN where ``bad`` says so; velocity and pressure are none, and a bundle is a batch."""

    conditions: Conditions = field(default_factory=Conditions, kw_only=True)

    def formula(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Tensor:
        """``n x n_t`` tensor, of as many gels, designs and times."""
        raise NotImplementedError

    def bad(self, parameters: Tensor) -> Tensor:
        """``n`` tensor, which gels fail."""
        return torch.zeros(len(parameters), dtype=torch.bool)

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        shape, parameters, designs, times = broadcast_batch(parameters, designs, times)
        bad = self.bad(parameters)
        radius = self.formula(parameters, designs, times)
        radius = torch.where(bad[:, None], torch.nan, radius).reshape(*shape, -1)
        status = torch.where(bad, int(Status.NON_FINITE), int(Status.DONE)).reshape(shape)
        none = torch.zeros_like(radius)
        return Solution(
            times.reshape(*shape, -1), radius, none, none, status, torch.ones_like(status)
        )

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        return self(parameters, designs, times)
