"""Radius, velocity and pressure of one bubble at the times asked for, filled in as its steps are
taken; compiled.
"""

import numpy as np

from imr_torch.elementary import kernel
from imr_torch.simulate.clock import hermite_cubic, hermite_quintic

# numbers of a node; the last two are ln P and its rate
TIME, RADIUS, VELOCITY, ACCELERATION, PRESSURE, PRESSURE_RATE = range(6)


@kernel
def fill_curves(before, after, begin, times, radius, velocity):
    """Radius and velocity at all times up to a node.

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
    start = before[TIME]
    step = max(after[TIME] - start, 1e-300)
    at = (before[RADIUS], after[RADIUS])
    speed = (before[VELOCITY], after[VELOCITY])
    force = (before[ACCELERATION], after[ACCELERATION])
    while begin < len(times) and times[begin] <= after[TIME]:
        share = (times[begin] - start) / step
        radius[begin], velocity[begin] = hermite_quintic(share, step, at, speed, force)
        begin += 1
    return begin


@kernel
def fill_pressure(before, after, begin, end, times, pressure):
    """Pressure at some times before a node, by cubic Hermite interpolation of its logarithm.

    Arguments as :func:`fill_curves`.
    """
    start = before[TIME]
    step = max(after[TIME] - start, 1e-300)
    logarithm = (before[PRESSURE], after[PRESSURE])
    rate = (before[PRESSURE_RATE], after[PRESSURE_RATE])
    for j in range(begin, end):
        pressure[j] = np.exp(hermite_cubic((times[j] - start) / step, step, logarithm, rate))


@kernel
def record_node(node, nodes, begin, second, times, curves):
    """Make a node the last of two, and fill the output up to it unless it is the first.

    Returns the next time to be filled.
    """
    before = nodes[0]
    after = nodes[1]
    for i in range(len(node)):
        before[i], after[i] = after[i], node[i]
    if not second:
        return begin
    end = fill_curves(before, after, begin, times, curves[0], curves[1])
    fill_pressure(before, after, begin, end, times, curves[2])
    return end
