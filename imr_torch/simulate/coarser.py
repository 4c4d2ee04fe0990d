"""Cheaper bubbles of the same physics, where a thousandth of the radius or bubbles of extreme
parameters do not matter.

Information gains and steps far from a minimum are decided by differences far larger than that; fits
end with the simulator they were given.
"""

from dataclasses import replace

from imr_torch.simulate.polytropic import PolytropicSimulator
from imr_torch.simulate.simulator import Simulator
from imr_torch.simulate.transport import ACCURACIES, TransportSimulator


def coarser(simulator: Simulator) -> Simulator:
    """A simulator of the full physics at the accuracy ``"coarse"``, if its own is finer; any other
    as it is.

    Errors of R* are .0005 in the mean and .01 at worst over reference gels, and a bubble costs a
    third.

    >>> from imr_torch.simulate import TransportSimulator, coarser
    >>> coarser(TransportSimulator()).accuracy.tolerance
    0.001
    """
    coarse = ACCURACIES["coarse"]
    if (
        not isinstance(simulator, TransportSimulator)
        or simulator.accuracy.tolerance >= coarse.tolerance
    ):
        return simulator
    return replace(simulator, accuracy=coarse)


def fewer_steps(simulator: Simulator, most: int = 600) -> Simulator:
    """A polytropic simulator that gives a bubble up after ``most`` steps, if its own limit is higher;
    any other as it is.

    A relaxation time of .3 us takes 480 steps, most gels 200. Explicit steps become very short
    where the relaxation time of a gel is short, and good fits do not end there.

    >>> from imr_torch.simulate import PolytropicSimulator, fewer_steps
    >>> fewer_steps(PolytropicSimulator()).stepping.max_steps
    600
    """
    if not isinstance(simulator, PolytropicSimulator):
        return simulator
    stepping = simulator.stepping
    return replace(simulator, stepping=replace(stepping, max_steps=min(stepping.max_steps, most)))
