"""The polytropic simulator: a radial equation with a gas spring, a whole batch at once.

The batch is integrated by ``torchdiffeq`` (fixed-step RK4) under the time transformation of
:mod:`imr_torch.simulate.clock`, in blocks of steps; members that have reached their last time leave
after each block. Members that fail are tried again with half the step before they are given up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torchdiffeq import odeint

from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.clock import (
    bracket_times,
    ends_of,
    hermite_quintic,
    memory_share,
    time_per_tick,
)
from imr_torch.simulate.conditions import Stepping, compression_of
from imr_torch.simulate.engines import EngineSimulator
from imr_torch.simulate.simulator import RUNAWAY, Simulator, Status
from imr_torch.simulate.wall import Head, gas_loss, move_wall, name_sonic, vapour_factor


@dataclass(frozen=True)
class PolytropicSimulator(EngineSimulator):
    """A :class:`~imr_torch.simulate.Simulator` with polytropic gas and constant vapour pressure.

    Args:
        conditions: surroundings and gas.
        stepping: how finely time is cut.
        terms: stress terms to choose from; all registered ones by default.
        engine: ``"compiled"`` or ``"torchdiffeq"``, see :mod:`imr_torch.simulate.engines`; the
            answers agree to rounding.
        threads: processor threads of the compiled engine, all cores by default; the answer is the
            same bit for bit.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.material import PARAMETERS
    >>> gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})
    >>> design, times = torch.tensor([400.0, 0.22]), torch.linspace(0.0, 1.5, 4)  # (We, R_inf*), t*
    >>> [round(x, 3) for x in PolytropicSimulator()(gel, design, times).radius.tolist()]
    [1.0, 0.846, 0.418, 0.647]
    """

    stepping: Stepping = field(default_factory=Stepping)

    physics = "polytropic"
    members = 2000  # larger batches leave the cache of a processor
    member_bytes = 75_000

    def _solve(
        self, parameters: Tensor, designs: Tensor, times: Tensor, width: int = 1
    ) -> tuple[Tensor, ...]:
        """One block of members, bundle after bundle.

        Those whose leader failed are tried again at half the step.
        """
        bubbles = Bubbles.of(parameters, designs, self.conditions, self.terms)
        stepping = self.stepping
        if self._can_compile(bubbles):
            from imr_torch.simulate.compiled.run import solve_polytropic

            return solve_polytropic(bubbles, times, width, stepping, self.threads)
        results = _integrate_batch(bubbles, times, stepping, width)
        for _ in range(stepping.retries):
            status = results[3]
            failed = (status != Status.DONE) & (status != Status.TOO_MANY_STEPS)
            failed = torch.nonzero(failed)[:, 0]
            if not len(failed):
                break
            stepping = replace(stepping, step=0.5 * stepping.step)
            again = _integrate_batch(bubbles.take(failed), times[failed], stepping, width)
            results = [
                old.index_copy(0, failed, new)
                for old, new in zip(results, again, strict=True)
            ]
        return tuple(results)


def fewer_steps(simulator: Simulator, most: int = 600) -> Simulator:
    """A polytropic simulator that gives a bubble up after ``most`` steps, if its own limit is higher;
    any other as it is.

    A relaxation time of .3 us takes 480 steps, most gels 200. Explicit steps become very short
    where the relaxation time of a gel is short, and good fits do not end there.

    >>> from imr_torch.simulate import PolytropicSimulator, fewer_steps
    >>> fewer_steps(PolytropicSimulator()).stepping.max_steps
    600
    """
    if not isinstance(simulator, PolytropicSimulator):
        return simulator
    stepping = simulator.stepping
    return replace(
        simulator, stepping=replace(stepping, max_steps=min(stepping.max_steps, most))
    )


def _integrate_batch(
    bubbles: Bubbles, times: Tensor, stepping: Stepping, width: int = 1, block: int = 32
) -> Sequence[Tensor]:
    """Integrate until every member is past its last time; which are is looked at after each block of
    steps.

    Radius, velocity, pressure, status (of the leaders), steps.
    """
    count = times.shape[0]
    last = times[:, -1]
    state = start_of(bubbles)
    history = [state[None]]
    status = torch.full((count,), int(Status.TOO_MANY_STEPS), device=times.device)
    steps = torch.zeros_like(status)
    fastest = torch.zeros_like(last)
    # a follower may need a little longer
    limits = torch.full_like(steps, 2 * stepping.max_steps)
    limits[::width] = stepping.max_steps
    active = torch.arange(count, device=times.device)
    ticks = stepping.step * torch.arange(block + 1, dtype=times.dtype, device=times.device)
    while len(active):
        moving = bubbles if active.numel() == count else bubbles.take(active)
        path = odeint(
            _field_of(moving, stepping.step), state[:, active], ticks, method="rk4"
        )
        assert isinstance(path, Tensor)  # a tuple only for tuple states
        history.append(state.expand(block, *state.shape).index_copy(2, active, path[1:]))
        state = history[-1][-1]
        steps[active] += block
        status[active] = _judge_members(path, last[active])
        fastest[active] = path[:, 1].nan_to_num(-torch.inf).amax(0)
        active = torch.nonzero((status == Status.TOO_MANY_STEPS) & (steps < limits))[:, 0]
    curves = _read_curves(bubbles, torch.cat(history), times, status)
    of_leaders = name_sonic(bubbles, status, fastest)[::width].repeat_interleave(width)
    return *curves, of_leaders, steps


def start_of(bubbles: Bubbles) -> Float[Tensor, "rows *#members"]:
    """The state (R, U, t, gas left, memory) at time zero, ``(4 + K) x B``."""
    velocity = bubbles.numbers.velocity
    one = torch.ones_like(velocity)
    return torch.cat((torch.stack((one, velocity, 0.0 * one, one)), bubbles.memory_start()))


def head_of(bubbles: Bubbles, state: Float[Tensor, "rows *#members"]) -> Head:
    """What acts on the wall at a state as in :func:`start_of`: a polytropic gas; shapes broadcast
    with ``B``.
    """
    numbers = bubbles.numbers
    radius, velocity, time, left = state[:4]
    compression = compression_of(radius, numbers.exponent)
    factor, trapped = vapour_factor(bubbles, compression)
    lost = gas_loss(bubbles, radius, velocity)
    law = type(bubbles.conditions.gas).law
    contents = (numbers.gas, numbers.exponent, numbers.vapour)
    pressure, rate = law(
        radius, velocity, left, lost, compression, factor, trapped, *contents
    )
    return Head(time, radius, velocity, pressure, rate, state[4:])


def rate_of(
    bubbles: Bubbles, head: Head, state: Float[Tensor, "rows *#members"]
) -> Float[Tensor, "rows *#members"]:
    """Time derivative of a state as in :func:`start_of`."""
    force, memory_rate = move_wall(bubbles, head)
    leaving = -state[3] * gas_loss(bubbles, head.radius, head.velocity)
    rows = torch.stack((head.velocity, force, torch.ones_like(force), leaving))
    return torch.cat((rows, memory_rate))


def _field_of(bubbles: Bubbles, step: float):
    """Right-hand side in stretched time, cut into steps of one length."""
    fading = bubbles.fastest_relaxation() * memory_share(step)

    def rate(_: Tensor, state: Tensor) -> Tensor:
        head = head_of(bubbles, state)
        rates = rate_of(bubbles, head, state)
        return rates * time_per_tick(
            head.radius, head.velocity, rates[1], head.pressure, fading, bubbles.numbers
        )

    return rate


def _judge_members(path: Tensor, last: Tensor) -> Tensor:
    """Status of each member after a block of steps; ``path`` is ``n x (4 + K) x B``."""
    radius = path[:, 0]
    end = path[-1, 2]
    finite = torch.isfinite(path).all(0).all(0) & (radius > 0.0).all(0)
    verdict = torch.where(end >= last, int(Status.DONE), int(Status.TOO_MANY_STEPS))
    verdict = torch.where(radius.amax(0) > RUNAWAY, int(Status.RUNAWAY), verdict)
    return torch.where(finite, verdict, int(Status.NON_FINITE))


def _read_curves(
    bubbles: Bubbles, history: Tensor, times: Tensor, status: Tensor
) -> tuple[Tensor, ...]:
    """Radius, velocity and pressure at ``times``.

    NaN for times that a failed member did not reach in good state.
    """
    radius = history[:, 0]
    good = torch.isfinite(history).all(1) & (radius > 0.0) & (radius < RUNAWAY)
    good = good.cummin(0).values
    reached = torch.where(good, history[:, 2], 0.0).amax(0)  # last good time of each member
    nodes = torch.where(good, history[:, 2], reached).cummax(0).values.T.contiguous()
    states = history.movedim(1, 0)
    force = move_wall(bubbles, head_of(bubbles, states))[0]
    end, step, share = bracket_times(nodes, times)
    knots = [ends_of(row.T, end) for row in (*states, force)]
    at, speed = hermite_quintic(share, step, knots[0], knots[1], knots[-1])
    rest = [torch.lerp(*ends, share).T for ends in knots[3:-1]]
    pressure = head_of(bubbles, torch.stack((at.T, speed.T, times.T, *rest))).pressure.T
    known = (status == Status.DONE)[:, None] | (times < reached[:, None])
    return tuple(torch.where(known, curve, torch.nan) for curve in (at, speed, pressure))
