"""Cheaper bubbles of the same physics, for where a thousandth of the radius does not matter.

Information gains and steps far from a minimum are decided by differences far larger than that; fits end with the simulator
they were given.
"""

from dataclasses import replace

from imr_torch.simulate.parallel import with_inner
from imr_torch.simulate.simulator import Simulator
from imr_torch.simulate.transport import ACCURACIES, TransportSimulator


def coarser(simulator: Simulator) -> Simulator:
    """A simulator of the full physics at the accuracy ``"coarse"``, if its own is finer; any other as it is.

    Errors of R* are .0005 in the mean and .01 at worst over reference gels, and a bubble costs a third.

    >>> from imr_torch.simulate import TransportSimulator, coarser
    >>> coarser(TransportSimulator()).accuracy.tolerance
    0.001
    """
    return with_inner(simulator, _coarse)


def _coarse(simulator: Simulator) -> Simulator:
    coarse = ACCURACIES["coarse"]
    if not isinstance(simulator, TransportSimulator) or simulator.accuracy.tolerance >= coarse.tolerance:
        return simulator
    return replace(simulator, accuracy=coarse)
