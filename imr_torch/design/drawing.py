"""Gels drawn from a belief, and one simulated datum of each: what all estimators of the gain about
one gel start from.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.design.likelihood import Data, observe_gels
from imr_torch.design.response import Response, Shot, simulate_response
from imr_torch.float64 import randn


@dataclass(frozen=True)
class Gels:
    """Gels of all models, drawn and simulated.

    Args:
        parts: gels of each model that could be simulated.
        orders: ``draws`` tensor per model: the numbers of all draws, those that could be simulated
            first.
    """

    parts: tuple[Response, ...]
    orders: tuple[Int[Tensor, "_"], ...]

    def observe(self, shot: Shot, source: torch.Generator) -> tuple[Data, tuple[slice, ...]]:
        """A datum of each gel, model after model, and which rows are of each model."""
        data = [observe_gels(part, shot.plan, source) for part in self.parts]
        together = Data(torch.cat([d.radius for d in data]), torch.cat([d.window for d in data]))
        ends = torch.tensor([0, *map(len, data)]).cumsum(0).tolist()
        return together, tuple(slice(first, end) for first, end in pairwise(ends))


def draw_normal_controls(
    shot: Shot, counts: Sequence[int], source: torch.Generator
) -> list[Float[Tensor, "draws _"]]:
    """Draws of the Gaussian of each model, as many as ``counts`` says: ``draws x d``."""
    return [
        randn(count, len(part.names), generator=source)
        for part, count in zip(shot.belief.models, counts, strict=True)
    ]


def draw_cloud_controls(
    shot: Shot, draws: int, source: torch.Generator
) -> list[Float[Tensor, "draws _"]]:
    """Draws of each model, ``draws x d``: from its stored posterior draws (``cloud``), or its
    Gaussian if it has none.
    """
    drawn = draw_normal_controls(shot, [draws] * len(shot.belief.models), source)
    for i, part in enumerate(shot.belief.models):
        if part.cloud is not None:
            rows = torch.randperm(len(part.cloud.controls), generator=source)
            rows = rows.repeat(-(-draws // len(rows)))[:draws]
            drawn[i] = part.whitened(part.cloud.controls[rows])
    return drawn


def simulate_gels(
    shot: Shot, controls: Sequence[Float[Tensor, "_ _"]], *, gel: bool = True
) -> Gels:
    """Simulate the gels of each model at controls.

    Args:
        shot: designs and how they are observed.
        controls: ``draws x d`` tensor per model.
        gel: whether sensitivities to the gel are needed.
    """
    seen = [
        simulate_response(shot, part, v, gel=gel)
        for part, v in zip(shot.belief.models, controls, strict=True)
    ]
    orders = tuple(torch.argsort(~every.good, stable=True) for every in seen)
    return Gels(tuple(every[every.good] for every in seen), orders)
