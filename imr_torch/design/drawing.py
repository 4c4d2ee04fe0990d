"""Gels drawn from a belief, and one simulated datum of each: what the estimators with linearised
posteriors start from.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.design.likelihood import Data, observe
from imr_torch.design.response import Response, Shot, respond


@dataclass(frozen=True)
class Drawn:
    """Gels of all models that could be simulated, and one datum of each.

    Args:
        parts: gels of each model.
        controls: ``draws x d`` tensor per model: all that were drawn, those that could be simulated
            first.
        orders: ``draws`` tensor per model: the numbers of the draws in that order.
        data: of all gels, model after model.
        rows: which data are of each model.
    """

    parts: tuple[Response, ...]
    controls: tuple[Float[Tensor, "draws _"], ...]
    orders: tuple[Int[Tensor, "draws"], ...]
    data: Data
    rows: tuple[slice, ...]

    def outside(self, model: int) -> Int[Tensor, "rows"]:
        """Rows of data that are of other models."""
        rows = torch.arange(len(self.data))
        return torch.cat((rows[: self.rows[model].start], rows[self.rows[model].stop :]))


def normal_controls(
    shot: Shot, draws: int, source: torch.Generator
) -> list[Float[Tensor, "draws _"]]:
    """Draws of the Gaussian of each model, ``draws x d``."""
    return [
        torch.randn(draws, len(part.names), generator=source, dtype=torch.float64)
        for part in shot.belief.models
    ]


def cloud_controls(
    shot: Shot, draws: int, source: torch.Generator
) -> list[Float[Tensor, "draws _"]]:
    """Draws of each model, ``draws x d``: from its stored posterior draws (``cloud``), or its
    Gaussian if it has none.
    """
    drawn = normal_controls(shot, draws, source)
    for i, part in enumerate(shot.belief.models):
        if part.cloud is not None:
            rows = torch.randperm(len(part.cloud.controls), generator=source)
            rows = rows.repeat(-(-draws // len(rows)))[:draws]
            away = part.cloud.controls[rows] - part.mean
            drawn[i] = torch.linalg.solve_triangular(part.chol, away.mT, upper=False).mT
    return drawn


def draw(shot: Shot, controls: Sequence[Float[Tensor, "_ _"]], source: torch.Generator) -> Drawn:
    """Simulate the gels of each model at controls, and a datum of each that could be simulated."""
    responses = [
        respond(shot, part, v) for part, v in zip(shot.belief.models, controls, strict=True)
    ]
    parts = []
    ordered = []
    orders = []
    data = []
    rows = []
    first = 0
    for every in responses:
        orders.append(
            torch.cat((torch.nonzero(every.good)[:, 0], torch.nonzero(~every.good)[:, 0]))
        )
        ordered.append(every.controls[orders[-1]])
        parts.append(every[every.good])
        data.append(observe(parts[-1], shot.plan, source))
        rows.append(slice(first, first + len(parts[-1])))
        first += len(parts[-1])
    together = Data(torch.cat([d.radius for d in data]), torch.cat([d.window for d in data]))
    return Drawn(tuple(parts), tuple(ordered), tuple(orders), together, tuple(rows))


def model_weights(shot: Shot) -> list[float]:
    """Probability of each model."""
    return shot.belief.log_probabilities.exp().tolist()


def mixture(logs: Sequence[Float[Tensor, "data"]], shot: Shot) -> Float[Tensor, "data"]:
    """Log evidence of each datum over all models, from that under each."""
    return torch.logsumexp(torch.stack(list(logs)) + shot.belief.log_probabilities[:, None], dim=0)
