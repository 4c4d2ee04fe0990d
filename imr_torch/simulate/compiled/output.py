"""Radius, velocity and pressure of one bubble at the times asked for, filled in as its steps are
taken; compiled.
"""

import numpy as np

from imr_torch.elementary import kernel
from imr_torch.simulate.clock import hermite_cubic, hermite_quintic

# numbers of a node; the last two are ln P and its rate
TIME, RADIUS, VELOCITY, ACCELERATION, PRESSURE, PRESSURE_RATE = range(6)


@kernel
def push_node(node, nodes):
    """Make a node the last of two."""
    for i in range(len(node)):
        nodes[0, i], nodes[1, i] = nodes[1, i], node[i]


@kernel
def fill_curves(nodes, begin, times, curves):
    """Radius, velocity and share of the step at all times up to the last of two nodes.

    Args:
        nodes: six numbers each, in the order of the rows above.
        begin: number of the first time that is not filled in yet.
        times: ``n_t`` times.
        curves: receives ``R``, ``U`` and the share of the step, ``n_t`` numbers each.

    Returns:
        Number of the first time after the node.
    """
    before = nodes[0]
    after = nodes[1]
    step = max(after[TIME] - before[TIME], 1e-300)
    radius = (before[RADIUS], after[RADIUS])
    velocity = (before[VELOCITY], after[VELOCITY])
    force = (before[ACCELERATION], after[ACCELERATION])
    while begin < len(times) and times[begin] <= after[TIME]:
        share = (times[begin] - before[TIME]) / step
        curves[0, begin], curves[1, begin] = hermite_quintic(
            share, step, radius, velocity, force
        )
        curves[2, begin] = share
        begin += 1
    return begin


@kernel
def record_node(node, nodes, begin, second, times, curves):
    """Make a node the last of two, and fill the output up to it unless it is the first: the pressure
    by cubic Hermite interpolation of its logarithm.

    Returns the next time to be filled.
    """
    push_node(node, nodes)
    if not second:
        return begin
    end = fill_curves(nodes, begin, times, curves)
    before = nodes[0]
    after = nodes[1]
    step = max(after[TIME] - before[TIME], 1e-300)
    logarithm = (before[PRESSURE], after[PRESSURE])
    rate = (before[PRESSURE_RATE], after[PRESSURE_RATE])
    for j in range(begin, end):
        curves[2, j] = np.exp(hermite_cubic(curves[2, j], step, logarithm, rate))
    return end
