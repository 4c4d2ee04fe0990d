"""Linear systems of the implicit step: three small dense blocks, bordered by the five numbers that
couple them.

Temperature in the bubble (``tau``), vapour (``C``, driven by ``tau``) and temperature in the gel
(``theta``) see each other only through the border ``z = (R, U, p, q, tau_w)``, with ``p = ln P``
and ``q = dp/dt`` as an extra unknown. Memory states of the gel see ``R`` and ``U`` only and join
the border. Eliminating the fields leaves a border of five numbers and the memory, so a
factorisation costs three inverses of the size of one field.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_LARGE = 64  # nodes from which on LAPACK is faster; the grids meant for use have a third of that


@dataclass(frozen=True)
class Jacobian:
    """The derivative of the right-hand side in its structured form; see
    :mod:`imr_torch.simulate.rhs`.

    Border columns are in the order (R, U, p, q, tau_w); ``G = 2`` fields live inside, ``tau`` and
    ``C``.

    Args:
        inside: ``d tau_t/d tau`` and ``d C_t/d C``.
        outside: ``d theta_t/d theta``.
        inside_border: derivatives of ``tau_t`` and ``C_t`` in the border.
        outside_border: ``m x 5 x B`` tensor.
        coupling_slope: factor of ``d/dy tau`` in ``C_t``.
        coupling: factor of ``tau`` in ``C_t``.
        velocity_row: ``dU'`` in (R, U, p, q).
        pressure_row: ``q`` in the border (0 for itself).
        wall_row: the wall's heat balance in the border.
        pressure_slopes: ``q`` in the slopes of ``tau`` and ``C`` at the wall.
        wall_slopes: the wall's balance in the slopes of ``tau``, ``C`` and ``theta`` at the wall.
        velocity_time: ``dU'/dt`` at a fixed state.
        velocity_memory: ``dU'`` in the gel's memory states.
        memory_rows: ``d memory_t`` in (R, U).
        memory_memory: ``d memory_t/d memory``.
    """

    inside: Float[Tensor, "inside inside 2 members"]
    outside: Float[Tensor, "outside outside members"]
    inside_border: Float[Tensor, "inside 5 2 members"]
    outside_border: Float[Tensor, "outside 5 members"]
    coupling_slope: Float[Tensor, "inside members"]
    coupling: Float[Tensor, "inside members"]
    velocity_row: Float[Tensor, "4 members"]
    pressure_row: Float[Tensor, "5 members"]
    wall_row: Float[Tensor, "5 members"]
    pressure_slopes: Float[Tensor, "2 members"]
    wall_slopes: Float[Tensor, "3 members"]
    velocity_time: Float[Tensor, "members"]
    velocity_memory: Float[Tensor, "states members"]
    memory_rows: Float[Tensor, "states 2 members"]
    memory_memory: Float[Tensor, "states states members"]


def invert(blocks: Float[Tensor, "rows rows *batch"]) -> Float[Tensor, "rows rows *batch"]:
    """Inverse of each ``blocks[:, :, b]``, batch last, by Gauss-Jordan without pivoting, possibly
    in place.

    The blocks are ``I/(h gamma) - J`` with dissipative ``J``. A vanishing pivot gives non-finite
    numbers, which make the step fail and be tried again at a smaller ``h``, where the identity
    dominates.
    """
    if blocks.shape[0] > _LARGE:
        batch_first = blocks.reshape(*blocks.shape[:2], -1).permute(2, 0, 1)
        return torch.linalg.inv_ex(batch_first)[0].permute(1, 2, 0).reshape(blocks.shape)
    columns = blocks.unbind(1)
    for k, row in enumerate(blocks.unbind(0)):
        pivot = row[k].reciprocal()
        scaled = row * pivot
        scaled[k] = pivot
        column = columns[k].clone()
        column[k] = 0.0
        columns[k].zero_()
        row.copy_(scaled)
        blocks.addcmul_(column[:, None], scaled[None], value=-1.0)
    return blocks


class Factors:
    """``I/(h gamma) - J`` (0 for the identity in the algebraic row), ready to be solved for several
    right-hand sides.

    Args:
        jacobian: its entries in ``inside`` and ``outside`` may be overwritten.
        shift: ``B`` tensor, ``1/(h gamma)``.
        slope: ``n x n`` tensor, ``d/dy`` at the inner nodes from the inner nodes.
        wall_slope: ``n`` tensor, ``d/dy`` at the wall from the inner nodes.
        outer_wall_slope: ``m`` tensor, the same outside.
    """

    def __init__(
        self,
        jacobian: Jacobian,
        shift: Float[Tensor, "members"],
        slope: Tensor,
        wall_slope: Tensor,
        outer_wall_slope: Tensor,
    ) -> None:
        self._jacobian = jacobian
        self._shift = shift
        self._slope = slope
        self._inside, self._outside = _shifted_inverses(jacobian.inside, jacobian.outside, shift)
        self._heat, self._vapour = self._inside.unbind(2)
        n = len(self._heat)
        m = len(self._outside)
        self._fields = (n, n, m)
        self._parts = (3, 1, 2 * n + m, jacobian.velocity_memory.shape[0])
        rows = self._wall_functionals(wall_slope, outer_wall_slope)
        self._functionals = torch.cat(rows, 1)
        self._border = invert(self._border_matrix(*rows))

    def _wall_functionals(
        self, wall_slope: Tensor, outer_wall_slope: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What the fields' right-hand sides add to the rows of ``q`` and of the wall, through the
        slopes at the wall.

        Returns:
            Tensors ``2 x n x B`` (tau), ``2 x n x B`` (C) and ``2 x m x B`` (theta).
        """
        j = self._jacobian
        heat, vapour = (wall_slope[:, None, None, None] * self._inside).sum(0).unbind(1)
        through = self._slope.T @ (vapour * j.coupling_slope) + vapour * j.coupling
        heat_to_vapour = (through[:, None] * self._inside[:, :, 0]).sum(0)
        gel = (outer_wall_slope[:, None, None] * self._outside).sum(0)
        by_heat, by_vapour = torch.stack((j.pressure_slopes, j.wall_slopes[:2]), 1)[:, :, None]
        outer = torch.zeros(2, *gel.shape, dtype=gel.dtype, device=gel.device)
        outer[1] = j.wall_slopes[2] * gel
        return by_heat * heat + by_vapour * heat_to_vapour, by_vapour * vapour, outer

    def _border_matrix(self, heat: Tensor, vapour: Tensor, outer: Tensor) -> Tensor:
        """The system in (R, U, p, q, tau_w, memory) that is left when the fields are eliminated,
        ``(5+K) x (5+K) x B``.
        """
        j = self._jacobian
        shift = self._shift
        size = 5 + j.velocity_memory.shape[0]
        matrix = shift.new_zeros(size, size, shift.shape[0])
        matrix[0, 0] = matrix[2, 2] = shift
        matrix[0, 1] = matrix[2, 3] = -1.0
        matrix[1, :4] = -j.velocity_row
        matrix[1, 1] += shift
        rows = (heat[:, :, None] * j.inside_border[:, :, 0]).sum(1) + (
            vapour[:, :, None] * j.inside_border[:, :, 1]
        ).sum(1)
        rows += (outer[:, :, None] * j.outside_border).sum(1)
        matrix[3:5, :5] = -rows
        matrix[3, :5] -= j.pressure_row
        matrix[3, 3] += 1.0
        matrix[4, :5] -= j.wall_row
        matrix[1, 5:] = -j.velocity_memory
        matrix[5:, :2] = -j.memory_rows
        matrix[5:, 5:] = -j.memory_memory
        matrix[5:, 5:].diagonal(dim1=0, dim2=1).add_(shift[:, None])
        return matrix

    def solve(self, right: Float[Tensor, "state members"]) -> Float[Tensor, "state members"]:
        """Solve for one right-hand side, ``(4 + 2n + m + K) x B`` in the layout of the state."""
        j = self._jacobian
        motion, wall, fields, memory = right.split_with_sizes(self._parts)
        inputs = torch.cat((motion, (self._functionals * fields).sum(1), memory))
        inputs[4] += wall[0]
        border = (self._border * inputs).sum(1)
        motion, _, wall, memory = border.split_with_sizes((3, 1, 1, len(border) - 5))
        border = border[:5]
        by_heat, by_vapour = (j.inside_border * border[:, None]).sum(1).unbind(1)
        heat, vapour, gel = fields.split_with_sizes(self._fields)
        heat = (self._heat * (heat + by_heat)).sum(1)
        drive = vapour + by_vapour + j.coupling_slope * (self._slope @ heat) + j.coupling * heat
        vapour = (self._vapour * drive).sum(1)
        gel = (self._outside * (gel + (j.outside_border * border).sum(1))).sum(1)
        return torch.cat((motion, wall, heat, vapour, gel, memory))


def _shifted_inverses(inside: Tensor, outside: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """``(diag(shift) - blocks)^-1`` of the fields inside and outside, in one go where they are of
    one size.
    """
    blocks = [inside, outside[:, :, None]]
    if inside.shape[0] == outside.shape[0]:
        blocks = [torch.cat(blocks, 2)]
    for block in blocks:
        block.neg_()
        block.diagonal(dim1=0, dim2=1).add_(shift[:, None])
    inverses = [invert(block) for block in blocks]
    return inverses[0][:, :, :2], inverses[-1][:, :, -1]
