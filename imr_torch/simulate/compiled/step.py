"""One step of a bubble with heat and vapour transport: its right-hand side, derivatives, factors
and stages; compiled.

The same equations and method as the tensor engine (:mod:`~imr_torch.simulate.rhs`,
:mod:`~imr_torch.simulate.linearise`, :mod:`~imr_torch.simulate.rosenbrock`), in loops over the
nodes of one bubble.

Linear systems have three dense blocks, bordered by the numbers that couple them: temperature in the
bubble (``tau``), vapour (``C``, driven by ``tau``) and temperature in the gel (``theta``) see each
other only through (R, U, ln P, q, tau_w), with ``q = d ln P/dt`` as an extra unknown; memory of the
gel sees ``R`` and ``U`` only and joins the border.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from imr_torch.elementary import kernel
from imr_torch.simulate.compiled.algebra import (
    WIDTH,
    apply_columns,
    invert_matrix,
    load_eight,
    make_rows,
    multiply_columns,
    multiply_rows,
    padded_size,
    spread_number,
    store_eight,
)
from imr_torch.simulate.contents import (
    GelNode,
    Node,
    Point,
    conductivity_of,
    gel_rate,
    gel_slopes,
    mixture_of,
    node_rates,
    node_slopes,
    pressure_rate,
    pressure_rate_slopes,
    temperature_of,
    wall_balance,
    wall_balance_slopes,
    wall_of,
    warm_profile,
)
from imr_torch.simulate.rosenbrock import COUPLING, MOMENTS, REST, TIME_INCREMENTS
from imr_torch.simulate.rosenbrock import STAGES as ROWS

from .wall import gas_loss, motion_slopes, move_wall, vapour_factor

HEAD = 8  # where the fields begin in a state: after R, U, ln P, tau_w and zeros
BORDER = 5  # R, U, ln P, q, tau_w, and then memory
STAGES = len(MOMENTS)


def _lower(rows: tuple[tuple[float, ...], ...]) -> np.ndarray:
    """Rows of growing length as a square array."""
    return np.array([[*row, *[0.0] * (STAGES - len(row))] for row in ((), *rows)])


_ARGUMENT = _lower(ROWS)
_COUPLING = _lower(COUPLING)
_TIME_INCREMENTS = np.array(TIME_INCREMENTS)
_MOMENTS = np.array(MOMENTS)


class Space(NamedTuple):
    """The grids, laid out for loops over contiguous rows, which end with zeros: ``n'`` is ``n``
    padded to a multiple of eight.

    Args:
        inside: ``(n+1) x (2n'+8)``: column ``j`` of the operators ``d/dy`` and Laplacian at the
            inner nodes, and of ``d/dy`` at the wall, as a row; the wall's column first.
        outside: ``(m+1) x (2m'+8)``, likewise.
        first: ``n x n'``, column ``j`` of ``d/dy`` at the inner nodes from the inner nodes, as a
            row; ``laplacian`` likewise.
        rows: ``n x n'``, ``d/dy`` at the inner nodes from the inner nodes.
        outer_first: ``m x m'``; ``outer_laplacian`` likewise.
        y: ``n`` nodes.
        stretching: ``m``, ``1/y^2 - y``.
        shear: ``m``, ``1/y^6``.
    """

    inside: np.ndarray
    outside: np.ndarray
    first: np.ndarray
    laplacian: np.ndarray
    rows: np.ndarray
    outer_first: np.ndarray
    outer_laplacian: np.ndarray
    y: np.ndarray
    stretching: np.ndarray
    shear: np.ndarray


@kernel
def locate_parts(space):
    """Where ``C``, ``theta`` and the memory begin in a state; ``tau`` begins at ``HEAD``."""
    n = space.first.shape[1]
    m = space.outer_first.shape[1]
    return HEAD + n, HEAD + 2 * n, HEAD + 2 * n + m


class Work(NamedTuple):
    """Arrays for bundles of ``w`` bubbles with ``K`` memory states; most are written anew at every
    step.

    A state of length ``nx`` is (R, U, ln P, tau_w), and then ``tau``, ``C``, ``theta`` and memory;
    each part ends with zeros so that all begin at multiples of eight. ``n'`` is ``n`` padded to a
    multiple of eight, and ``fields`` is ``2n' + m'``.

    Args:
        state: ``w x nx``; ``fresh`` likewise, the states after a step.
        clock: ``w``, the bubbles' times.
        nodes: ``w x 2 x 6``, the last two nodes of each path, see
            :mod:`imr_torch.simulate.compiled.output`.
        counts: ``2 x w``: times filled in, and nodes recorded.
        inner: ``2 x (2n'+8)``: slopes and Laplacians of ``tau`` and ``C``, and slopes at the wall;
            ``outer`` likewise of ``theta``.
        profile: ``3 x n``: conductivity, temperature and ``R_mix`` at the inner nodes.
        heat: ``n x (n+2)'``, the block of ``tau`` by columns, then its inverse, with two columns
            beside it; ``vapour`` and ``gel`` likewise with one: see :func:`factorise_system`.
        edges: ``5 x fields``: derivatives of the fields' rates in (R, U, ln P, q, tau_w); that of
            ``theta`` in ``q`` stays 0.
        factors: ``9 x max(n', m')``: factors of value, slope and Laplacian in the rates of ``tau``,
            ``C`` and ``theta`` at each node; that of the value of ``theta`` stays 0.
        coupling: ``2 x n'``: how ``C_t`` hangs on the value and on the slope of ``tau``.
        functionals: ``2 x fields``: what the fields add to the rows of ``q`` and of the wall.
        border: ``(5+K) x (5+K)'``, the system that is left by columns, then its inverse.
        increments: ``6 x nx``.
        argument: ``nx``; ``right`` likewise.
        rate: ``nx``, ``f(x)`` at the beginning of the step.
        slopes: see :func:`imr_torch.simulate.compiled.wall.motion_slopes`; ``memory_slopes`` and
            ``moved`` likewise.
        wall_rows: ``2 x 8``: derivatives of ``d ln P/dt`` and of the wall's balance in (R, U, ln P,
            q, tau_w) and in the slopes of ``tau``, ``C`` and ``theta`` at the wall.
        drive: ``fields`` numbers to spare; ``small``: ``2 x max(n', (5+K)')``.
    """

    state: np.ndarray
    fresh: np.ndarray
    clock: np.ndarray
    nodes: np.ndarray
    counts: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    profile: np.ndarray
    heat: np.ndarray
    vapour: np.ndarray
    gel: np.ndarray
    edges: np.ndarray
    factors: np.ndarray
    coupling: np.ndarray
    functionals: np.ndarray
    border: np.ndarray
    increments: np.ndarray
    argument: np.ndarray
    right: np.ndarray
    rate: np.ndarray
    slopes: np.ndarray
    memory_slopes: np.ndarray
    moved: np.ndarray
    wall_rows: np.ndarray
    drive: np.ndarray
    small: np.ndarray


def work_for(nodes: int, outer_nodes: int, states: int, width: int) -> Work:
    """Arrays for grids of so many nodes, memory states and members of a bundle."""
    n = padded_size(nodes)
    m = padded_size(outer_nodes)
    border = BORDER + states
    fields = 2 * n + m
    size = HEAD + fields + padded_size(states)
    return Work(
        state=make_rows(width, size),
        fresh=make_rows(width, size),
        clock=np.zeros(width),
        nodes=np.zeros((width, 2, 6)),
        counts=np.zeros((2, width), np.int64),
        inner=make_rows(2, 2 * n + 1),
        outer=make_rows(1, 2 * m + 1),
        profile=make_rows(3, n),
        heat=make_rows(nodes, nodes + 2),
        vapour=make_rows(nodes, nodes + 1),
        gel=make_rows(outer_nodes, outer_nodes + 1),
        edges=make_rows(BORDER, fields),
        factors=make_rows(9, max(n, m)),
        coupling=make_rows(2, n),
        functionals=make_rows(2, fields),
        border=make_rows(border, border),
        increments=make_rows(STAGES, size),
        argument=make_rows(size),
        right=make_rows(size),
        rate=make_rows(size),
        slopes=make_rows(border),
        memory_slopes=make_rows(2 + states, states),
        moved=np.zeros((2, states), np.complex128),
        wall_rows=make_rows(2, 8),
        drive=make_rows(fields),
        small=make_rows(2, max(n, border)),
    )


@kernel
def point_at(state, space, work, member):
    """Temperatures, slopes and the pressure's rate at a state, into ``work``.

    Returns the point, and the relative loss of gas with its derivatives in ``R`` and ``U``.
    """
    b = member.b
    c = member.setup.c
    n = len(space.y)
    radius = state[0]
    velocity = state[1]
    pressure = np.exp(state[2])
    conductivity = conductivity_of(state[3], c)
    factor, trapped = vapour_factor(pressure / b.start, member)
    wall = wall_of(pressure, conductivity, factor, trapped, b, c)
    vapours, gel, _ = locate_parts(space)
    apply_columns(space.inside, state[3], state[HEAD:], work.inner[0])
    apply_columns(space.inside, wall.vapour, state[vapours:], work.inner[1])
    apply_columns(space.outside, wall.temperature - 1.0, state[gel:], work.outer[0])
    for i in range(n):
        conductive = conductivity_of(state[HEAD + i], c)
        work.profile[0, i] = conductive
        work.profile[1, i] = temperature_of(conductive, c)
        work.profile[2, i] = mixture_of(state[vapours + i], c)
    loss = gas_loss(radius, velocity, member)
    at_wall = 2 * space.first.shape[1]
    heat = work.inner[0, at_wall]
    vapour = work.inner[1, at_wall]
    rate = pressure_rate(radius, velocity, pressure, wall, heat, vapour, loss[0], b, c)
    outer_slope = work.outer[0, 2 * space.outer_first.shape[1]]
    return Point(radius, velocity, pressure, rate, wall, heat, vapour, outer_slope), loss


@kernel
def node_at(i, space, work):
    """What :func:`point_at` left of an inner node."""
    bends = space.first.shape[1]
    heat = work.inner[0]
    vapour = work.inner[1]
    profile = work.profile
    return Node(
        space.y[i],
        profile[0, i],
        profile[1, i],
        profile[2, i],
        heat[i],
        heat[bends + i],
        vapour[i],
        vapour[bends + i],
    )


@kernel
def rates_at(point, acceleration, space, work, member, out):
    """``f(x)`` without the rates of memory."""
    b = member.b
    c = member.setup.c
    n = len(space.y)
    m = len(space.shear)
    vapours, gel, _ = locate_parts(space)
    out[0], out[1], out[2] = point.velocity, acceleration, point.rate / point.pressure
    out[3] = wall_balance(point, b, c)
    for i in range(n):
        node = node_at(i, space, work)
        out[HEAD + i], out[vapours + i] = node_rates(node, point, b, c)
    for i in range(m):
        out[gel + i] = gel_rate(gel_node_at(i, space, work), point, b)


@kernel
def gel_node_at(i, space, work):
    """What :func:`point_at` left of an outer node."""
    slopes = work.outer[0]
    bends = space.outer_first.shape[1]
    return GelNode(space.stretching[i], space.shear[i], slopes[i], slopes[bends + i])


@kernel
def field_slopes(point, space, work, member):
    """The derivatives of the fields' rates at each node, into ``work``: factors of the operators,
    and the border.
    """
    b = member.b
    c = member.setup.c
    n = len(space.y)
    m = len(space.shear)
    wall = point.wall
    pressure = point.pressure
    factors = work.factors
    bends = space.first.shape[1]
    outer_bends = space.outer_first.shape[1]
    by_heat = work.edges
    by_vapour = work.edges[:, bends:]
    by_gel = work.edges[:, 2 * bends :]
    log_rate = point.rate / pressure
    for i in range(n):
        node = node_at(i, space, work)
        s = node_slopes(node, point, b, c)
        for k in range(6):
            factors[k, i] = s[k]
        heat_wall = (
            s.heat_second * space.inside[0, bends + i] + s.heat_first * space.inside[0, i]
        )
        vapour_wall = (
            s.vapour_second * space.inside[0, bends + i]
            + s.vapour_first * space.inside[0, i]
        )
        by_pressure = s.vapour_pressure + vapour_wall * wall.vapour_pressure
        by_heat[0, i], by_vapour[0, i] = s.heat_radius, s.vapour_radius
        by_heat[1, i], by_vapour[1, i] = s.heat_velocity, s.vapour_velocity
        by_heat[2, i] = pressure * (s.heat_pressure + log_rate * s.heat_rate)
        by_vapour[2, i] = pressure * (by_pressure + log_rate * s.vapour_rate)
        by_heat[3, i], by_vapour[3, i] = pressure * s.heat_rate, pressure * s.vapour_rate
        by_heat[4, i] = heat_wall
        by_vapour[4, i] = (
            vapour_wall * wall.vapour_heat + s.coupling_slope * space.inside[0, i]
        )
        work.coupling[0, i], work.coupling[1, i] = s.coupling, s.coupling_slope
    for i in range(m):
        g = gel_slopes(gel_node_at(i, space, work), point, b, c)
        factors[7, i], factors[8, i] = g.first, g.second
        through = (
            g.second * space.outside[0, outer_bends + i] + g.first * space.outside[0, i]
        ) / wall.conductivity
        by_gel[0, i], by_gel[1, i], by_gel[2, i] = (
            g.radius,
            g.velocity,
            pressure * g.pressure,
        )
        by_gel[4, i] = g.wall + through


@kernel
def shift_operators(factors, first, laplacian, shift, out):
    """``out = shift - J`` of one field by columns, from the factors of value, slope and Laplacian
    at each node.
    """
    by_value = factors[0]
    by_slope = factors[1]
    by_bend = factors[2]
    for j in range(len(out)):
        column = out[j]
        slope = first[j]
        bend = laplacian[j]
        for i in range(0, first.shape[1], WIDTH):
            change = load_eight(by_bend, i) * load_eight(bend, i) + load_eight(
                by_slope, i
            ) * load_eight(slope, i)
            store_eight(column, i, spread_number(0.0) - change)
        column[j] += shift - by_value[j]


@partial(kernel, inline="source")
def linearise_state(state, time, space, work, member):
    """``f(x)`` at a state (``work.rate``) and all its derivatives, into ``work``.

    Returns ``d ln P/dt``.
    """
    b = member.b
    c = member.setup.c
    memory = locate_parts(space)[2]
    states = work.moved.shape[1]
    point, loss = point_at(state, space, work, member)
    pressure = point.pressure
    log_rate = point.rate / pressure
    memory_rates = work.rate[memory : memory + states]
    acceleration = motion_slopes(
        time,
        point,
        state[memory : memory + states],
        member,
        work.slopes,
        work.memory_slopes,
        work.moved,
        memory_rates,
    )
    rates_at(point, acceleration, space, work, member, work.rate)
    field_slopes(point, space, work, member)
    s = work.slopes
    corner = space.inside[0, 2 * space.first.shape[1]]
    outer_corner = space.outside[0, 2 * space.outer_first.shape[1]]
    s[2], s[3] = pressure * (s[2] + log_rate * s[3]), pressure * s[3]
    q = pressure_rate_slopes(point, corner, loss, b, c)
    w = wall_balance_slopes(point, corner, outer_corner, b, c)
    write_balance(q, pressure, log_rate, pressure, work.wall_rows[0])
    work.wall_rows[0, 2] -= log_rate
    write_balance(w, pressure, log_rate, 1.0, work.wall_rows[1])
    return log_rate


@kernel
def write_balance(slopes, pressure, log_rate, divisor, row):
    """Derivatives in (R, U, ln P, q, ...) over a divisor from those in (R, U, P, dP/dt, ...)."""
    for k in range(len(slopes)):
        row[k] = slopes[k] / divisor
    row[2] = pressure * (slopes.pressure + log_rate * slopes.rate) / divisor
    row[3] = pressure * slopes.rate / divisor


@partial(kernel, inline="source")
def factorise_system(shift, space, work):
    """Invert ``shift - J``: the blocks of the fields, what they add to the rows of the wall, and
    what is left beside them.

    What the fields add is ``w (shift - J)^-1`` with the slopes at the wall ``w``: columns beside
    the blocks (which stand by columns, as their transposes) that Gauss-Jordan carries along.
    """
    factors = work.factors
    coupling = work.coupling
    heat = work.heat
    vapour = work.vapour
    gel = work.gel
    n = space.first.shape[1]
    m = space.outer_first.shape[1]
    inner = len(space.y)
    outer = len(space.shear)
    shift_operators(factors[0:3], space.first, space.laplacian, shift, heat)
    shift_operators(factors[3:6], space.first, space.laplacian, shift, vapour)
    shift_operators(factors[6:9], space.outer_first, space.outer_laplacian, shift, gel)
    for j in range(inner):
        vapour[j, inner] = space.inside[1 + j, 2 * n]
    invert_matrix(vapour)
    through = work.small[0]
    slope = work.small[1, :n]
    for j in range(inner):  # the slope of C at the wall hangs on tau through C_t
        through[j] = vapour[j, inner] * coupling[1, j]
    multiply_columns(space.rows, through, slope)
    for j in range(inner):
        heat[j, inner] = space.inside[1 + j, 2 * n]
        heat[j, inner + 1] = slope[j] + vapour[j, inner] * coupling[0, j]
    invert_matrix(heat)
    for j in range(outer):
        gel[j, outer] = space.outside[1 + j, 2 * m]
    invert_matrix(gel)
    for k in range(2):
        row = work.wall_rows[k]
        line = work.functionals[k]
        for j in range(inner):
            line[j] = row[5] * heat[j, inner] + row[6] * heat[j, inner + 1]
            line[n + j] = row[6] * vapour[j, inner]
        for j in range(outer):
            line[2 * n + j] = row[7] * gel[j, outer]
    for j in range(inner):  # so that only zeros are beside the inverses
        heat[j, inner], heat[j, inner + 1], vapour[j, inner] = 0.0, 0.0, 0.0
    for j in range(outer):
        gel[j, outer] = 0.0
    _fill_border(shift, work)
    invert_matrix(work.border)


@kernel
def _fill_border(shift, work):
    """The system in (R, U, ln P, q, tau_w, memory) that is left when the fields are eliminated, by
    columns.
    """
    columns = work.border
    s = work.slopes
    states = len(columns) - BORDER
    columns[:] = 0.0
    columns[0, 0], columns[1, 0] = shift, -1.0
    columns[0, 1], columns[1, 1], columns[2, 1], columns[3, 1] = (
        -s[0],
        shift - s[1],
        -s[2],
        -s[3],
    )
    columns[2, 2], columns[3, 2] = shift, -1.0
    for k in range(BORDER):
        for row in range(2):
            through_fields = multiply_rows(work.functionals[row], work.edges[k])
            columns[k, 3 + row] = -through_fields - work.wall_rows[row, k]
    columns[3, 3] += 1.0
    for k in range(states):
        columns[BORDER + k, 1] = -s[5 + k]
        columns[0, BORDER + k], columns[1, BORDER + k] = (
            -work.memory_slopes[0, k],
            -work.memory_slopes[1, k],
        )
        for j in range(states):
            columns[BORDER + j, BORDER + k] = -work.memory_slopes[2 + j, k]
        columns[BORDER + k, BORDER + k] += shift


@kernel
def solve_system(right, space, work, out):
    """``out = (shift - J)^-1 right`` in the layout of the state."""
    vapours, gels, memory = locate_parts(space)
    n = vapours - HEAD
    states = len(work.border) - BORDER
    coupling = work.coupling
    drive = work.drive
    inputs = work.small[1]
    z = work.small[0, : work.border.shape[1]]
    inputs[0], inputs[1], inputs[2] = right[0], right[1], right[2]
    for k in range(2):
        inputs[3 + k] = multiply_rows(work.functionals[k], right[HEAD:])
    inputs[4] += right[3]
    for k in range(states):
        inputs[BORDER + k] = right[memory + k]
    multiply_columns(work.border, inputs, z)
    out[0], out[1], out[2], out[3] = z[0], z[1], z[2], z[4]
    for k in range(states):
        out[memory + k] = z[BORDER + k]
    for i in range(0, len(drive), WIDTH):
        change = spread_number(z[0]) * load_eight(work.edges[0], i)
        for k in range(1, BORDER):
            change = change + spread_number(z[k]) * load_eight(work.edges[k], i)
        store_eight(drive, i, load_eight(right, HEAD + i) + change)
    warm = out[HEAD:vapours]
    slope = work.small[0, :n]
    multiply_columns(work.heat, drive, warm)
    multiply_columns(space.first, warm, slope)
    for i in range(0, n, WIDTH):
        change = load_eight(coupling[1], i) * load_eight(slope, i) + load_eight(
            coupling[0], i
        ) * load_eight(warm, i)
        store_eight(drive, n + i, load_eight(drive, n + i) + change)
    multiply_columns(work.vapour, drive[n:], out[vapours:gels])
    multiply_columns(work.gel, drive[2 * n :], out[gels:memory])


@kernel
def add_increments(weights, count, scale, increments, out):
    """``out += scale sum_k weights[k] increments[k]`` over the first increments."""
    for i in range(0, len(out), WIDTH):
        sums = load_eight(out, i)
        for k in range(count):
            sums = sums + spread_number(weights[k] * scale) * load_eight(increments[k], i)
        store_eight(out, i, sums)


@partial(kernel, inline="source")
def advance_state(state, time, h, space, work, member, out):
    """One step of Rodas4P from a state whose rates and factors are in ``work``; ``out`` receives
    the new state.

    The last increment, the estimate of the error, is left in ``work.increments``.
    """
    memory = locate_parts(space)[2]
    size = len(state)
    states = work.moved.shape[1]
    increments = work.increments
    argument = work.argument
    right = work.right
    for stage in range(STAGES):
        if stage == 0:
            for i in range(size):
                right[i] = work.rate[i]
        else:
            for i in range(size):
                argument[i] = state[i]
            add_increments(_ARGUMENT[stage], stage, 1.0, increments, argument)
            there, _ = point_at(argument, space, work, member)
            force = move_wall(
                time + _MOMENTS[stage] * h,
                there.radius,
                there.velocity,
                there.pressure + member.b.constant_vapour,
                there.rate,
                argument[memory : memory + states],
                right[memory : memory + states],
                member,
            )
            rates_at(there, force, space, work, member, right)
            balance = right[3]
            add_increments(_COUPLING[stage], stage, 1.0 / h, increments, right)
            right[3] = balance  # tau_w is algebraic
        right[1] += work.slopes[4] * h * _TIME_INCREMENTS[stage]
        solve_system(right, space, work, increments[stage])
    for i in range(size):
        out[i] = argument[i] + increments[STAGES - 1, i]


@kernel
def write_start(space, member, state):
    """The state at time zero: the wall at the far temperature, vapour in equilibrium with it."""
    b, n, (vapours, _, memory) = member.b, len(space.y), locate_parts(space)
    state[:] = 0.0
    state[0], state[1], state[2] = 1.0, b.velocity, np.log(b.start)
    for i in range(n):
        state[HEAD + i] = warm_profile(space.y[i], b.warmth, member.setup.c)
    state[vapours : vapours + n] = wall_of(b.start, 1.0, 1.0, 0.0, b, member.setup.c).vapour
    for k in range(min(len(member.memory), len(state) - memory)):
        state[memory + k] = member.memory[k]


@kernel
def time_scale_of(state):
    """A bubble's own time scale (as in :mod:`imr_torch.simulate.clock`)."""
    return state[0] / np.sqrt(REST + np.exp(state[2]) + state[1] * state[1])
