"""The polytropic simulator: Keller-Miksis with a gas spring, a whole batch at once.

The batch is integrated by ``torchdiffeq`` (fixed-step RK4) under the time transformation of
:mod:`imr_torch.simulate.clock`, in blocks of steps; members that have reached their last time leave after each block.
Members that fail are tried again with half the step before they are given up.
"""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torchdiffeq import odeint

from imr_torch.simulate.clock import interpolate, time_per_tick
from imr_torch.simulate.conditions import Conditions, Stepping
from imr_torch.simulate.simulator import Solution, Status, solve_batch
from imr_torch.simulate.wall import PolytropicBubble

_BLOCK = 32  # steps between two looks at who is done
_BATCH = 2000  # members solved together: larger batches leave the processor's cache
_RUNAWAY = 3.0


@dataclass(frozen=True)
class PolytropicSimulator:
    """A :class:`~imr_torch.simulate.Simulator` with polytropic gas and constant vapour pressure.

    Args:
        conditions: surroundings and gas.
        stepping: how finely time is cut.
    """

    conditions: Conditions = field(default_factory=Conditions)
    stepping: Stepping = field(default_factory=Stepping)

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        """Simulate a batch; see :class:`imr_torch.simulate.Simulator`.

        Raises:
            ShapeError: if shapes do not fit.
            InputDataError: if a design is impossible, or times are not increasing and finite.
        """
        return solve_batch(self._solve, _BATCH, (parameters, designs, times))

    def _solve(self, parameters: Tensor, designs: Tensor, times: Tensor) -> tuple[Tensor, ...]:
        """One block of members, with failed ones tried again at half the step."""
        bubble = PolytropicBubble.of(parameters, designs, self.conditions)
        stepping = self.stepping
        results = _march(bubble, times, stepping)
        for _ in range(stepping.retries):
            failed = torch.nonzero(results[3] != Status.DONE)[:, 0]
            if failed.numel() == 0:
                break
            stepping = replace(stepping, step=0.5 * stepping.step)
            again = _march(bubble.take(failed), times[failed], stepping)
            results = tuple(old.index_copy(0, failed, new) for old, new in zip(results, again, strict=True))
        return results


def _march(bubble: PolytropicBubble, times: Tensor, stepping: Stepping) -> tuple[Tensor, ...]:
    """Integrate until every member is past its last time; radius, velocity, pressure, status, steps."""
    count, last = times.shape[0], times[:, -1]
    one, zero = torch.ones_like(last), torch.zeros_like(last)
    state = torch.stack((one, zero, zero))  # R, U, t of every member
    history = [state[None]]
    status = torch.full((count,), int(Status.TOO_MANY_STEPS), device=times.device)
    steps = torch.zeros_like(status)
    active = torch.arange(count, device=times.device)
    ticks = stepping.step * torch.arange(_BLOCK + 1, dtype=times.dtype, device=times.device)
    for _ in range(0, stepping.max_steps, _BLOCK):
        moving = bubble if active.numel() == count else bubble.take(active)
        path = odeint(_field(moving), state[:, active], ticks, method="rk4")
        assert isinstance(path, Tensor)  # a tuple only for tuple states
        history.append(state.expand(_BLOCK, *state.shape).index_copy(2, active, path[1:]))
        state = history[-1][-1]
        steps[active] += _BLOCK
        status[active] = _judge(path, last[active])
        active = torch.nonzero(status == Status.TOO_MANY_STEPS)[:, 0]
        if active.numel() == 0:
            break
    return *_read(bubble, torch.cat(history), times, status), status, steps


def _field(bubble: PolytropicBubble):
    """Right-hand side in stretched time of the state (R, U, t), ``3 x B``."""
    stiffness = 4.0 * bubble.theta["mu"]
    elastic = 2.0 * bubble.theta["G"] * (1.0 + bubble.theta["alpha"].abs())

    def rate(_: Tensor, state: Tensor) -> Tensor:
        radius, velocity = state[0], state[1]
        acceleration, pressure = bubble.acceleration(radius, velocity)
        per_tick = time_per_tick(radius, velocity, acceleration, pressure + elastic, stiffness)
        return torch.stack((velocity * per_tick, acceleration * per_tick, per_tick))

    return rate


def _judge(path: Tensor, last: Tensor) -> Tensor:
    """Status of each member after a block of steps; ``path`` is ``n x 3 x B``."""
    radius, end = path[:, 0], path[-1, 2]
    finite = torch.isfinite(path).all(0).all(0) & (radius > 0.0).all(0)
    verdict = torch.where(end >= last, int(Status.DONE), int(Status.TOO_MANY_STEPS))
    verdict = torch.where(radius.amax(0) > _RUNAWAY, int(Status.RUNAWAY), verdict)
    return torch.where(finite, verdict, int(Status.NON_FINITE))


def _read(bubble: PolytropicBubble, history: Tensor, times: Tensor, status: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Radius, velocity and pressure at ``times``; NaN for times that a failed member did not reach in good state."""
    radius, velocity, nodes = history.unbind(1)
    good = torch.isfinite(history).all(1) & (radius > 0.0) & (radius < _RUNAWAY)
    reached = torch.where(good, nodes, 0.0).amax(0)  # last good time of each member
    good = good.cummin(0).values
    radius, velocity = torch.where(good, radius, 1.0), torch.where(good, velocity, 0.0)
    nodes = torch.where(good, nodes, reached).cummax(0).values
    acceleration, _ = bubble.acceleration(radius, velocity)
    at, speed = interpolate(nodes.T.contiguous(), radius.T, velocity.T, acceleration.T, times)
    known = (status == Status.DONE)[:, None] | (times < reached[:, None])
    nan = torch.full_like(times, torch.nan)
    pressure = bubble.bubble_pressure(at.T).T
    return torch.where(known, at, nan), torch.where(known, speed, nan), torch.where(known, pressure, nan)
