"""One step of a bubble with heat and vapour transport: its right-hand side, derivatives, factors and stages; compiled.

The same equations and method as the tensor engine (:mod:`~imr_torch.simulate.rhs`, :mod:`~imr_torch.simulate.linearise`,
:mod:`~imr_torch.simulate.bordered`, :mod:`~imr_torch.simulate.rosenbrock`), in loops over the nodes of one bubble. Functions
here are compiled by :mod:`imr_torch.simulate.compiled.build`.
"""

from typing import NamedTuple

import numpy as np

from imr_torch.simulate.compiled.algebra import apply, dot, invert, multiply
from imr_torch.simulate.compiled.wall import gas_loss, motion, motion_slopes, vapour_factor
from imr_torch.simulate.contents import (
    Node,
    Wall,
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
)
from imr_torch.simulate.rosenbrock import RODAS4P

HEAD = 4
_BORDER = 5
STAGES = len(RODAS4P.stages) + 1
GAMMA = RODAS4P.gamma
ORDER = RODAS4P.order


def _lower(rows: tuple[tuple[float, ...], ...]) -> np.ndarray:
    """Rows of growing length as a square array."""
    return np.array([[*row, *[0.0] * (STAGES - len(row))] for row in ((), *rows)])


_ARGUMENT, _COUPLING = _lower(RODAS4P.stages), _lower(RODAS4P.coupling)
_TIME_INCREMENTS, _MOMENTS = (np.array(x) for x in RODAS4P.ticks)


class Space(NamedTuple):
    """The grids, laid out for loops over contiguous rows.

    Args:
        inside: ``(n+1) x (2n+1)``: column ``j`` of the operators ``d/dy`` (wall first) and Laplacian, as a row.
        outside: ``(m+1) x (2m+1)``, likewise.
        first: ``n x n``, column ``j`` of ``d/dy`` at the inner nodes from the inner nodes, as a row; ``laplacian`` likewise.
        rows: ``n x n``, ``d/dy`` at the inner nodes from the inner nodes.
        outer_first: ``m x m``; ``outer_laplacian`` likewise.
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


class Work(NamedTuple):
    """Arrays for bundles of ``w`` bubbles with ``K`` memory states; most are written anew at every step.

    Args:
        state: ``w x nx``; ``fresh`` likewise, the states after a step.
        clock: ``w``, the bubbles' times.
        nodes: ``w x 2 x 6``, the last two nodes of each path, see :mod:`imr_torch.simulate.compiled.output`.
        counts: ``2 x w``: times filled in, and nodes recorded.
        inner: ``2 x (2n+1)``: slopes (wall first) and Laplacians of ``tau`` and ``C``; ``outer`` likewise of ``theta``.
        profile: ``3 x n``: conductivity, temperature and ``R_mix`` at the inner nodes.
        heat: ``n x (n+2)``, the block of ``tau`` by columns, then its inverse; ``vapour`` and ``gel`` likewise with one column
            more: see :func:`factorise`.
        inner_border: ``2 x 5 x n``: derivatives of ``tau_t`` and ``C_t`` in (R, U, ln P, q, tau_w); ``outer_border``: ``5 x
            m``.
        factors: ``9 x max(n, m)``: factors of slope, Laplacian and value in the rates of ``tau``, ``C`` and ``theta`` at each
            node.
        coupling: ``2 x n``: how ``C_t`` hangs on the value and on the slope of ``tau``.
        functionals: ``2 x (2n+m)``: what the fields add to the rows of ``q`` and of the wall.
        border: ``(5+K) x (5+K)``, the system that is left, then its inverse.
        increments: ``6 x nx``.
        argument: ``nx``; ``right`` likewise.
        rate: ``nx``, ``f(x)`` at the beginning of the step.
        slopes: see :func:`imr_torch.simulate.compiled.wall.motion_slopes`; ``memory_slopes`` and ``moved`` likewise.
        wall_rows: ``2 x 8``: derivatives of ``d ln P/dt`` and of the wall's balance in (R, U, ln P, q, tau_w) and in the slopes
            of ``tau``, ``C`` and ``theta`` at the wall.
        small: numbers to spare, ``3 x max(n, m, 5+K)``; ``pivots``: ``2 x`` as many.
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
    inner_border: np.ndarray
    outer_border: np.ndarray
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
    small: np.ndarray
    pivots: np.ndarray


def work_for(n: int, m: int, states: int, width: int) -> tuple[np.ndarray, ...]:
    """The entries of :class:`Work` for grids of ``n`` and ``m`` nodes, so many memory states and members of a bundle."""
    size, border = HEAD + 2 * n + m + states, _BORDER + states
    longest = max(n, m, border)
    work = Work(
        state=np.zeros((width, size)),
        fresh=np.zeros((width, size)),
        clock=np.zeros(width),
        nodes=np.zeros((width, 2, 6)),
        counts=np.zeros((2, width), np.int64),
        inner=np.zeros((2, 2 * n + 1)),
        outer=np.zeros((1, 2 * m + 1)),
        profile=np.zeros((3, n)),
        heat=np.zeros((n, n + 2)),
        vapour=np.zeros((n, n + 1)),
        gel=np.zeros((m, m + 1)),
        inner_border=np.zeros((2, _BORDER, n)),
        outer_border=np.zeros((_BORDER, m)),
        factors=np.zeros((9, max(n, m))),
        coupling=np.zeros((2, n)),
        functionals=np.zeros((2, 2 * n + m)),
        border=np.zeros((border, border)),
        increments=np.zeros((STAGES, size)),
        argument=np.zeros(size),
        right=np.zeros(size),
        rate=np.zeros(size),
        slopes=np.zeros(_BORDER + states),
        memory_slopes=np.zeros((2 + states, states)),
        moved=np.zeros((2, states), np.complex128),
        wall_rows=np.zeros((2, 8)),
        small=np.zeros((3, longest)),
        pivots=np.zeros((2, longest + 2)),
    )
    return tuple(work)


class Point(NamedTuple):
    """What holds at one state: of the wall, pressure of the mixture, its rate, and slopes of ``tau`` and ``C`` at the wall."""

    wall: Wall
    radius: float
    velocity: float
    pressure: float
    rate: float
    heat: float
    vapour: float
    loss: tuple


def point_at(state, space, work, member, setup):
    """Temperatures, slopes and the pressure's rate at a state, into ``work``; returns the :class:`Point`."""
    b, c, n = member.b, setup.c, len(space.y)
    m = len(space.shear)
    radius, velocity, pressure = state[0], state[1], np.exp(state[2])
    conductivity = conductivity_of(state[3], c)
    factor, trapped = vapour_factor(pressure / b.start, member)
    wall = wall_of(pressure, conductivity, factor, trapped, b, c)
    apply(space.inside, state[HEAD : HEAD + n], state[3], work.inner[0])
    apply(space.inside, state[HEAD + n : HEAD + 2 * n], wall.vapour, work.inner[1])
    apply(space.outside, state[HEAD + 2 * n : HEAD + 2 * n + m], wall.temperature - 1.0, work.outer[0])
    for i in range(n):
        conductive = conductivity_of(state[HEAD + i], c)
        work.profile[0, i] = conductive
        work.profile[1, i] = temperature_of(conductive, c)
        work.profile[2, i] = mixture_of(state[HEAD + n + i], c)
    loss = gas_loss(radius, velocity, member)
    heat, vapour = work.inner[0, 0], work.inner[1, 0]
    rate = pressure_rate(radius, velocity, pressure, wall, heat, vapour, loss[0], b, c)
    return Point(wall, radius, velocity, pressure, rate, heat, vapour, loss)


def node_at(i, space, work):
    """What :func:`point_at` left of an inner node."""
    n, heat, vapour, profile = len(space.y), work.inner[0], work.inner[1], work.profile
    return Node(
        space.y[i],
        profile[0, i],
        profile[1, i],
        profile[2, i],
        heat[1 + i],
        heat[1 + n + i],
        vapour[1 + i],
        vapour[1 + n + i],
    )


def rates_at(point, acceleration, space, work, member, setup, out):
    """``f(x)`` without the rates of memory."""
    b, c, n, m = member.b, setup.c, len(space.y), len(space.shear)
    radius, velocity, pressure, rate = point.radius, point.velocity, point.pressure, point.rate
    out[0], out[1], out[2] = velocity, acceleration, rate / pressure
    out[3] = wall_balance(point.wall, point.heat, point.vapour, work.outer[0, 0], b, c)
    for i in range(n):
        node = node_at(i, space, work)
        warmer, wetter = node_rates(node, radius, velocity, pressure, rate, b, c)
        out[HEAD + i], out[HEAD + n + i] = warmer, wetter
    outer = work.outer[0]
    for i in range(m):
        out[HEAD + 2 * n + i] = gel_rate(
            space.stretching[i], space.shear[i], outer[1 + i], outer[1 + m + i], radius, velocity, point.wall, b
        )


def field_slopes(point, space, work, member, setup):
    """The derivatives of the fields' rates at each node, into ``work``: factors of the operators, and the border."""
    b, c, n, m, wall = member.b, setup.c, len(space.y), len(space.shear), point.wall
    radius, velocity, pressure, rate = point.radius, point.velocity, point.pressure, point.rate
    border, factors = work.inner_border, work.factors
    log_rate = rate / pressure
    for i in range(n):
        node = node_at(i, space, work)
        s = node_slopes(node, radius, velocity, pressure, rate, b, c)
        factors[0, i], factors[1, i], factors[2, i] = s.heat_first, s.heat_second, s.heat_self
        factors[3, i], factors[4, i], factors[5, i] = s.vapour_first, s.vapour_second, s.vapour_self
        heat_wall = s.heat_second * space.inside[0, 1 + n + i] + s.heat_first * space.inside[0, 1 + i]
        vapour_wall = s.vapour_second * space.inside[0, 1 + n + i] + s.vapour_first * space.inside[0, 1 + i]
        by_pressure = s.vapour_pressure + vapour_wall * wall.vapour_pressure
        border[0, 0, i], border[1, 0, i] = s.heat_radius, s.vapour_radius
        border[0, 1, i], border[1, 1, i] = s.heat_velocity, s.vapour_velocity
        border[0, 2, i] = pressure * (s.heat_pressure + log_rate * s.heat_rate)
        border[1, 2, i] = pressure * (by_pressure + log_rate * s.vapour_rate)
        border[0, 3, i], border[1, 3, i] = pressure * s.heat_rate, pressure * s.vapour_rate
        border[0, 4, i] = heat_wall
        border[1, 4, i] = vapour_wall * wall.vapour_heat + s.coupling_slope * space.inside[0, 1 + i]
        work.coupling[0, i], work.coupling[1, i] = s.coupling, s.coupling_slope
    outer, beyond = work.outer[0], work.outer_border
    for i in range(m):
        g = gel_slopes(space.stretching[i], space.shear[i], outer[1 + i], outer[1 + m + i], radius, velocity, wall, b, c)
        factors[6, i], factors[7, i], factors[8, i] = g.first, g.second, 0.0
        through = (g.second * space.outside[0, 1 + m + i] + g.first * space.outside[0, 1 + i]) / wall.conductivity
        beyond[0, i], beyond[1, i], beyond[2, i] = g.radius, g.velocity, pressure * g.pressure
        beyond[3, i], beyond[4, i] = 0.0, g.wall + through


def shifted(factors, first, laplacian, shift, out):
    """``out = shift - J`` of one field by columns, from the factors of value, slope and Laplacian at each node."""
    size = len(out)
    by_slope, by_bend, by_value = factors[0], factors[1], factors[2]
    for j in range(size):
        column, slope, bend = out[j], first[j], laplacian[j]
        for i in range(size):
            column[i] = -(by_bend[i] * bend[i] + by_slope[i] * slope[i])
        column[j] += shift - by_value[j]


def linearise(state, time, space, work, member, setup):
    """``f(x)`` at a state (``work.rate``) and all its derivatives, into ``work``; returns ``d ln P/dt``."""
    b, c, fields = member.b, setup.c, HEAD + 2 * len(space.y) + len(space.shear)
    point = point_at(state, space, work, member, setup)
    wall, pressure, log_rate = point.wall, point.pressure, point.rate / point.pressure
    acceleration = motion_slopes(
        time,
        point.radius,
        point.velocity,
        pressure + b.constant_vapour,
        point.rate,
        state[fields:],
        member,
        setup,
        work.slopes,
        work.memory_slopes,
        work.moved,
        work.rate[fields:],
    )
    rates_at(point, acceleration, space, work, member, setup, work.rate)
    field_slopes(point, space, work, member, setup)
    s, corner = work.slopes, space.inside[0, 0]
    s[2], s[3] = pressure * (s[2] + log_rate * s[3]), pressure * s[3]
    q = pressure_rate_slopes(point.radius, point.velocity, pressure, wall, point.heat, point.vapour, corner, point.loss, b, c)
    w = wall_balance_slopes(pressure, wall, point.vapour, corner, space.outside[0, 0], b, c)
    rows = work.wall_rows
    rows[0, 0], rows[0, 1], rows[0, 3], rows[0, 4] = q.radius / pressure, q.velocity / pressure, q.rate, q.wall / pressure
    rows[0, 2] = q.pressure + log_rate * q.rate - log_rate
    rows[0, 5], rows[0, 6], rows[0, 7] = q.heat / pressure, q.vapour / pressure, q.outer / pressure
    rows[1, 0], rows[1, 1], rows[1, 3], rows[1, 4] = w.radius, w.velocity, pressure * w.rate, w.wall
    rows[1, 2] = pressure * (w.pressure + log_rate * w.rate)
    rows[1, 5], rows[1, 6], rows[1, 7] = w.heat, w.vapour, w.outer
    return log_rate


def factorise(shift, space, work):
    """Invert ``shift - J``: the blocks of the fields, what they add to the rows of the wall, and what is left beside them.

    What the fields add is ``w (shift - J)^-1`` with the slopes at the wall ``w``: columns beside the blocks (which stand by
    columns, as their transposes) that Gauss-Jordan carries along.
    """
    n, m, factors, small, rows = len(space.y), len(space.shear), work.factors, work.small, work.wall_rows
    heat, vapour, gel, functionals = work.heat, work.vapour, work.gel, work.functionals
    shifted(factors[0:3], space.first, space.laplacian, shift, heat)
    shifted(factors[3:6], space.first, space.laplacian, shift, vapour)
    shifted(factors[6:9], space.outer_first, space.outer_laplacian, shift, gel)
    for j in range(n):
        vapour[j, n] = space.inside[1 + j, 0]
    invert(vapour, work.pivots)
    for j in range(n):  # the slope of C at the wall hangs on tau through C_t
        small[0, j] = vapour[j, n] * work.coupling[1, j]
    multiply(space.rows, small[0], small[1])
    for j in range(n):
        heat[j, n] = space.inside[1 + j, 0]
        heat[j, n + 1] = small[1, j] + vapour[j, n] * work.coupling[0, j]
    invert(heat, work.pivots)
    for j in range(m):
        gel[j, m] = space.outside[1 + j, 0]
    invert(gel, work.pivots)
    for k in range(2):
        by_heat, by_vapour, by_gel = rows[k, 5], rows[k, 6], rows[k, 7]
        for j in range(n):
            functionals[k, j] = by_heat * heat[j, n] + by_vapour * heat[j, n + 1]
            functionals[k, n + j] = by_vapour * vapour[j, n]
        for j in range(m):
            functionals[k, 2 * n + j] = by_gel * gel[j, m]
    _border(shift, n, m, work)
    invert(work.border, work.pivots)


def _border(shift, n, m, work):
    """The system in (R, U, ln P, q, tau_w, memory) that is left when the fields are eliminated."""
    matrix, s = work.border, work.slopes
    states = len(matrix) - _BORDER
    matrix[:] = 0.0
    matrix[0, 0], matrix[0, 1] = shift, -1.0
    matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3] = -s[0], shift - s[1], -s[2], -s[3]
    matrix[2, 2], matrix[2, 3] = shift, -1.0
    for row in range(2):
        line = work.functionals[row]
        heat, vapour, gel = line[:n], line[n : 2 * n], line[2 * n :]
        for k in range(_BORDER):
            total = dot(heat, work.inner_border[0, k]) + dot(vapour, work.inner_border[1, k]) + dot(gel, work.outer_border[k])
            matrix[3 + row, k] = -total - work.wall_rows[row, k]
    matrix[3, 3] += 1.0
    for k in range(states):
        matrix[1, _BORDER + k] = -s[5 + k]
        matrix[_BORDER + k, 0], matrix[_BORDER + k, 1] = -work.memory_slopes[0, k], -work.memory_slopes[1, k]
        for j in range(states):
            matrix[_BORDER + k, _BORDER + j] = -work.memory_slopes[2 + j, k]
        matrix[_BORDER + k, _BORDER + k] += shift


def solve(right, space, work, out):
    """``out = (shift - J)^-1 right`` in the layout of the state."""
    n, m = len(space.y), len(space.shear)
    fields = 2 * n + m
    size, states = len(work.border), len(work.border) - _BORDER
    small = work.small
    for k in range(2):
        small[1, 3 + k] = dot(work.functionals[k], right[HEAD : HEAD + fields])
    small[1, 0], small[1, 1], small[1, 2] = right[0], right[1], right[2]
    small[1, 4] += right[3]
    for k in range(states):
        small[1, _BORDER + k] = right[HEAD + fields + k]
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += work.border[i, j] * small[1, j]
        small[0, i] = total
    out[0], out[1], out[2], out[3] = small[0, 0], small[0, 1], small[0, 2], small[0, 4]
    for k in range(states):
        out[HEAD + fields + k] = small[0, _BORDER + k]
    z0, z1, z2, z3, z4 = small[0, 0], small[0, 1], small[0, 2], small[0, 3], small[0, 4]
    drive, warm, slope = small[1], small[2], small[0]
    edge = work.inner_border[0]
    for i in range(n):
        drive[i] = right[HEAD + i] + (edge[0, i] * z0 + edge[1, i] * z1 + edge[2, i] * z2 + edge[3, i] * z3 + edge[4, i] * z4)
    multiply(work.heat, drive, warm)
    multiply(space.first, warm, slope)
    edge = work.inner_border[1]
    for i in range(n):
        out[HEAD + i] = warm[i]
        drive[i] = (
            right[HEAD + n + i]
            + (edge[0, i] * z0 + edge[1, i] * z1 + edge[2, i] * z2 + edge[3, i] * z3 + edge[4, i] * z4)
            + work.coupling[1, i] * slope[i]
            + work.coupling[0, i] * warm[i]
        )
    multiply(work.vapour, drive, warm)
    for i in range(n):
        out[HEAD + n + i] = warm[i]
    edge = work.outer_border
    for i in range(m):
        drive[i] = right[HEAD + 2 * n + i] + (edge[0, i] * z0 + edge[1, i] * z1 + edge[2, i] * z2 + edge[4, i] * z4)
    multiply(work.gel, drive, warm)
    for i in range(m):
        out[HEAD + 2 * n + i] = warm[i]


def step(state, time, h, space, work, member, setup, out):
    """One step of Rodas4P from a state whose rates and factors are in ``work``; ``out`` receives the new state.

    The last increment, the estimate of the error, is left in ``work.increments``.
    """
    n, m, size = len(space.y), len(space.shear), len(state)
    fields = HEAD + 2 * n + m
    increments, argument, right = work.increments, work.argument, work.right
    inverse = 1.0 / h
    driven = member.driven or setup.drive >= 0
    for stage in range(STAGES):
        if stage == 0:
            for i in range(size):
                right[i] = work.rate[i]
        else:
            for i in range(size):
                argument[i] = state[i]
            for k in range(stage):
                weight, increment = _ARGUMENT[stage, k], increments[k]
                for i in range(size):
                    argument[i] += weight * increment[i]
            there = point_at(argument, space, work, member, setup)
            force = motion(
                time + _MOMENTS[stage] * h,
                there.radius,
                there.velocity,
                there.pressure + member.b.constant_vapour,
                there.rate,
                argument[fields:],
                right[fields:],
                member,
                setup,
            )
            rates_at(there, force, space, work, member, setup, right)
            for k in range(stage):
                weight, increment = _COUPLING[stage, k] * inverse, increments[k]
                balance = right[3]
                for i in range(size):
                    right[i] += weight * increment[i]
                right[3] = balance  # tau_w is algebraic
        if driven:
            right[1] += work.slopes[4] * h * _TIME_INCREMENTS[stage]
        solve(right, space, work, increments[stage])
    for i in range(size):
        out[i] = argument[i] + increments[STAGES - 1, i]
