"""Radius, velocity and pressure of one bubble at the times asked for, filled in as its steps are
taken; compiled.
"""

import numpy as np

from imr_torch.elementary import kernel

# numbers of a node; the last two are ln P and its rate
TIME, RADIUS, VELOCITY, ACCELERATION, PRESSURE, PRESSURE_RATE = range(6)


@kernel
def fill(before, after, begin, times, radius, velocity):
    """Radius and velocity at all times up to a node, by quintic Hermite interpolation.

    As :func:`imr_torch.simulate.clock.interpolate`: before ``t* = 0`` the polynomial ends after its
    second power.

    Args:
        before: the node before, six numbers in the order of the rows above.
        after: the node.
        begin: number of the first time that is not filled in yet.
        times: ``n_t`` times.
        radius: ``n_t``, receives ``R``.
        velocity: ``n_t``, receives ``U``.

    Returns:
        Number of the first time after the node.
    """
    t0 = before[TIME]
    h = max(after[TIME] - t0, 1e-300)
    r0 = before[RADIUS]
    u0 = before[VELOCITY] * h
    a0 = before[ACCELERATION] * h * h
    u1 = after[VELOCITY] * h
    a1 = after[ACCELERATION] * h * h
    d = after[RADIUS] - r0 - u0 - 0.5 * a0
    e = u1 - u0 - a0
    f = a1 - a0
    c3 = 10.0 * d - 4.0 * e + 0.5 * f
    c4 = -15.0 * d + 7.0 * e - f
    c5 = 6.0 * d - 3.0 * e + 0.5 * f
    while begin < len(times) and times[begin] <= after[TIME]:
        s = (times[begin] - t0) / h
        if s < 0.0:
            radius[begin], velocity[begin] = r0 + s * (u0 + s * 0.5 * a0), (u0 + s * a0) / h
        else:
            radius[begin] = r0 + s * (u0 + s * (0.5 * a0 + s * (c3 + s * (c4 + s * c5))))
            velocity[begin] = (u0 + s * (a0 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))) / h
        begin += 1
    return begin


@kernel
def fill_pressure(before, after, begin, end, times, pressure):
    """Pressure at some times before a node, by cubic Hermite interpolation of its logarithm.

    Arguments as :func:`fill`.
    """
    t0 = before[TIME]
    h = max(after[TIME] - t0, 1e-300)
    p0 = before[PRESSURE]
    q0 = before[PRESSURE_RATE] * h
    q1 = after[PRESSURE_RATE] * h
    rise = after[PRESSURE] - p0
    bend = 3.0 * rise - 2.0 * q0 - q1
    twist = q0 + q1 - 2.0 * rise
    for j in range(begin, end):
        s = (times[j] - t0) / h
        pressure[j] = np.exp(p0 + s * q0 if s < 0.0 else p0 + s * (q0 + s * (bend + s * twist)))


@kernel
def record(node, nodes, begin, second, times, curves):
    """Make a node the last of two, and fill the output up to it unless it is the first.

    Returns the next time to be filled.
    """
    before = nodes[0]
    after = nodes[1]
    for i in range(len(node)):
        before[i], after[i] = after[i], node[i]
    if not second:
        return begin
    end = fill(before, after, begin, times, curves[0], curves[1])
    fill_pressure(before, after, begin, end, times, curves[2])
    return end
