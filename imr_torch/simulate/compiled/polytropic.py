"""One bubble of polytropic gas, and a bundle of them, integrated by compiled code.

The same method as the tensor engine (:mod:`imr_torch.simulate.polytropic`): Kutta's 3/8 rule with
fixed steps of a stretched time (:mod:`imr_torch.simulate.clock`), tried again with half the step
where a leader fails. Functions here are compiled by :mod:`imr_torch.simulate.compiled.build`.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from imr_torch.elementary import kernel
from imr_torch.simulate.clock import time_per_tick
from imr_torch.simulate.conditions import compression_of
from imr_torch.simulate.simulator import RUNAWAY, Status

from . import laws
from .output import VELOCITY, fill_curves, push_node
from .wall import gas_loss, member_of, move_wall, name_sonic, vapour_factor

_DONE = int(Status.DONE)
_TOO_MANY = int(Status.TOO_MANY_STEPS)
_NON_FINITE = int(Status.NON_FINITE)
_RUNAWAY = int(Status.RUNAWAY)
# the 3/8 rule: rows weigh the earlier rates in the argument of the next stage
_STAGES = np.array([[1.0 / 3.0, 0.0, 0.0], [-1.0 / 3.0, 1.0, 0.0], [1.0, -1.0, 1.0]])
HEAD = 3  # R, U, t, then memory, then gas left (the tensor engine has the gas before the memory)


class Work(NamedTuple):
    """Arrays for one bubble: its state, that of a stage, the rates of four stages, and the last two
    nodes of its path.
    """

    state: np.ndarray
    stage: np.ndarray
    rates: np.ndarray
    nodes: np.ndarray


def work_for(states: int, width: int) -> Work:
    """Arrays for so many memory states, in bundles of any width."""
    size = HEAD + states + 1
    return Work(np.zeros(size), np.zeros(size), np.zeros((4, size)), np.zeros((2, 6)))


@kernel
def contents_at(radius, velocity, left, member):
    """Pressure inside, its rate, and the relative rate at which gas is lost."""
    b = member.b
    compression = compression_of(radius, b.exponent)
    factor, trapped = vapour_factor(compression, member)
    lost = gas_loss(radius, velocity, member)[0]
    pressure, rate = laws.gas(
        radius,
        velocity,
        left,
        lost,
        compression,
        factor,
        trapped,
        b.gas,
        b.exponent,
        b.vapour,
    )
    return pressure, rate, lost


@kernel
def rates_at(state, fading, member, out):
    """Derivatives of the state in stretched time; returns ``U'``."""
    radius = state[0]
    velocity = state[1]
    last = len(state) - 1
    pressure, rate, lost = contents_at(radius, velocity, state[last], member)
    force = move_wall(
        state[2],
        radius,
        velocity,
        pressure,
        rate,
        state[HEAD:last],
        out[HEAD:last],
        member,
    )
    tick = time_per_tick(radius, velocity, force, pressure, fading, member.b)
    out[0], out[1], out[2] = tick * velocity, tick * force, tick
    for k in range(HEAD, last):
        out[k] *= tick
    out[last] = -tick * lost * state[last]
    return force


@partial(kernel, inline="source")
def integrate_bubble(batch, i, h, share, max_steps, work):
    """Integrate one bubble to its last time; returns status and steps taken.

    Args:
        batch: the bubbles.
        i: number of the bubble.
        h: length of a step of stretched time.
        share: weight of the gel's memory in the time scale.
        max_steps: steps after which it is given up.
        work: arrays to spare.
    """
    member = member_of(batch, i)
    times = batch.times[i]
    curves = batch.curves[:, i]
    fading = batch.fading[i] * share
    state = work.state
    stage = work.stage
    rates = work.rates
    nodes = work.nodes
    size = len(state)
    gas = size - 1
    state[0], state[1], state[2], state[gas] = 1.0, member.b.velocity, 0.0, 1.0
    for k in range(HEAD, gas):
        state[k] = member.memory[k - HEAD]
    curves[:] = np.nan
    filled = 0
    step = 0
    gas_before = 1.0
    while True:
        force = rates_at(state, fading, member, rates[0])
        finite = np.isfinite(force) and state[0] > 0.0
        for value in state:
            finite = finite and np.isfinite(value)
        if not finite:
            speed = state[1] if np.isfinite(state[1]) else nodes[1, VELOCITY]
            return name_sonic(_NON_FINITE, speed, member), step
        if state[0] > RUNAWAY:
            return name_sonic(_RUNAWAY, state[1], member), step
        push_node((state[2], state[0], state[1], force), nodes)
        if step > 0:
            begin = filled
            filled = fill_curves(nodes, filled, times, curves)
            for j in range(begin, filled):
                left = gas_before + curves[2, j] * (state[gas] - gas_before)
                curves[2, j] = contents_at(curves[0, j], curves[1, j], left, member)[0]
            gas_before = state[gas]
        if state[2] >= times[-1] and step > 0:  # output takes two nodes
            return _DONE, step
        if step >= max_steps:
            return name_sonic(_TOO_MANY, state[1], member), step
        for number in range(1, 4):
            for k in range(size):
                change = 0.0
                for earlier in range(number):
                    change += _STAGES[number - 1, earlier] * rates[earlier, k]
                stage[k] = state[k] + h * change
            rates_at(stage, fading, member, rates[number])
        for k in range(size):
            change = rates[0, k] + 3.0 * (rates[1, k] + rates[2, k]) + rates[3, k]
            state[k] += change * h * 0.125
        step += 1


@partial(kernel, inline="source")
def solve_block(which, batch, settings, work):
    """Integrate some bundles of a batch, one by one.

    Args:
        which: numbers of the bundles.
        batch: the bubbles.
        settings: for each attempt, the length of a step of stretched time and the weight of the
            gel's memory; and steps at most.
        work: arrays for the memory states that these bundles have.
    """
    attempts, max_steps = settings
    for bundle in which:
        chosen = 0
        member = bundle * batch.width
        while member < (bundle + 1) * batch.width:
            leads = member == bundle * batch.width
            # a follower may need a little longer
            limit = max_steps if leads else 2 * max_steps
            step = attempts[chosen, 0]
            share = attempts[chosen, 1]
            outcome, taken = integrate_bubble(batch, member, step, share, limit, work)
            if leads:
                batch.status[bundle] = outcome
                batch.steps[bundle] = taken
                if outcome != _DONE and outcome != _TOO_MANY and chosen + 1 < len(attempts):
                    chosen += 1
                    continue
            member += 1
