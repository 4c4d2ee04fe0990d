"""Bundles of bubbles with heat and vapour transport, integrated one after the other by compiled
code.

Step control and bundles as in the tensor engine (:mod:`~imr_torch.simulate.rosenbrock`,
:mod:`~imr_torch.simulate.ode_method`), for one bubble at a time: no masks, no slots. A bundle is a
loop over its members along the leader's steps (:mod:`imr_torch.simulate.compiled.step`).
"""

from functools import partial

import numpy as np

from imr_torch.elementary import kernel
from imr_torch.simulate.rosenbrock import (
    GAMMA,
    GROW,
    HEAT_WEIGHT,
    ORDER,
    PATIENCE,
    SAFETY,
    SHRINK,
    UNDERFLOW,
)
from imr_torch.simulate.simulator import RUNAWAY, Status

from .output import record_node
from .step import (
    HEAD,
    STAGES,
    advance_state,
    factorise_system,
    linearise_state,
    locate_parts,
    time_scale_of,
    write_start,
)
from .wall import member_of, name_sonic

_DONE = int(Status.DONE)
_TOO_MANY = int(Status.TOO_MANY_STEPS)
_NON_FINITE = int(Status.NON_FINITE)
_RUNAWAY = int(Status.RUNAWAY)
_UNDERFLOW = int(Status.STEP_UNDERFLOW)


@kernel
def scaled_error(before, after, error, space, tolerance):
    """As :func:`imr_torch.simulate.rosenbrock.scaled_error`, of one bubble."""
    n, m, (vapours, gels, memory) = len(space.y), len(space.shear), locate_parts(space)
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
def solve_block(which, batch, settings, work):
    """Integrate some bundles of a batch, one by one: a leader and its followers, which take its
    steps in proportion to their time scales.

    Why so: :mod:`imr_torch.simulate.ode_method`.

    Args:
        which: numbers of the bundles.
        batch: the bubbles.
        settings: the grids; relative error of a step, attempted steps after which a bundle is given
            up, and length of the first step.
        work: arrays for the memory states that these bundles have.
    """
    space, tolerance, max_steps, first_step = settings
    width = batch.width
    times = batch.times
    curves = batch.curves
    state = work.state
    fresh = work.fresh
    clock = work.clock
    filled = work.counts[0]
    recorded = work.counts[1]
    for bundle in which:
        leader = bundle * width
        last = 0.0
        clock[:] = 0.0
        work.counts[:] = 0
        for k in range(width):
            i = leader + k
            last = max(last, times[i, -1])
            curves[:, i] = np.nan
            member = member_of(batch, i)
            write_start(space, member, state[k])
        h = first_step
        error = 0.0
        grow = True
        count = 1
        own = 1
        tries = 0
        paced = time_scale_of(state[0])
        ended = -1
        while ended == -1:
            behind = False
            for k in range(width):
                behind |= clock[k] < last
            if count > 1 and (
                not behind or (clock[0] >= PATIENCE * last and clock[0] >= last)
            ):  # output takes two nodes
                ended = _DONE
            elif state[0, 0] > RUNAWAY:
                ended = _RUNAWAY
            elif h < UNDERFLOW * (1.0 + clock[0]):
                ended = _UNDERFLOW if np.isfinite(error) else _NON_FINITE
            elif tries >= max_steps:
                ended = _TOO_MANY
            tries += 1
            for k in range(width):
                i = leader + k
                member = member_of(batch, i)
                if recorded[k] < count:  # a state at which no step was tried yet
                    log_rate = linearise_state(state[k], clock[k], space, work, member)
                    node = (
                        clock[k],
                        state[k, 0],
                        state[k, 1],
                        work.rate[1],
                        state[k, 2],
                        log_rate,
                    )
                    filled[k] = record_node(
                        node,
                        work.nodes[k],
                        filled[k],
                        recorded[k] > 0,
                        times[i],
                        curves[:, i],
                    )
                    recorded[k] = count
                if ended != -1:
                    continue
                length = h if k == 0 else h * (time_scale_of(state[k]) / paced)
                factorise_system(1.0 / (GAMMA * length), space, work)
                advance_state(state[k], clock[k], length, space, work, member, fresh[k])
                if k == 0:
                    change = work.increments[STAGES - 1]
                    error = scaled_error(state[0], fresh[0], change, space, tolerance)
                    if not error <= 1.0:
                        break
            if ended != -1:
                continue
            accepted = error <= 1.0
            if accepted:
                own += clock[0] < times[leader, -1]
                for k in range(width):
                    clock[k] += h if k == 0 else h * (time_scale_of(state[k]) / paced)
                    for i in range(state.shape[1]):
                        state[k, i] = fresh[k, i]
                count += 1
                paced = time_scale_of(state[0])
            factor = SHRINK
            if np.isfinite(error):
                factor = min(max(SAFETY * error ** (-1.0 / ORDER), SHRINK), GROW)
            h *= factor if grow or factor < 1.0 else 1.0
            grow = accepted
        for i in range(leader, leader + width):
            beside = member_of(batch, i).b.constant_vapour
            for j in range(times.shape[1]):
                curves[2, i, j] += beside
        if ended != _DONE:
            ended = name_sonic(ended, state[0, 1], member_of(batch, leader))
        batch.status[bundle] = ended
        batch.steps[bundle] = own
