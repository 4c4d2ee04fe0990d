"""Bundles of bubbles with heat and vapour transport, integrated one after the other by compiled
code.

Step control and bundles as in the tensor engine (:mod:`~imr_torch.simulate.controller`,
:mod:`~imr_torch.simulate.ode_method`), for one bubble at a time: no masks, no slots. A bundle is a
loop over its members along the leader's steps (:mod:`imr_torch.simulate.compiled.step`).
"""

from functools import partial

import numpy as np

from imr_torch.elementary import kernel
from imr_torch.simulate.compiled.paths import EXHAUSTED
from imr_torch.simulate.controller import GROW, HEAT_WEIGHT, PATIENCE, SAFETY, SHRINK, UNDERFLOW
from imr_torch.simulate.simulator import RUNAWAY, Status

from . import laws
from .output import record
from .step import (
    GAMMA,
    HEAD,
    ORDER,
    STAGES,
    Space,
    Work,
    factorise,
    linearise,
    pace,
    parts_of,
    start,
    step,
)
from .wall import member_of, setup_of

_DONE = int(Status.DONE)
_TOO_MANY = int(Status.TOO_MANY_STEPS)
_NON_FINITE = int(Status.NON_FINITE)
_RUNAWAY = int(Status.RUNAWAY)
_UNDERFLOW = int(Status.STEP_UNDERFLOW)


@kernel
def scaled_error(before, after, error, space, tolerance):
    """As :meth:`imr_torch.simulate.controller.Controller.error`, of one bubble."""
    n, m, (vapours, gels, memory) = len(space.y), len(space.shear), parts_of(space)
    radius = after[0]
    if not radius > 0.0:
        return np.inf
    pressure = 1.0 + np.exp(after[2])
    hottest = 0.0
    heat = 0.0
    vapour = 0.0
    gel = 0.0
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


@partial(kernel, inline="source")
def solve_bundle(
    numbers,
    theta,
    terms,
    effects,
    setup,
    space,
    tolerance,
    max_steps,
    first_step,
    path,
    known,
    times,
    curves,
    work,
):
    """Integrate a leader and its followers, which take its steps in proportion to their time
    scales.

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
        path: ``most x 2``, length and time scale of the leader's steps; receives them, as far as
            there is room, where they are not known.
        known: how many of them are known; the leader is then not integrated. 0 where it is to be.
        times: ``w x n_t``.
        curves: ``3 x w x n_t``, receives radius, velocity and pressure; NaN where a member did not
            get, and of a known leader.
        work: arrays to spare.

    Returns:
        The leader's status, how many nodes its path has up to its own last time, and how many
        steps of it are known now.
    """
    width = len(numbers)
    state = work.state
    fresh = work.fresh
    clock = work.clock
    filled = work.counts[0]
    recorded = work.counts[1]
    last = 0.0
    curves[:] = np.nan
    clock[:] = 0.0
    work.counts[:] = 0
    for k in range(width):
        last = max(last, times[k, -1])
        start(space, member_of(numbers[k], theta[k], terms, effects), setup, state[k])
    h = first_step
    error = 0.0
    grow = True
    count = 1
    own = 1
    tries = 0
    paced = pace(state[0])
    status = -1
    while True:
        behind = False
        for k in range(width):
            behind |= clock[k] < last
        if count > 1 and (
            not behind or (clock[0] >= PATIENCE * last and clock[0] >= last)
        ):  # output takes two nodes
            status = _DONE
        elif known > 0:
            if count > known:
                status = EXHAUSTED
            else:
                h = path[count - 1, 0]
                paced = path[count - 1, 1]
        elif state[0, 0] > RUNAWAY:
            status = _RUNAWAY
        elif h < UNDERFLOW * (1.0 + clock[0]):
            status = _UNDERFLOW if np.isfinite(error) else _NON_FINITE
        elif tries >= max_steps:
            status = _TOO_MANY
        tries += 1
        for k in range(min(known, 1), width):
            member = member_of(numbers[k], theta[k], terms, effects)
            if recorded[k] < count:  # a state at which no step was tried yet
                log_rate = linearise(state[k], clock[k], space, work, member, setup)
                node = (clock[k], state[k, 0], state[k, 1], work.rate[1], state[k, 2], log_rate)
                filled[k] = record(
                    node, work.nodes[k], filled[k], recorded[k] > 0, times[k], curves[:, k]
                )
                recorded[k] = count
            if status != -1:
                continue
            length = h if k == 0 else h * (pace(state[k]) / paced)
            factorise(1.0 / (GAMMA * length), space, work)
            step(state[k], clock[k], length, space, work, member, setup, fresh[k])
            if k == 0:
                error = scaled_error(
                    state[0], fresh[0], work.increments[STAGES - 1], space, tolerance
                )
                if not error <= 1.0:
                    break
        if status != -1:
            break
        accepted = error <= 1.0
        if accepted:
            if known == 0 and count <= len(path):
                path[count - 1, 0] = h
                path[count - 1, 1] = paced
            own += clock[0] < times[0, -1]
            for k in range(width):
                clock[k] += h if k == 0 else h * (pace(state[k]) / paced)
                for i in range(state.shape[1]):
                    state[k, i] = fresh[k, i]
            count += 1
            if known > 0:
                continue
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
    return status, own, count - 1 if count - 1 <= len(path) else 0


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
        shared: what :func:`imr_torch.simulate.compiled.wall.setup_of` takes.
        settings: the entries of :class:`Space`; tolerance, steps at most, and length of the first
            step; the steps of all leaders, and how many of each are known, which is updated.
        times: ``B x n_t``.
        curves: ``3 x B x n_t``, receives radius, velocity and pressure.
        status: of each bundle, receives its status; ``steps`` the nodes of its leader's path.
        steps: see ``status``.
        arrays: of :func:`imr_torch.simulate.compiled.step.work_for`, for the memory states that
            these bundles have.
    """
    grids, tolerance, max_steps, first_step, paths, known = settings
    setup = setup_of(shared)
    space = Space(*grids)
    work = Work(*arrays)
    for bundle in which:
        begin = bundle * width
        end = (bundle + 1) * width
        status[bundle], steps[bundle], known[bundle] = solve_bundle(
            rows[begin:end],
            theta[begin:end],
            terms[bundle],
            effects[bundle],
            setup,
            space,
            tolerance,
            max_steps,
            first_step,
            paths[bundle],
            known[bundle],
            times[begin:end],
            curves[:, begin:end],
            work,
        )
