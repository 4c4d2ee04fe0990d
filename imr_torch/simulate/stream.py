"""Members streaming through slots: each with its own time and step, leaving when done, making room for the next.

A step common to a batch would be dictated by whoever collapses. Here every slot holds one bubble that advances by its
own step; a bubble that is done or has failed leaves, and one that waits takes its slot, so that the batch stays full.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.simulate.clock import interpolate
from imr_torch.simulate.controller import Controller
from imr_torch.simulate.rhs import Equations
from imr_torch.simulate.rosenbrock import rosenbrock_step
from imr_torch.simulate.simulator import Status

_RUNAWAY = 3.0
_RUNNING = -1
_RECORDED = 6  # t, R, U, U', ln P, d ln P/dt
_IDLE = 16  # slots are refilled once one in so many is idle: refilling gathers everything


@dataclass(frozen=True)
class Path:
    """The accepted steps of a batch.

    Args:
        nodes: ``6 x B x n`` tensor: t, R, U, U', ln P, d ln P/dt; entries from ``count`` on repeat the last.
        count: ``B`` integer tensor, how many nodes each member has.
        status: ``B`` integer tensor.
    """

    nodes: Tensor
    count: Tensor
    status: Tensor

    def at(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Radius, velocity and pressure at ``times`` (``B x n_t``); NaN where a failed member did not get."""
        nodes = self.nodes
        radius, velocity = interpolate(nodes[0], nodes[1], nodes[2], nodes[3], times)
        pressure = torch.exp(_cubic(nodes[0], nodes[4], nodes[5], times))
        known = (self.status == Status.DONE)[:, None] | (times <= nodes[0, :, -1:])
        return tuple(torch.where(known, values, torch.nan) for values in (radius, velocity, pressure))  # pyright: ignore


def _cubic(nodes: Tensor, values: Tensor, rates: Tensor, times: Tensor) -> Tensor:
    """Cubic Hermite interpolation; arguments as in :func:`imr_torch.simulate.clock.interpolate`."""
    right = torch.searchsorted(nodes, times.contiguous()).clamp(1, nodes.shape[1] - 1)
    t0, t1, v0, v1, r0, r1 = (x.gather(1, i) for x in (nodes, values, rates) for i in (right - 1, right))
    h = (t1 - t0).clamp_min(torch.finfo(times.dtype).tiny)
    s = (times - t0) / h
    rise, r0, r1 = v1 - v0, r0 * h, r1 * h
    return v0 + s * (r0 + s * (3.0 * rise - 2.0 * r0 - r1 + s * (r0 + r1 - 2.0 * rise)))


class Stream:
    """The integration of a batch.

    Args:
        equations: of all members.
        last: ``B`` tensor, the time that each has to reach.
        controller: chooses the steps.
        slots: members that advance together.
        max_steps: attempted steps after which a member is given up.
    """

    def __init__(self, equations: Equations, last: Tensor, controller: Controller, slots: int, max_steps: int) -> None:
        self._all, self._last, self._controller, self._max_steps = equations, last, controller, max_steps
        total = last.shape[0]
        self._status = torch.full((total,), _RUNNING, device=last.device)
        self._count = torch.zeros_like(self._status)
        self._nodes = last.new_zeros(_RECORDED, total, 256)
        self._next = min(slots, total)
        self._enter(torch.arange(self._next, device=last.device))

    def run(self) -> Path:
        """Integrate all members to their last times."""
        while self._member.numel():
            self._tick()
        position = torch.arange(self._nodes.shape[2], device=self._last.device).expand(self._last.shape[0], -1)
        position = torch.minimum(position, (self._count - 1)[:, None])[:, : max(2, int(self._count.max()))]
        return Path(self._nodes.gather(2, position.expand(_RECORDED, -1, -1)), self._count, self._status)

    def _enter(self, members: Tensor) -> None:
        """Fill all slots with members at their start."""
        self._member = members
        self._equations = self._all.take(members)
        self._state = self._equations.start()
        self._time = torch.zeros_like(self._last[members])
        self._step = torch.full_like(self._time, self._controller.first)
        self._tries = torch.zeros_like(members)
        self._grow_freely = torch.ones_like(members, dtype=torch.bool)
        self._running = torch.ones_like(members, dtype=torch.bool)

    def _tick(self) -> None:
        """One step of every slot; those that are done leave."""
        step = rosenbrock_step(self._equations, self._state, self._step, self._time)
        self._record(step.acceleration, step.pressure_rate)
        error = self._controller.error(self._state, step.state, step.error, self._equations)
        finite = torch.isfinite(error)
        accepted = (error <= 1.0) & self._running & (self._time < self._last[self._member])
        factor = self._controller.factor(error)
        self._judge(finite)
        accepted &= self._running
        self._state = torch.where(accepted, step.state, self._state)
        self._time = torch.where(accepted, self._time + self._step, self._time)
        self._count[self._member] += accepted.long()
        factor = torch.where(self._grow_freely, factor, factor.clamp_max(1.0))
        self._grow_freely = accepted
        self._step = torch.where(self._running, self._step * factor, self._step)
        self._tries += 1
        idle = self._running.shape[0] - int(self._running.sum())
        if idle * _IDLE >= self._running.shape[0]:
            self._turn_over()

    def _record(self, acceleration: Tensor, pressure_rate: Tensor) -> None:
        """Write the state before the step at each member's next node; a rejected step writes the same again."""
        at = self._count[self._member]
        if int(at.max()) >= self._nodes.shape[2]:
            self._nodes = torch.cat((self._nodes, torch.zeros_like(self._nodes)), 2)
        radius, velocity, log_pressure = self._state[:3]
        log_rate = pressure_rate * torch.exp(-log_pressure)
        row = torch.stack((self._time, radius, velocity, acceleration, log_pressure, log_rate))
        self._nodes[:, self._member, at] = row

    def _judge(self, finite: Tensor) -> None:
        """Who is done, and who is given up. The count of a member that leaves includes its last node."""
        radius = self._state[0]
        stuck = self._step < 1e-14 * (1.0 + self._time)
        verdict = torch.full_like(self._member, _RUNNING)
        verdict[self._tries >= self._max_steps] = int(Status.TOO_MANY_STEPS)
        verdict[stuck] = int(Status.STEP_UNDERFLOW)
        verdict[stuck & ~finite] = int(Status.NON_FINITE)
        verdict[radius > _RUNAWAY] = int(Status.RUNAWAY)
        verdict[self._time >= self._last[self._member]] = int(Status.DONE)
        leaving = self._running & (verdict != _RUNNING)
        self._status[self._member] = torch.where(leaving, verdict, self._status[self._member])
        self._count[self._member] += leaving.long()
        self._running &= ~leaving

    def _turn_over(self) -> None:
        """Take out idle slots and let waiting members in."""
        keep = torch.nonzero(self._running)[:, 0]
        room = self._running.shape[0] - keep.numel()
        fresh = torch.arange(self._next, min(self._next + room, self._last.shape[0]), device=keep.device)
        self._next += fresh.numel()
        old = (self._member[keep], self._state[:, keep], self._time[keep], self._step[keep], self._tries[keep])
        grow = self._grow_freely[keep]
        self._enter(torch.cat((old[0], fresh)))
        kept = keep.numel()
        self._state[:, :kept], self._time[:kept], self._step[:kept], self._tries[:kept] = old[1:]
        self._grow_freely[:kept] = grow
