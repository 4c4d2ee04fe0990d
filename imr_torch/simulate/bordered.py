"""Linear systems of the implicit step: three small dense blocks, bordered by the five numbers that couple them.

Temperature in the bubble (``tau``), vapour (``C``, driven by ``tau``) and temperature in the gel (``theta``) see each
other only through the border ``z = (R, U, p, q, tau_w)``, with ``p = ln P`` and ``q = dp/dt`` as an extra unknown.
Eliminating the fields leaves two equations for ``(q, tau_w)`` a member, so a factorisation costs three inverses of
the size of one field.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

_LARGE = 64  # nodes from which on LAPACK is faster; the grids meant for use have a third of that


@dataclass(frozen=True)
class Jacobian:
    """The derivative of the right-hand side in its structured form; see :mod:`imr_torch.simulate.rhs`.

    Border columns are in the order (R, U, p, q, tau_w); ``G = 2`` fields live inside, ``tau`` and ``C``.

    Args:
        inside: ``n x n x 2 x B`` tensor, ``d tau_t/d tau`` and ``d C_t/d C``.
        outside: ``m x m x B`` tensor, ``d theta_t/d theta``.
        inside_border: ``n x 5 x 2 x B`` tensor, derivatives of ``tau_t`` and ``C_t`` in the border.
        outside_border: ``m x 5 x B`` tensor.
        coupling_slope: ``n x B`` tensor, factor of ``d/dy tau`` in ``C_t``.
        coupling: ``n x B`` tensor, factor of ``tau`` in ``C_t``.
        velocity_row: ``4 x B`` tensor, ``dU'`` in (R, U, p, q).
        pressure_row: ``5 x B`` tensor, ``q`` in the border (0 for itself).
        wall_row: ``5 x B`` tensor, the wall's heat balance in the border.
        pressure_slopes: ``2 x B`` tensor, ``q`` in the slopes of ``tau`` and ``C`` at the wall.
        wall_slopes: ``3 x B`` tensor, the wall's balance in the slopes of ``tau``, ``C`` and ``theta`` at the wall.
    """

    inside: Tensor
    outside: Tensor
    inside_border: Tensor
    outside_border: Tensor
    coupling_slope: Tensor
    coupling: Tensor
    velocity_row: Tensor
    pressure_row: Tensor
    wall_row: Tensor
    pressure_slopes: Tensor
    wall_slopes: Tensor


def invert(blocks: Tensor) -> Tensor:
    """Inverse of each ``blocks[:, :, b]``, batch last, by Gauss-Jordan without pivoting, possibly in place.

    The blocks are ``I/(h gamma) - J`` with dissipative ``J``. A vanishing pivot gives non-finite numbers, which make
    the step fail and be tried again at a smaller ``h``, where the identity dominates.
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
    """``I/(h gamma) - J`` (0 for the identity in the algebraic row), ready to be solved for several right-hand sides.

    Args:
        jacobian: its entries in ``inside`` and ``outside`` may be overwritten.
        shift: ``B`` tensor, ``1/(h gamma)``.
        slope: ``n x n`` tensor, ``d/dy`` at the inner nodes from the inner nodes.
        wall_slope: ``n`` tensor, ``d/dy`` at the wall from the inner nodes.
        outer_wall_slope: ``m`` tensor, the same outside.
    """

    def __init__(
        self, jacobian: Jacobian, shift: Tensor, slope: Tensor, wall_slope: Tensor, outer_wall_slope: Tensor
    ) -> None:
        self._jacobian, self._shift, self._slope = jacobian, shift, slope
        self._inside, self._outside = _shifted_inverses(jacobian.inside, jacobian.outside, shift)
        self._border_rows(wall_slope, outer_wall_slope)
        self._eliminate()

    def _border_rows(self, wall_slope: Tensor, outer_wall_slope: Tensor) -> None:
        """Slopes at the wall as functionals of the fields' right-hand sides and of the border."""
        j = self._jacobian
        inside = (wall_slope[:, None, None, None] * self._inside).sum(0)  # n x 2 x B
        vapour = inside[:, 1]
        through = self._slope.T @ (vapour * j.coupling_slope) + vapour * j.coupling
        self._heat_to_vapour = (through[:, None] * self._inside[:, :, 0]).sum(0)
        self._inside_rows = inside
        self._outside_row = (outer_wall_slope[:, None, None] * self._outside).sum(0)
        by_border = (inside[:, None] * j.inside_border).sum(0)  # 5 x 2 x B
        heat, vapour_slope = by_border.unbind(1)
        vapour_slope = vapour_slope + (self._heat_to_vapour[:, None] * j.inside_border[:, :, 0]).sum(0)
        gel = (self._outside_row[:, None] * j.outside_border).sum(0)
        self._q_row = -(j.pressure_row + j.pressure_slopes[0] * heat + j.pressure_slopes[1] * vapour_slope)
        self._q_row[3] += 1.0
        self._w_row = -(j.wall_row + j.wall_slopes[0] * heat + j.wall_slopes[1] * vapour_slope + j.wall_slopes[2] * gel)

    def _eliminate(self) -> None:
        """Take R, U and p out of the border; the 2 x 2 system in (q, tau_w) remains."""
        step = self._shift.reciprocal()
        by_radius, by_velocity, by_pressure, by_rate = self._jacobian.velocity_row
        self._step = step
        self._velocity_pivot = (self._shift - by_velocity - by_radius * step).reciprocal()
        self._velocity_by_q = (by_rate + by_pressure * step) * self._velocity_pivot
        q, w = self._q_row, self._w_row
        self._q_velocity, self._w_velocity = q[1] + q[0] * step, w[1] + w[0] * step
        self._qq = q[3] + q[2] * step + self._q_velocity * self._velocity_by_q
        self._wq = w[3] + w[2] * step + self._w_velocity * self._velocity_by_q
        self._qw, self._ww = q[4], w[4]
        self._determinant = (self._qq * self._ww - self._qw * self._wq).reciprocal()

    def solve(self, right: Tensor) -> Tensor:
        """Solve for one right-hand side, ``(4 + 2n + m) x B`` in the layout of the state."""
        j, n = self._jacobian, self._inside.shape[0]
        fields, gel = right[4 : 4 + 2 * n].reshape(2, n, -1), right[4 + 2 * n :]
        border = self._solve_border(right[:4], fields, gel)
        solution = torch.empty_like(right)
        solution[:3], solution[3] = border[:3], border[4]
        sources = (j.inside_border * border[:, None]).sum(1)  # n x 2 x B
        heat = solution[4 : 4 + n] = (self._inside[:, :, 0] * (fields[0] + sources[:, 0])).sum(1)
        drive = fields[1] + sources[:, 1] + j.coupling_slope * (self._slope @ heat) + j.coupling * heat
        solution[4 + n : 4 + 2 * n] = (self._inside[:, :, 1] * drive).sum(1)
        gel = gel + (j.outside_border * border).sum(1)
        solution[4 + 2 * n :] = (self._outside * gel).sum(1)
        return solution

    def _solve_border(self, right: Tensor, fields: Tensor, gel: Tensor) -> Tensor:
        """(R, U, p, q, tau_w), ``5 x B``."""
        j, q, w = self._jacobian, self._q_row, self._w_row
        heat = (self._inside_rows[:, 0] * fields[0]).sum(0)
        vapour = (self._inside_rows[:, 1] * fields[1]).sum(0) + (self._heat_to_vapour * fields[0]).sum(0)
        outer = (self._outside_row * gel).sum(0)
        of_q = j.pressure_slopes[0] * heat + j.pressure_slopes[1] * vapour
        of_w = right[3] + j.wall_slopes[0] * heat + j.wall_slopes[1] * vapour + j.wall_slopes[2] * outer
        radius, velocity, pressure = right[0] * self._step, right[1], right[2] * self._step
        by_radius, _, by_pressure, _ = j.velocity_row
        velocity = (velocity + by_radius * radius + by_pressure * pressure) * self._velocity_pivot
        of_q = of_q - q[0] * radius - q[2] * pressure - self._q_velocity * velocity
        of_w = of_w - w[0] * radius - w[2] * pressure - self._w_velocity * velocity
        rate = (self._ww * of_q - self._qw * of_w) * self._determinant
        wall = (self._qq * of_w - self._wq * of_q) * self._determinant
        velocity = velocity + self._velocity_by_q * rate
        return torch.stack((radius + velocity * self._step, velocity, pressure + rate * self._step, rate, wall))


def _shifted_inverses(inside: Tensor, outside: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """``(diag(shift) - blocks)^-1`` of the fields inside and outside, in one go where they are of one size."""
    blocks = [inside, outside[:, :, None]]
    if inside.shape[0] == outside.shape[0]:
        blocks = [torch.cat(blocks, 2)]
    for block in blocks:
        block.neg_()
        block.diagonal(dim1=0, dim2=1).add_(shift[:, None])
    inverses = [invert(block) for block in blocks]
    return inverses[0][:, :, :2], inverses[-1][:, :, -1]
