"""Grids of second order to compare the spectral ones with: they share the maps and nothing else."""

from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.float64 import linspace, tensor, zeros
from imr_torch.simulate import Resolution
from imr_torch.simulate.grids import Grid, _crowd_nodes, _map_outside


@dataclass(frozen=True)
class DifferenceResolution(Resolution):
    """Central differences on nodes that are even in ``eta`` and ``xi``; nodes count the wall, the
    centre and infinity.
    """

    def grids(self) -> tuple[Grid, Grid]:
        nodes, first, second = _even_differences(self.inside)
        inside = _with_centre(*_crowd_nodes(nodes, first, second, self.stretch))
        return inside, _outside(self.outside, self.reach)


@dataclass(frozen=True)
class AuthorsResolution(Resolution):
    """The published code's grid: uniform in ``y`` inside; it has ``reach = 2``."""

    def grids(self) -> tuple[Grid, Grid]:
        return _with_centre(*_even_differences(self.inside)), _outside(
            self.outside, self.reach
        )


def _outside(nodes: int, reach: float) -> Grid:
    xi = linspace(1.0, -1.0, nodes)
    first, second = _central(nodes, xi[0] - xi[1])
    return _map_outside(xi, first, second, reach)


def _even_differences(nodes: int) -> tuple[Tensor, Tensor, Tensor]:
    """``nodes`` points from wall to centre, and second-order derivatives of a field that is even
    there.
    """
    y = linspace(1.0, 0.0, nodes)
    step = y[0] - y[1]
    first, second = _central(nodes, step)
    first[-1] = 0.0
    second[-1, -1], second[-1, -2] = -2.0 / step**2, 2.0 / step**2
    return y, first, second


def _with_centre(y: Tensor, first: Tensor, second: Tensor) -> Grid:
    """A grid whose last node is the centre, where ``(2/y) d/dy`` is twice the second derivative."""
    laplacian = torch.cat(((second + 2.0 / y[:, None] * first)[:-1], 3.0 * second[-1:]))
    return Grid(y[1:].clone(), first.contiguous(), laplacian[1:].contiguous())


def _central(nodes: int, step: Tensor) -> tuple[Tensor, Tensor]:
    """First and second central differences on nodes in falling order.

    One-sided and second-order at the wall.
    """
    first = zeros(nodes, nodes)
    second = torch.zeros_like(first)
    inner = torch.arange(1, nodes - 1)
    first[inner, inner - 1], first[inner, inner + 1] = 0.5 / step, -0.5 / step
    second[inner, inner - 1] = second[inner, inner + 1] = 1.0 / step**2
    second[inner, inner] = -2.0 / step**2
    first[0, :3] = tensor([1.5, -2.0, 0.5]) / step
    return first, second
