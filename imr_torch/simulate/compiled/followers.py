"""Followers of a bundle, eight at a time along the leader's steps; compiled.

All eight take a step together (:mod:`imr_torch.simulate.compiled.lanes`), which costs as much as
some four steps of one bubble: where fewer followers are left than ``LEAST``, the caller takes them
one by one. What a follower gives is the same either way, bit for bit, and depends on no other
follower. Functions here are compiled by :mod:`imr_torch.simulate.compiled.build`.
"""

from typing import Any, NamedTuple

import numpy as np

from imr_torch.simulate.bubbles import Numbers
from imr_torch.simulate.compiled import laws
from imr_torch.simulate.compiled.lanes import (
    LANES,
    Eightfold,
    ForEight,
    Spare,
    factorise_eight,
    linearise_eight,
    single,
    step_eight,
    write_lane,
)
from imr_torch.simulate.compiled.output import record
from imr_torch.simulate.compiled.step import GAMMA, Space, Work, pace, start, work_for
from imr_torch.simulate.compiled.vectors import lane, lanes, members_of, spread, with_lane

LEAST = 5
pace_eight: Any = ForEight(pace)


class Followers(NamedTuple):
    """What followers that are integrated eight at a time need.

    Args:
        space: the grids, with rows that are not padded.
        work: arrays as for as many members as there are eights, with eight numbers in each place.
        numbers: ``eights x N``, the members' numbers, eight in each place.
        spare: arrays for one member.
    """

    space: Space
    work: Work
    numbers: np.ndarray
    spare: Spare


def arrays_for(nodes: int, outer_nodes: int, states: int, width: int) -> tuple[Any, ...]:
    """What :func:`followers_of` takes beside the grids.

    As small as may be where all members are taken one by one.
    """
    eights = -(-(width - alone(width)) // LANES)
    if not eights:
        nodes = 1
        outer_nodes = 1
    work = work_for(nodes, outer_nodes, states, eights, eightfold=True)
    size = work[0].shape[1]
    spare = Spare(
        np.zeros(size), np.zeros((2, states)), np.zeros(5 + states), np.zeros((2 + states, states))
    )
    return work, (lanes(eights, len(Numbers._fields)),), tuple(spare)


def followers_of(grids, arrays):
    """The :class:`Followers` from plain arrays."""
    work, numbers, spare = arrays
    return Followers(Space(*grids), Work(*members_of(work)), members_of(numbers)[0], Spare(*spare))


def alone(width):
    """How many members at the beginning of a bundle are integrated one by one: the leader, and few
    followers.
    """
    rest = (width - 1) % LANES
    return 1 + rest if rest < LEAST else 1


def eightfold(which, numbers, theta, terms, effects, followers):
    """The members of one eight.

    Arguments as :func:`imr_torch.simulate.compiled.transport.solve_bundle`.
    """
    loses = laws.loses(effects)
    traps = laws.traps(effects)
    driven = laws.drives(effects)
    first = alone(len(numbers)) + LANES * which
    own = laws.numbers(followers.numbers[which])
    return Eightfold(
        own, numbers, theta, first, terms, effects, driven, loses, traps, followers.spare
    )


def start_followers(numbers, theta, terms, effects, setup, followers):
    """The numbers of all eights, and their states at time zero."""
    last = len(numbers) - 1
    for which in range(len(followers.numbers)):
        row = followers.numbers[which]
        state = followers.work.state[which]
        for k in range(LANES):
            write_lane(row, k, numbers[min(alone(len(numbers)) + LANES * which + k, last)])
        members = eightfold(which, numbers, theta, terms, effects, followers)
        for k in range(LANES):
            start(followers.space, single(members, k), setup, members.spare.state)
            write_lane(state, k, members.spare.state)


def follow(which, members, ended, h, paced, followers, setup, clock, nodes, counts, times, curves):
    """Record the states of one eight, and take the leader's step ``h`` from them unless the leader
    has ``ended``.

    ``paced`` is the leader's time scale; other arguments as in
    :mod:`imr_torch.simulate.compiled.transport`.
    """
    space = followers.space
    work = followers.work
    first = members.first
    state = work.state[which]
    time = spread(0.0)
    last = len(clock) - 1
    for k in range(LANES):
        time = with_lane(time, k, clock[min(first + k, last)])
    log_rate = linearise_eight(state, time, space, work, members, setup)
    for k in range(min(LANES, len(clock) - first)):
        i, (radius, velocity, log_pressure) = (
            first + k,
            (lane(state[0], k), lane(state[1], k), lane(state[2], k)),
        )
        node = (clock[i], radius, velocity, lane(work.rate[1], k), log_pressure, lane(log_rate, k))
        counts[0, i] = record(
            node, nodes[i], counts[0, i], counts[1, i] > 0, times[i], curves[:, i]
        )
        counts[1, i] += 1
    if not ended:
        length = h * (pace_eight(state) / paced)
        factorise_eight(1.0 / (GAMMA * length), space, work)
        step_eight(state, time, length, space, work, members, setup, work.fresh[which])


def accept(h, paced, clock, followers):
    """Make the states after the step those of all eights."""
    work = followers.work
    width = len(clock)
    for which in range(len(followers.numbers)):
        length = h * (pace_eight(work.state[which]) / paced)
        first = alone(width) + LANES * which
        for k in range(min(LANES, width - first)):
            clock[first + k] += lane(length, k)
        for i in range(work.state.shape[1]):
            work.state[which, i] = work.fresh[which, i]
