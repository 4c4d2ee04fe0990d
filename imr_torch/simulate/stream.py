"""Members streaming through slots: each with its own time and step, leaving when done, making room for the next.

A step common to a batch would be dictated by whoever collapses. Here every slot holds one bubble that advances by its
own step; a bubble that is done or has failed leaves, and one that waits takes its slot, so that the batch stays full.

A slot may hold a *bundle* instead: a leader and followers that differ a little from it. All take the leader's steps, so
that their discretisation errors differ as smoothly as the bubbles do, and differences between them are derivatives of
the discrete solution (internal numerical differentiation: Bock, in Modelling of Chemical Reaction Systems, Springer
1981). A follower's step is the leader's in proportion to their time scales, or its collapse would move through the
leader's fine steps and back, which changes the errors more than the bubble: sensitivities then err by 10 %, and not by
.1 %. Steps controlled by each one's own error are no better, since in violent collapses they depend chaotically on it.
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
_REST = 0.3  # keeps the time scale finite where nothing moves
_PATIENCE = 1.1  # a leader goes on beyond its last time, by so much at most, until its followers arrive
_IDLE = 16  # slots are refilled once one in so many is idle: refilling gathers everything


@dataclass(frozen=True)
class Path:
    """The accepted steps of a batch.

    Args:
        nodes: ``6 x B x n`` tensor: t, R, U, U', ln P, d ln P/dt; entries from ``count`` on repeat the last.
        count: ``B`` integer tensor, how many nodes each member has.
        status: ``B`` integer tensor; that of a follower is its leader's.
    """

    nodes: Tensor
    count: Tensor
    status: Tensor

    def at(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Radius, velocity and pressure at ``times`` (``B x n_t``); NaN where a member did not get."""
        nodes = self.nodes
        radius, velocity = interpolate(nodes[0], nodes[1], nodes[2], nodes[3], times)
        pressure = torch.exp(_cubic(nodes[0], nodes[4], nodes[5], times))
        known = times <= nodes[0, :, -1:]
        return tuple(torch.where(known, values, torch.nan) for values in (radius, velocity, pressure))  # pyright: ignore


def _cubic(nodes: Tensor, values: Tensor, rates: Tensor, times: Tensor) -> Tensor:
    """Cubic Hermite interpolation, linear before the first node; see :func:`imr_torch.simulate.clock.interpolate`."""
    right = torch.searchsorted(nodes, times.contiguous()).clamp(1, nodes.shape[1] - 1)
    t0, t1, v0, v1, r0, r1 = (x.gather(1, i) for x in (nodes, values, rates) for i in (right - 1, right))
    h = (t1 - t0).clamp_min(torch.finfo(times.dtype).tiny)
    s = (times - t0) / h
    rise, r0, r1 = v1 - v0, r0 * h, r1 * h
    bend, twist = (torch.where(s < 0.0, 0.0, c) for c in (3.0 * rise - 2.0 * r0 - r1, r0 + r1 - 2.0 * rise))
    return v0 + s * (r0 + s * (bend + s * twist))


class Stream:
    """The integration of a batch.

    Args:
        equations: of all members, bundle after bundle, the leader first.
        last: tensor of the time that each bundle has to reach.
        controller: chooses the steps.
        slots: members that advance together.
        max_steps: attempted steps after which a bundle is given up.
        width: members in a bundle, the leader included.
    """

    def __init__(
        self, equations: Equations, last: Tensor, controller: Controller, slots: int, max_steps: int, width: int = 1
    ) -> None:
        self._all, self._last, self._controller, self._max_steps = equations, last, controller, max_steps
        self._width = width
        total = last.shape[0]
        self._status = torch.full((total,), _RUNNING, device=last.device)
        self._count = torch.zeros_like(self._status)
        self._nodes = last.new_zeros(_RECORDED, total, width, 256)
        self._next = min(max(1, slots // width), total)
        self._enter(torch.arange(self._next, device=last.device))

    def run(self) -> Path:
        """Integrate all members to their last times."""
        while self._bundle.numel():
            self._tick()
        position = torch.arange(self._nodes.shape[3], device=self._last.device)
        position = torch.minimum(position, (self._count - 1)[:, None])[:, : max(2, int(self._count.max()))]
        nodes = self._nodes.gather(3, position[:, None].expand(*self._nodes.shape[:3], -1))
        return Path(nodes.flatten(1, 2), self._each(self._count), self._each(self._status))

    def _each(self, values: Tensor) -> Tensor:
        """What holds for bundles, for each of their members."""
        return values.repeat_interleave(self._width, -1)

    def _members(self, bundles: Tensor) -> Tensor:
        """Indices of the members of these bundles."""
        return (bundles[:, None] * self._width + torch.arange(self._width, device=bundles.device)).flatten()

    def _enter(self, bundles: Tensor) -> None:
        """Fill all slots with bundles at their start."""
        self._bundle = bundles
        self._equations = self._all.take(self._members(bundles))
        self._state = self._equations.start()
        self._time = torch.zeros_like(self._each(self._last[bundles]))
        self._step = torch.full_like(self._last[bundles], self._controller.first)
        self._tries = torch.zeros_like(bundles)
        self._grow_freely = torch.ones_like(bundles, dtype=torch.bool)
        self._running = torch.ones_like(bundles, dtype=torch.bool)

    def _tick(self) -> None:
        """One step of every slot; those that are done leave."""
        length = self._step if self._width == 1 else self._lengths()
        step = rosenbrock_step(self._equations, self._state, length, self._time)
        self._record(step.acceleration, step.pressure_rate)
        leaders = (x[:, :: self._width] for x in (self._state, step.state, step.error))
        error = self._controller.error(*leaders, self._equations)
        factor = self._controller.factor(error)
        factor = torch.where(self._grow_freely, factor, factor.clamp_max(1.0))
        self._judge(torch.isfinite(error))
        accepted = (error <= 1.0) & self._running
        self._count[self._bundle] += accepted.long()
        self._grow_freely = accepted
        each = self._each(accepted)
        self._state = torch.where(each, step.state, self._state)
        self._time = torch.where(each, self._time + length, self._time)
        self._step = torch.where(self._running, self._step * factor, self._step)
        self._tries += 1
        idle = self._running.shape[0] - int(self._running.sum())
        if idle * _IDLE >= self._running.shape[0]:
            self._turn_over()

    def _lengths(self) -> Tensor:
        """The leaders' steps, for each member in proportion to its time scale (as in :mod:`imr_torch.simulate.clock`)."""
        radius, velocity, log_pressure = self._state[:3]
        pace = radius * torch.rsqrt(_REST + torch.exp(log_pressure) + velocity * velocity)
        return self._each(self._step) * (pace / self._each(pace[:: self._width]))

    def _record(self, acceleration: Tensor, pressure_rate: Tensor) -> None:
        """Write the state before the step at each member's next node; a rejected step writes the same again."""
        at = self._count[self._bundle]
        if int(at.max()) >= self._nodes.shape[3]:
            self._nodes = torch.cat((self._nodes, torch.zeros_like(self._nodes)), 3)
        radius, velocity, log_pressure = self._state[:3]
        log_rate = pressure_rate * torch.exp(-log_pressure)
        row = torch.stack((self._time, radius, velocity, acceleration, log_pressure, log_rate))
        self._nodes[:, self._bundle, :, at] = row.unflatten(1, (-1, self._width)).movedim(1, 0)

    def _judge(self, finite: Tensor) -> None:
        """Which bundles are done, and which are given up. The count of one that leaves includes its last node."""
        radius, time = self._state[0, :: self._width], self._time[:: self._width]
        stuck = self._step < 1e-14 * (1.0 + time)
        verdict = torch.full_like(self._bundle, _RUNNING)
        verdict[self._tries >= self._max_steps] = int(Status.TOO_MANY_STEPS)
        verdict[stuck] = int(Status.STEP_UNDERFLOW)
        verdict[stuck & ~finite] = int(Status.NON_FINITE)
        verdict[radius > _RUNAWAY] = int(Status.RUNAWAY)
        last = self._last[self._bundle]
        behind = (self._time < self._each(last)).unflatten(0, (-1, self._width)).any(1)  # a follower that failed is not
        verdict[~behind | (time >= _PATIENCE * last) & (time >= last)] = int(Status.DONE)
        leaving = self._running & (verdict != _RUNNING)
        self._status[self._bundle] = torch.where(leaving, verdict, self._status[self._bundle])
        self._count[self._bundle] += leaving.long()
        self._running &= ~leaving

    def _turn_over(self) -> None:
        """Take out idle slots and let waiting bundles in."""
        keep = torch.nonzero(self._running)[:, 0]
        room = self._running.shape[0] - keep.numel()
        fresh = torch.arange(self._next, min(self._next + room, self._last.shape[0]), device=keep.device)
        self._next += fresh.numel()
        members, kept = self._members(keep), keep.numel()
        state, time = self._state[:, members], self._time[members]
        step, tries, grow_freely = self._step[keep], self._tries[keep], self._grow_freely[keep]
        self._enter(torch.cat((self._bundle[keep], fresh)))
        self._state[:, : len(members)], self._time[: len(members)] = state, time
        self._step[:kept], self._tries[:kept], self._grow_freely[:kept] = step, tries, grow_freely
