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
from imr_torch.simulate.gas import compression_of
from imr_torch.simulate.simulator import RUNAWAY, Status

from . import laws
from .output import ACCELERATION, RADIUS, TIME, VELOCITY, fill
from .wall import Setup, gas_loss, member_of, motion, vapour_factor

_DONE = int(Status.DONE)
_TOO_MANY = int(Status.TOO_MANY_STEPS)
_NON_FINITE = int(Status.NON_FINITE)
_RUNAWAY = int(Status.RUNAWAY)
# the 3/8 rule: rows weigh the earlier rates in the argument of the next stage
_STAGES = np.array([[1.0 / 3.0, 0.0, 0.0], [-1.0 / 3.0, 1.0, 0.0], [1.0, -1.0, 1.0]])
_HEAD = 3  # R, U, t, then memory, then gas left


class Work(NamedTuple):
    """Arrays for one bubble: its state, that of a stage, the rates of four stages, and the last two
    nodes of its path.
    """

    state: np.ndarray
    stage: np.ndarray
    rates: np.ndarray
    nodes: np.ndarray


def work_for(states: int, width: int) -> tuple[np.ndarray, ...]:
    """The entries of :class:`Work` for so many memory states, in bundles of any width."""
    size = _HEAD + states + 1
    return tuple(Work(np.zeros(size), np.zeros(size), np.zeros((4, size)), np.zeros((2, 6))))


@kernel
def contents(radius, velocity, left, member, setup):
    """Pressure inside, its rate, and the relative rate at which gas is lost."""
    b = member.b
    compression = compression_of(radius, b.exponent)
    factor, trapped = vapour_factor(compression, member)
    lost = gas_loss(radius, velocity, member)[0]
    pressure, rate = laws.gas(
        setup.gas,
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
        setup.liquid,
    )
    return pressure, rate, lost


@kernel
def rates_at(state, fading, member, setup, out):
    """Derivatives of the state in stretched time; returns ``U'``."""
    radius = state[0]
    velocity = state[1]
    last = len(state) - 1
    pressure, rate, lost = contents(radius, velocity, state[last], member, setup)
    force = motion(
        state[2],
        radius,
        velocity,
        pressure,
        rate,
        state[_HEAD:last],
        out[_HEAD:last],
        member,
        setup,
    )
    tick = time_per_tick(radius, velocity, force, pressure, fading, member.b)
    out[0], out[1], out[2] = tick * velocity, tick * force, tick
    for k in range(_HEAD, last):
        out[k] *= tick
    out[last] = -tick * lost * state[last]
    return force


@partial(kernel, inline="source")
def march(numbers, theta, terms, effects, setup, h, share, max_steps, last, times, curves, work):
    """Integrate one bubble to its last time; returns status and steps taken.

    Args:
        numbers: ``N``.
        theta: ``p``.
        terms: which stress terms act; ``effects`` likewise.
        effects: see ``terms``.
        setup: what the batch shares.
        h: length of a step of stretched time.
        share: weight of the gel's memory in the time scale.
        max_steps: steps after which it is given up.
        last: time to reach.
        times: ``n_t``.
        curves: ``3 x n_t``, receives radius, velocity and pressure; NaN where it did not get.
        work: arrays to spare.
    """
    member = member_of(numbers, theta, terms, effects)
    fading = laws.fastest(terms, theta) * share
    state = work.state
    stage = work.stage
    rates = work.rates
    nodes = work.nodes
    size = len(state)
    gas = size - 1
    state[0], state[1], state[2], state[gas] = 1.0, member.b.velocity, 0.0, 1.0
    laws.start(member.b.rest_radius, terms, theta, state[_HEAD:gas])
    curves[:] = np.nan
    filled = 0
    step = 0
    gas_before = 1.0
    while True:
        force = rates_at(state, fading, member, setup, rates[0])
        finite = np.isfinite(force) and state[0] > 0.0
        for i in range(size):
            finite = finite and np.isfinite(state[i])
        if not finite:
            return _NON_FINITE, step
        if state[0] > RUNAWAY:
            return _RUNAWAY, step
        node = nodes[1]
        for i in range(len(node)):
            nodes[0, i] = node[i]
        node[TIME], node[RADIUS], node[VELOCITY], node[ACCELERATION] = (
            state[2],
            state[0],
            state[1],
            force,
        )
        if step > 0:
            begin = filled
            filled = fill(nodes[0], node, filled, times, curves[0], curves[1])
            for j in range(begin, filled):
                share_after = (times[j] - nodes[0, TIME]) / max(node[TIME] - nodes[0, TIME], 1e-300)
                left = gas_before + share_after * (state[gas] - gas_before)
                curves[2, j] = contents(curves[0, j], curves[1, j], left, member, setup)[0]
            gas_before = state[gas]
        if state[2] >= last and step > 0:  # output takes two nodes
            return _DONE, step
        if step >= max_steps:
            return _TOO_MANY, step
        for number in range(1, 4):
            for i in range(size):
                change = 0.0
                for earlier in range(number):
                    change += _STAGES[number - 1, earlier] * rates[earlier, i]
                stage[i] = state[i] + h * change
            rates_at(stage, fading, member, setup, rates[number])
        for i in range(size):
            change = rates[0, i] + 3.0 * (rates[1, i] + rates[2, i]) + rates[3, i]
            state[i] += change * h * 0.125
        step += 1


@partial(kernel, inline="source")
def solve_block(
    which,
    width,
    rows,
    theta,
    terms,
    effects,
    shared,
    settings,
    times,
    curves,
    status,
    steps,
    arrays,
):
    """Integrate some bundles of a batch, one by one.

    Args:
        which: numbers of the bundles.
        width: members of a bundle.
        rows: ``B x N``, the bubbles' numbers, bundle after bundle.
        theta: ``B x p``.
        terms: a row a bundle: which stress terms act; ``effects`` likewise.
        effects: see ``terms``.
        shared: the entries of :class:`imr_torch.simulate.compiled.wall.Setup`.
        settings: for each attempt, the length of a step of stretched time and the weight of the
            gel's memory; and steps at most.
        times: ``B x n_t``.
        curves: ``3 x B x n_t``, receives radius, velocity and pressure.
        status: of each bundle's leader; ``steps`` likewise.
        steps: see ``status``.
        arrays: of :func:`work_for`, for the memory states that these bundles have.
    """
    attempts, max_steps = settings
    setup = Setup(*shared)
    work = Work(*arrays)
    for bundle in which:
        chosen = 0
        member = bundle * width
        while member < (bundle + 1) * width:
            leads = member == bundle * width
            outcome, taken = march(
                rows[member],
                theta[member],
                terms[bundle],
                effects[bundle],
                setup,
                attempts[chosen, 0],
                attempts[chosen, 1],
                max_steps if leads else 2 * max_steps,  # a follower may need a little longer
                times[member, -1],
                times[member],
                curves[:, member],
                work,
            )
            if leads:
                status[bundle] = outcome
                steps[bundle] = taken
                if outcome != _DONE and outcome != _TOO_MANY and chosen + 1 < len(attempts):
                    chosen += 1
                    continue
            member += 1
