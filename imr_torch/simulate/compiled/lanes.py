"""What stands in the place of some functions where one step is taken for eight bubbles at once;
compiled.

The source of a step (:mod:`imr_torch.simulate.compiled.step`) and of its algebra is compiled twice.
For one bubble, rows are taken eight neighbours at a time. For eight bubbles, each number is an
:class:`~imr_torch.simulate.compiled.vectors.Eight` with one bubble's in each place, and rows are
taken one entry at a time. The balance of the wall, with the laws of gels, effects and liquids, is
computed for one of the eight after the other by the same code as for one bubble. Operations on a
bubble's numbers and their order are the same both ways, and so are the results, bit for bit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from imr_torch.simulate.bubbles import Numbers
from imr_torch.simulate.compiled import laws, step, wall
from imr_torch.simulate.compiled.vectors import lane, spread, with_lane
from imr_torch.simulate.compiled.wall import Member

LANES = 8
gas_loss_of_one = wall.gas_loss
motion_of_one = wall.motion
motion_slopes_of_one = wall.motion_slopes
vapour_factor_of_one = wall.vapour_factor


@dataclass(frozen=True)
class ForEight:
    """A function of the engine that is compiled for eight bubbles at once."""

    function: Callable[..., Any]


linearise_eight: Any = ForEight(step.linearise)
factorise_eight: Any = ForEight(step.factorise)
step_eight: Any = ForEight(step.step)


class Spare(NamedTuple):
    """Arrays for one member of eight.

    Args:
        state: a state.
        memory: ``2 x K``: memory and its rates.
        slopes: ``5 + K``, see :func:`imr_torch.simulate.compiled.wall.motion_slopes`;
            ``memory_slopes`` likewise.
        memory_slopes: ``(2 + K) x K``.
    """

    state: np.ndarray
    memory: np.ndarray
    slopes: np.ndarray
    memory_slopes: np.ndarray


class Eightfold(NamedTuple):
    """Eight members of a bundle.

    Args:
        b: their numbers.
        numbers: ``w x N``, the numbers of the whole bundle; ``theta`` likewise.
        theta: ``w x p``, dimensionless parameters.
        first: which member is the first of the eight; where the bundle ends, the last one fills the
            places that are left.
        terms: which stress terms act; ``effects`` likewise.
        effects: see ``terms``.
        driven: whether the far field changes.
        loses: whether they lose gas.
        traps: whether an effect changes the saturation pressure.
        spare: arrays for what is computed for one of them at a time.
    """

    b: Numbers
    numbers: np.ndarray
    theta: np.ndarray
    first: int
    terms: np.ndarray
    effects: np.ndarray
    driven: bool
    loses: bool
    traps: bool
    spare: Spare


def load(row, first):
    """An entry."""
    return row[first]


def store(row, first, value):
    """Write an entry."""
    row[first] = value


def same(value):
    """A value as it is."""
    return value


def dot(one, other, space, spare):
    """Inner product of rows of all fields, in the order of sums of
    :func:`imr_torch.simulate.compiled.algebra.dot`.
    """
    n = len(space.y)
    m = len(space.shear)
    for j in range(8):
        sums = spread(0.0)
        for begin, end in ((0, n), (n, 2 * n), (2 * n, 2 * n + m)):
            for i in range(begin + j, end, 8):
                sums = sums + one[i] * other[i]
        spare[j] = sums
    left = (spare[0] + spare[4]) + (spare[2] + spare[6])
    right = (spare[1] + spare[5]) + (spare[3] + spare[7])
    return left + right


def single(member, k):
    """One of the eight."""
    place = min(member.first + k, len(member.numbers) - 1)
    b = laws.numbers(member.numbers[place])
    return Member(
        b,
        member.theta[place],
        member.terms,
        member.effects,
        member.driven,
        member.loses,
        member.traps,
    )


def write_lane(row, k, values):
    """Give one of the eight its values."""
    for i in range(len(values)):
        row[i] = with_lane(row[i], k, values[i])


def motion(time, radius, velocity, pressure, rate, memory, memory_rates, member, setup):
    """As :func:`imr_torch.simulate.compiled.wall.motion`."""
    states = len(memory)
    out = radius
    for k in range(LANES):
        for j in range(states):
            member.spare.memory[0, j] = lane(memory[j], k)
        force = motion_of_one(
            lane(time, k),
            lane(radius, k),
            lane(velocity, k),
            lane(pressure, k),
            lane(rate, k),
            member.spare.memory[0],
            member.spare.memory[1],
            single(member, k),
            setup,
        )
        out = with_lane(out, k, force)
        for j in range(states):
            memory_rates[j] = with_lane(memory_rates[j], k, member.spare.memory[1, j])
    return out


def motion_slopes(
    time,
    radius,
    velocity,
    pressure,
    rate,
    memory,
    member,
    setup,
    slopes,
    memory_slopes,
    moved,
    spare,
):
    """As :func:`imr_torch.simulate.compiled.wall.motion_slopes`."""
    states = len(memory)
    out = radius
    for k in range(LANES):
        for j in range(states):
            member.spare.memory[0, j] = lane(memory[j], k)
        force = motion_slopes_of_one(
            lane(time, k),
            lane(radius, k),
            lane(velocity, k),
            lane(pressure, k),
            lane(rate, k),
            member.spare.memory[0],
            single(member, k),
            setup,
            member.spare.slopes,
            member.spare.memory_slopes,
            moved,
            member.spare.memory[1],
        )
        out = with_lane(out, k, force)
        for j in range(5 + states):
            slopes[j] = with_lane(slopes[j], k, member.spare.slopes[j])
        for j in range(states):
            spare[j] = with_lane(spare[j], k, member.spare.memory[1, j])
            for i in range(2 + states):
                memory_slopes[i, j] = with_lane(
                    memory_slopes[i, j], k, member.spare.memory_slopes[i, j]
                )
    return out


def gas_loss(radius, velocity, member):
    """As :func:`imr_torch.simulate.compiled.wall.gas_loss`."""
    lost = spread(0.0)
    by_radius = spread(0.0)
    by_velocity = spread(0.0)
    if member.loses:
        for k in range(LANES):
            values = gas_loss_of_one(lane(radius, k), lane(velocity, k), single(member, k))
            lost = with_lane(lost, k, values[0])
            by_radius = with_lane(by_radius, k, values[1])
            by_velocity = with_lane(by_velocity, k, values[2])
    return lost, by_radius, by_velocity


def vapour_factor(compression, member):
    """As :func:`imr_torch.simulate.compiled.wall.vapour_factor`."""
    factor = spread(1.0)
    trapped = spread(0.0)
    if member.traps:
        for k in range(LANES):
            values = vapour_factor_of_one(lane(compression, k), single(member, k))
            factor = with_lane(factor, k, values[0])
            trapped = with_lane(trapped, k, values[1])
    return factor, trapped


STAND_INS: dict[str, Any] = {
    "STRIDE": 1,
    "load": load,
    "store": store,
    "spread": same,
    "dot": dot,
    "motion": motion,
    "motion_slopes": motion_slopes,
    "gas_loss": gas_loss,
    "vapour_factor": vapour_factor,
}
"""What takes the place of globals of that name in functions that are compiled for eight bubbles."""
