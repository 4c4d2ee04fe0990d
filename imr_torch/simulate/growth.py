"""Growth before the maximum radius: the bubble with time running backwards.

At its maximum radius the bubble is at rest. What it did before follows from the same equations of
motion in reversed time, in which all that dissipates (viscosity, drag, sound that leaves) changes
its sign and all that does not (elasticity, pressure, inertia) stays. So growth needs no parameter
that the collapse does not have, and it tells the two kinds apart. The contents are those of the
collapse, since at large radii their pressure is small. A gel that remembers cannot be run
backwards: its memory at the maximum is what growth has made of it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from imr_torch.errors import UnsupportedError
from imr_torch.material import PARAMETERS, TERMS
from imr_torch.simulate.conditions import Conditions
from imr_torch.simulate.setting import OF_MEDIUM
from imr_torch.simulate.simulator import Simulator, Solution
from imr_torch.types import DesignVectors, FrameTimes, ParameterVectors

AT_MAXIMUM = -0.02
"""t* down to which a curve is taken to go on before its maximum as it does after it."""


def check_reversible(model: str, names: Sequence[str], simulator: Simulator) -> None:
    """Raise unless a model with these parameters can be run backwards in time.

    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.simulate.growth import check_reversible
    >>> check_reversible("nhkv", ("G", "mu", "density"), PolytropicSimulator())
    """
    if simulator.conditions.driving is not None:
        raise UnsupportedError(
            "Growth cannot be predicted under a driving pressure, which is known from the maximum "
            "on. Leave the driving out, or fit without growth."
        )
    forgets = {name for term in TERMS if term.odd is not None for name in term.names}
    lost = [name for name in names if name not in {*OF_MEDIUM.values(), *forgets}]
    if lost:
        raise UnsupportedError(
            f"Growth cannot be predicted for {model}: {lost[0]} is of a gel that remembers, or of an "
            "effect. Leave the model out, or fit without growth."
        )


@dataclass(frozen=True)
class WithGrowth:
    """A simulator whose bubbles also have times before the maximum radius.

    Args:
        simulator: of bubbles from their maximum on.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.simulate.growth import WithGrowth
    >>> times, design = torch.tensor([-0.6, 0.0, 0.6], dtype=torch.float64), torch.tensor([400.0, 0.22]).double()
    >>> radius = WithGrowth(PolytropicSimulator())(PARAMETERS.pack({"mu": 0.1}), design, times).radius
    >>> [round(x, 3) for x in radius.tolist()]  # viscosity: growth is faster than collapse
    [0.796, 1.0, 0.807]
    """

    simulator: Simulator

    @property
    def conditions(self) -> Conditions:
        """Those of the simulator."""
        return self.simulator.conditions

    @cached_property
    def _reverse(self) -> Simulator:
        """The simulator with time running backwards."""
        simulator: Any = self.simulator
        return replace(simulator, conditions=replace(simulator.conditions, backwards=True))

    def __call__(
        self, parameters: ParameterVectors, designs: DesignVectors, times: FrameTimes
    ) -> Solution:
        """Simulate a batch; see :class:`imr_torch.simulate.Simulator`."""
        return _join_halves(self.simulator, self._reverse, parameters, designs, times)

    def bundle(
        self, parameters: ParameterVectors, designs: DesignVectors, times: FrameTimes
    ) -> Solution:
        """Simulate bundles."""
        halves = (self.simulator.bundle, self._reverse.bundle)
        return _join_halves(*halves, parameters, designs, times)


def _join_halves(
    forwards: Callable[..., Solution],
    backwards: Callable[..., Solution],
    parameters: Tensor,
    designs: Tensor,
    times: Tensor,
) -> Solution:
    """Each half is asked for its own times; those of the other are at the maximum, a billionth of
    them away.
    """
    odd = PARAMETERS.index(sorted({name for term in TERMS for name in term.odd or ()}))
    signs = torch.ones(len(PARAMETERS), dtype=parameters.dtype)
    signs[odd] = -1.0
    early = times < 0.0
    after = forwards(parameters, designs, torch.where(early, 1e-9 * times, times))
    mirrored = torch.where(early, -times, -1e-9 * times).flip(-1)
    before = backwards(parameters * signs, designs, mirrored)
    return replace(
        after,
        times=times.expand(after.radius.shape),
        radius=torch.where(early, before.radius.flip(-1), after.radius),
        velocity=torch.where(early, -before.velocity.flip(-1), after.velocity),
        bubble_pressure=torch.where(
            early, before.bubble_pressure.flip(-1), after.bubble_pressure
        ),
        status=torch.maximum(after.status, before.status),
    )
