"""Spectral grids for the fields inside and outside the bubble.

Inside, even Chebyshev collocation on the mapped coordinate ``y = r/R = tanh(beta eta)/tanh(beta)``
resolves the thermal boundary layer with some sixteen nodes; outside, Chebyshev on ``y = 1 + L (1 -
xi)/(1 + xi)`` reaches to infinity. References: Boyd, Chebyshev and Fourier Spectral Methods (2001), ch. 6, 8 and 17; Trefethen,
Spectral Methods in MATLAB (2000), ch. 6 and 11.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.float64 import arange, eye


@dataclass(frozen=True)
class Grid:
    """Collocation nodes on one side of the wall, and derivatives of a field known at the wall and
    at the nodes.

    Args:
        nodes: ``r/R`` of the nodes; the wall (``r/R = 1``) is not among them.
        first: ``d/dy``; row and column 0 are the wall.
        laplacian: ``d^2/dy^2 + (2/y) d/dy`` at the nodes.
    """

    nodes: Float[Tensor, "nodes"]
    first: Float[Tensor, "nodes+1 nodes+1"]
    laplacian: Float[Tensor, "nodes nodes+1"]

    def __len__(self) -> int:
        return self.nodes.shape[0]

    def to(self, like: Float[Tensor, "..."]) -> "Grid":
        """The grid in the dtype and on the device of ``like``."""
        return Grid(self.nodes.to(like), self.first.to(like), self.laplacian.to(like))


@dataclass(frozen=True)
class Resolution:
    """How finely space is cut.

    Args:
        inside: nodes in the bubble.
        outside: nodes in the gel.
        stretch: ``beta``, how much the inner nodes crowd at the wall.
        reach: ``L``, the distance from the wall, in radii, within which half of the outer nodes
            lie.

    >>> from imr_torch.simulate import Accuracy, Resolution, TransportSimulator
    >>> fine = TransportSimulator(accuracy=Accuracy(1e-5, Resolution(inside=24, outside=24)))
    >>> [len(grid) for grid in fine.accuracy.resolution.grids()]
    [24, 24]
    """

    inside: int = 18
    outside: int = 18
    stretch: float = 2.0
    reach: float = 0.02

    def __post_init__(self) -> None:
        if not (4 <= self.inside <= 512 and 4 <= self.outside <= 512):
            raise InputDataError(
                f"Resolution has {self.inside} and {self.outside} nodes; expected 4 to 512 on "
                "each side."
            )
        if not (0.0 < self.stretch <= 6.0 and self.reach > 0.0):
            raise InputDataError(
                f"Resolution.stretch is {self.stretch} and reach {self.reach}; expected 0 < "
                "stretch <= 6 and reach > 0."
            )

    def grids(self) -> tuple[Grid, Grid]:
        """The grids of the bubble and of the gel, float64."""
        return chebyshev_inside(self.inside, self.stretch), chebyshev_outside(
            self.outside, self.reach
        )


def chebyshev_inside(n: int, stretch: float) -> Grid:
    """Even Chebyshev collocation with ``n`` nodes between centre and wall, none at either.

    Args:
        n: nodes.
        stretch: ``beta`` of ``y = tanh(beta eta)/tanh(beta)``.
    """
    eta, slope = _chebyshev_nodes(2 * n + 1)
    curvature = slope @ slope
    half = slice(0, n + 1)
    slope, curvature = (
        m[half, half] + m[half, n + 1 :].flip(1) for m in (slope, curvature)
    )
    return _make_grid(*_crowd_nodes(eta[half], slope, curvature, stretch))


def chebyshev_outside(m: int, reach: float) -> Grid:
    """Chebyshev collocation with ``m`` nodes between wall and infinity, where the field vanishes.

    Args:
        m: nodes.
        reach: ``L`` of ``y = 1 + L (1 - xi)/(1 + xi)``.
    """
    xi, slope = _chebyshev_nodes(m + 1)
    return _map_outside(xi, slope, slope @ slope, reach)


def _crowd_nodes(
    eta: Tensor, slope: Tensor, curvature: Tensor, stretch: float
) -> tuple[Tensor, Tensor, Tensor]:
    """``y = tanh(beta eta)/tanh(beta)``, and derivatives in ``eta`` turned into derivatives in
    ``y``.
    """
    y = torch.tanh(stretch * eta) / math.tanh(stretch)
    rate = math.tanh(stretch) / stretch * torch.cosh(stretch * eta) ** 2
    bend = 2.0 * stretch * torch.tanh(stretch * eta) * rate
    return y, *_map_derivatives(slope, curvature, rate, bend)


def _map_outside(xi: Tensor, slope: Tensor, curvature: Tensor, reach: float) -> Grid:
    """Map derivatives in ``xi`` to ``y``, and drop infinity."""
    xi = xi[:-1]
    rate = -((1.0 + xi) ** 2) / (2.0 * reach)
    bend = -(1.0 + xi) / reach
    mapped = _map_derivatives(slope[:-1, :-1], curvature[:-1, :-1], rate, bend)
    return _make_grid(1.0 + reach * (1.0 - xi) / (1.0 + xi), *mapped)


def _map_derivatives(
    slope: Tensor, curvature: Tensor, rate: Tensor, bend: Tensor
) -> tuple[Tensor, Tensor]:
    """First and second derivative in ``y`` from those in the coordinate ``xi`` of a polynomial: with
    ``rate = d xi/dy`` and ``bend``, its derivative in ``xi``.
    """
    first = rate[:, None] * slope
    return first, rate[:, None] * (bend[:, None] * slope + rate[:, None] * curvature)


def _make_grid(y: Tensor, first: Tensor, second: Tensor) -> Grid:
    laplacian = second + 2.0 / y[:, None] * first
    return Grid(y[1:].clone(), first.contiguous(), laplacian[1:].contiguous())


def _chebyshev_nodes(count: int) -> tuple[Tensor, Tensor]:
    """The ``count + 1`` Chebyshev extrema from 1 to -1 and their derivative (Trefethen 2000, eqs.

    6.3-6.5).
    """
    index = arange(count + 1)
    x = torch.cos(math.pi * index / count)
    weight = torch.where((index == 0) | (index == count), 2.0, 1.0) * (-1.0) ** index
    sums = 0.5 * (index[:, None] + index)
    differences = 0.5 * (index - index[:, None])
    # x_i - x_j, exactly
    distance = (
        2.0 * torch.sin(math.pi * sums / count) * torch.sin(math.pi * differences / count)
    )
    matrix = weight[:, None] / weight / (distance + eye(count + 1))
    matrix.fill_diagonal_(0.0)
    return x, matrix - torch.diag(matrix.sum(1))
