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
from imr_torch.types import DatasetValues


@dataclass(frozen=True)
class Gels:
    """Gels of all models, drawn and simulated.

    Args:
        parts: gels of each model that could be simulated.
        controls: ``draws x d`` tensor per model: all that were drawn, those that could be simulated
            first.
        orders: ``draws`` tensor per model: the numbers of the draws in that order.
    """

    parts: tuple[Response, ...]
    controls: tuple[Float[Tensor, "_ _"], ...]
    orders: tuple[Int[Tensor, "_"], ...]


@dataclass(frozen=True)
class Drawn(Gels):
    """Gels of all models, and one datum of each that could be simulated.

    Args:
        parts: see :class:`Gels`.
        controls: see :class:`Gels`.
        orders: see :class:`Gels`.
        data: of all gels, model after model.
        rows: which data are of each model.
    """

    data: Data
    rows: tuple[slice, ...]

    def rows_outside(self, model: int) -> Int[Tensor, "rows"]:
        """Rows of data that are of other models."""
        rows = torch.arange(len(self.data))
        return torch.cat((rows[: self.rows[model].start], rows[self.rows[model].stop :]))


def normal_controls(
    shot: Shot, counts: Sequence[int], source: torch.Generator
) -> list[Float[Tensor, "draws _"]]:
    """Draws of the Gaussian of each model, as many as ``counts`` says: ``draws x d``."""
    return [
        torch.randn(count, len(part.names), generator=source, dtype=torch.float64)
        for part, count in zip(shot.belief.models, counts, strict=True)
    ]


def cloud_controls(
    shot: Shot, draws: int, source: torch.Generator
) -> list[Float[Tensor, "draws _"]]:
    """Draws of each model, ``draws x d``: from its stored posterior draws (``cloud``), or its
    Gaussian if it has none.
    """
    drawn = normal_controls(shot, [draws] * len(shot.belief.models), source)
    for i, part in enumerate(shot.belief.models):
        if part.cloud is not None:
            rows = torch.randperm(len(part.cloud.controls), generator=source)
            rows = rows.repeat(-(-draws // len(rows)))[:draws]
            away = part.cloud.controls[rows] - part.mean
            drawn[i] = torch.linalg.solve_triangular(part.chol, away.mT, upper=False).mT
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
    orders = [torch.argsort(~every.good, stable=True) for every in seen]
    return Gels(
        tuple(every[every.good] for every in seen),
        tuple(every.controls[order] for every, order in zip(seen, orders, strict=True)),
        tuple(orders),
    )


def draw_data(
    shot: Shot,
    controls: Sequence[Float[Tensor, "_ _"]],
    source: torch.Generator,
    *,
    gel: bool = True,
) -> Drawn:
    """Simulate the gels of each model at controls, and a datum of each that could be simulated."""
    gels = simulate_gels(shot, controls, gel=gel)
    data = [observe_gels(part, shot.plan, source) for part in gels.parts]
    together = Data(torch.cat([d.radius for d in data]), torch.cat([d.window for d in data]))
    ends = torch.tensor([0, *map(len, data)]).cumsum(0).tolist()
    rows = tuple(slice(first, end) for first, end in pairwise(ends))
    return Drawn(gels.parts, gels.controls, gels.orders, together, rows)


def model_weights(shot: Shot) -> list[float]:
    """Probability of each model."""
    return shot.belief.log_probabilities.exp().tolist()


def mixture_evidence(logs: Sequence[DatasetValues], shot: Shot) -> DatasetValues:
    """Log evidence of each datum over all models, from that under each."""
    return torch.logsumexp(torch.stack(list(logs)) + shot.belief.log_probabilities[:, None], dim=0)
