"""Bundles of bubbles with heat and vapour transport, integrated one after the other by compiled code.

Step control and bundles as in the tensor engine (:mod:`~imr_torch.simulate.controller`,
:mod:`~imr_torch.simulate.ode_method`), for one bubble at a time: no masks, no slots. A bundle is a loop over its members along
the leader's steps (:mod:`imr_torch.simulate.compiled.step`). Functions here are compiled by
:mod:`imr_torch.simulate.compiled.build`.
"""

import numpy as np

from imr_torch.simulate.compiled import laws
from imr_torch.simulate.compiled.output import (
    ACCELERATION,
    PRESSURE,
    PRESSURE_RATE,
    RADIUS,
    TIME,
    VELOCITY,
    fill,
    fill_pressure,
)
from imr_torch.simulate.compiled.step import GAMMA, HEAD, ORDER, STAGES, Space, Work, factorise, linearise, parts_of, step
from imr_torch.simulate.compiled.wall import member_of, setup_of
from imr_torch.simulate.contents import wall_of, warm_profile
from imr_torch.simulate.controller import GROW, HEAT_WEIGHT, PATIENCE, REST, RUNAWAY, SAFETY, SHRINK, UNDERFLOW
from imr_torch.simulate.simulator import Status

_DONE, _TOO_MANY, _NON_FINITE = int(Status.DONE), int(Status.TOO_MANY_STEPS), int(Status.NON_FINITE)
_RUNAWAY, _UNDERFLOW = int(Status.RUNAWAY), int(Status.STEP_UNDERFLOW)


def scaled_error(before, after, error, space, tolerance):
    """As :meth:`imr_torch.simulate.controller.Controller.error`, of one bubble."""
    n, m, (vapours, gels, memory) = len(space.y), len(space.shear), parts_of(space)
    radius = after[0]
    if not radius > 0.0:
        return np.inf
    pressure = 1.0 + np.exp(after[2])
    hottest, heat, vapour, gel = 0.0, 0.0, 0.0, 0.0
    for i in range(HEAD, HEAD + n):
        hottest = max(hottest, max(abs(before[i]), abs(after[i])))
        heat += error[i] * error[i]
    for i in range(vapours, vapours + n):
        vapour += error[i] * error[i]
    for i in range(gels, gels + m):
        gel += error[i] * error[i]
    total = (error[0] / radius) ** 4
    total += (error[1] / (abs(after[1]) + 0.1 * np.sqrt(pressure))) ** 4
    total += error[2] ** 4
    total += (HEAT_WEIGHT * np.sqrt(heat / n) / (0.1 + hottest)) ** 4
    total += np.sqrt(vapour / n) ** 4
    total += (HEAT_WEIGHT * np.sqrt(gel / m) / (0.01 + abs(after[3]))) ** 4
    for i in range(memory, len(after)):
        total += (error[i] / (abs(after[i]) + 0.1 * pressure)) ** 4
    return np.sqrt(np.sqrt(total)) / tolerance


def start(space, member, setup, state):
    """The state at time zero: the wall at the far temperature, vapour in equilibrium with it."""
    b, n, (vapours, _, memory) = member.b, len(space.y), parts_of(space)
    state[:] = 0.0
    state[0], state[1], state[2] = 1.0, b.velocity, np.log(b.start)
    for i in range(n):
        state[HEAD + i] = warm_profile(space.y[i], b.warmth, setup.c)
    state[vapours : vapours + n] = wall_of(b.start, 1.0, 1.0, 0.0, b, setup.c).vapour
    laws.start(b.rest_radius, member.terms, member.theta, state[memory:])


def record(state, time, log_rate, nodes, begin, second, times, curves, work):
    """Make a state the last node, and fill the output up to it unless it is the first; returns the next time to be filled."""
    before, node = nodes[0], nodes[1]
    for i in range(len(node)):
        before[i] = node[i]
    node[TIME], node[RADIUS], node[VELOCITY] = time, state[0], state[1]
    node[ACCELERATION], node[PRESSURE], node[PRESSURE_RATE] = work.rate[1], state[2], log_rate
    if not second:
        return begin
    end = fill(before, node, begin, times, curves[0], curves[1])
    fill_pressure(before, node, begin, end, times, curves[2])
    return end


def solve_bundle(numbers, theta, terms, effects, setup, space, tolerance, max_steps, first_step, times, curves, work):
    """Integrate a leader and its followers, which take its steps in proportion to their time scales.

    Why so: :mod:`imr_torch.simulate.ode_method`.

    Args:
        numbers: ``w x N``, the bubbles' numbers, the leader first.
        theta: ``w x p``, dimensionless parameters.
        terms: which stress terms act in the bundle; ``effects`` likewise.
        effects: see ``terms``.
        setup: what the batch shares.
        space: the grids.
        tolerance: relative error of a step.
        max_steps: attempted steps after which the bundle is given up.
        first_step: length of the first step.
        times: ``w x n_t``.
        curves: ``3 x w x n_t``, receives radius, velocity and pressure; NaN where a member did not get.
        work: arrays to spare.

    Returns:
        The leader's status, and how many nodes its path has.
    """
    width = len(numbers)
    state, fresh, clock, nodes = work.state, work.fresh, work.clock, work.nodes
    filled, recorded, last = work.counts[0], work.counts[1], 0.0
    curves[:] = np.nan
    clock[:] = 0.0
    work.counts[:] = 0
    for k in range(width):
        last = max(last, times[k, -1])
        start(space, member_of(numbers[k], theta[k], terms, effects), setup, state[k])
    h, error, grow, count, tries, paced, status = first_step, 0.0, True, 1, 0, pace(state[0]), -1
    while True:
        behind = False
        for k in range(width):
            behind |= clock[k] < last
        if count > 1 and (not behind or (clock[0] >= PATIENCE * last and clock[0] >= last)):  # output takes two nodes
            status = _DONE
        elif state[0, 0] > RUNAWAY:
            status = _RUNAWAY
        elif h < UNDERFLOW * (1.0 + clock[0]):
            status = _UNDERFLOW if np.isfinite(error) else _NON_FINITE
        elif tries >= max_steps:
            status = _TOO_MANY
        tries += 1
        for k in range(width):
            member = member_of(numbers[k], theta[k], terms, effects)
            if recorded[k] < count:  # a state at which no step was tried yet
                log_rate = linearise(state[k], clock[k], space, work, member, setup)
                filled[k] = record(
                    state[k], clock[k], log_rate, nodes[k], filled[k], recorded[k] > 0, times[k], curves[:, k], work
                )
                recorded[k] = count
            if status >= 0:
                continue
            length = h if k == 0 else h * (pace(state[k]) / paced)
            factorise(1.0 / (GAMMA * length), space, work)
            step(state[k], clock[k], length, space, work, member, setup, fresh[k])
            if k == 0:
                error = scaled_error(state[0], fresh[0], work.increments[STAGES - 1], space, tolerance)
                if not error <= 1.0:
                    break
        if status >= 0:
            break
        accepted = error <= 1.0
        if accepted:
            for k in range(width):
                clock[k] += h if k == 0 else h * (pace(state[k]) / paced)
                for i in range(state.shape[1]):
                    state[k, i] = fresh[k, i]
            count += 1
            paced = pace(state[0])
        factor = SHRINK
        if np.isfinite(error):
            factor = min(max(SAFETY * error ** (-1.0 / ORDER), SHRINK), GROW)
        h *= factor if grow or factor < 1.0 else 1.0
        grow = accepted
    for k in range(width):
        beside = laws.numbers(numbers[k]).constant_vapour
        for j in range(times.shape[1]):
            curves[2, k, j] += beside
    return status, count


def pace(state):
    """A bubble's own time scale (as in :mod:`imr_torch.simulate.clock`)."""
    return state[0] / np.sqrt(REST + np.exp(state[2]) + state[1] * state[1])


def solve_block(which, width, rows, theta, terms, effects, shared, settings, times, curves, status, steps, arrays):
    """Integrate some bundles of a batch, one by one.

    Args:
        which: numbers of the bundles.
        width: members of a bundle.
        rows: ``B x N``, the bubbles' numbers, bundle after bundle.
        theta: ``B x p``.
        terms: a row a bundle: which stress terms act; ``effects`` likewise.
        effects: see ``terms``.
        shared: what :func:`imr_torch.simulate.compiled.wall.setup_of` takes.
        settings: the entries of :class:`Space`; tolerance, steps at most, and length of the first step.
        times: ``B x n_t``.
        curves: ``3 x B x n_t``, receives radius, velocity and pressure.
        status: of each bundle, receives its status; ``steps`` the nodes of its path.
        steps: see ``status``.
        arrays: of :func:`work_for`, for the memory states that these bundles have.
    """
    grids, tolerance, max_steps, first_step = settings
    setup, space, work = setup_of(shared), Space(*grids), Work(*arrays)
    for bundle in which:
        begin, end = bundle * width, (bundle + 1) * width
        status[bundle], steps[bundle] = solve_bundle(
            rows[begin:end],
            theta[begin:end],
            terms[bundle],
            effects[bundle],
            setup,
            space,
            tolerance,
            max_steps,
            first_step,
            times[begin:end],
            curves[:, begin:end],
            work,
        )
