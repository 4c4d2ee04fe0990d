"""The full-physics simulator: Keller-Miksis with heat conduction, evaporation and a warm gel, a batch at a time.

Fields are resolved spectrally (:mod:`~imr_torch.simulate.grids`), time by a linearly implicit method with the exact
Jacobian (:mod:`~imr_torch.simulate.rosenbrock`) and steps of each member's own (:mod:`~imr_torch.simulate.stream`).
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.material import AnyTerm
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.conditions import Conditions
from imr_torch.simulate.controller import Controller
from imr_torch.simulate.grids import Resolution
from imr_torch.simulate.rhs import Equations
from imr_torch.simulate.sensitivity import differentiable
from imr_torch.simulate.simulator import Solution, solve_batch, solve_bundles
from imr_torch.simulate.stream import Stream

_BATCH = 4000  # members whose paths are held in memory together


@dataclass(frozen=True)
class Accuracy:
    """How finely time and space are cut.

    Args:
        tolerance: relative error of a step.
        resolution: grids inside and outside the bubble.
        max_steps: attempted steps after which a member is given up.
        slots: members that advance together.
    """

    tolerance: float = 3e-4
    resolution: Resolution = field(default_factory=Resolution)
    max_steps: int = 2000
    slots: int = 500

    def __post_init__(self) -> None:
        if not 1e-12 <= self.tolerance <= 1e-1:
            raise InputDataError(f"Accuracy.tolerance is {self.tolerance}; expected 1e-12 to 0.1 (3e-4 is the default).")
        if self.max_steps < 1 or self.slots < 1:
            raise InputDataError(f"Accuracy needs max_steps and slots of at least 1, got {self.max_steps} and {self.slots}.")


ACCURACIES = {
    "fast": Accuracy(1e-3, Resolution(14, 14)),
    "default": Accuracy(),
    "search": Accuracy(max_steps=800),
    "reference": Accuracy(1e-6, Resolution(32, 40), max_steps=100000),
}
"""Named settings; their measured errors are in ``benchmarks/RESULTS.md``.

``search`` is the default with little patience, for fits, whose trial points may be absurd: what a gel does up to
``t* = 4`` takes some 500 steps, and one bubble of thousands would hold up all others."""


@dataclass(frozen=True)
class TransportSimulator:
    """A :class:`~imr_torch.simulate.Simulator` with heat and vapour transport.

    Args:
        conditions: surroundings, contents and gel; see ``PRESETS``.
        accuracy: how finely time and space are cut; see ``ACCURACIES``.
        terms: stress terms to choose from; all registered ones by default.
    """

    conditions: Conditions = field(default_factory=Conditions)
    accuracy: Accuracy = field(default_factory=Accuracy)
    terms: tuple[AnyTerm, ...] | None = None

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        """Simulate a batch; see :class:`imr_torch.simulate.Simulator`.

        Where an argument requires a gradient, radii carry it: see :func:`imr_torch.simulate.sensitivity.differentiable`.

        Raises:
            ShapeError: if shapes do not fit.
            InputDataError: if a design is impossible, or times are not increasing and finite.
        """
        if torch.is_grad_enabled() and any(x.requires_grad for x in (parameters, designs, times)):
            return differentiable(self, parameters, designs, times)
        with torch.no_grad():
            return solve_batch(self._solve, _BATCH, (parameters, designs, times))

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        """Simulate bundles in lock step; see :meth:`imr_torch.simulate.Simulator.bundle`."""
        with torch.no_grad():
            return solve_bundles(self._solve, _BATCH, (parameters, designs, times))

    def _solve(self, parameters: Tensor, designs: Tensor, times: Tensor, width: int = 1) -> tuple[Tensor, ...]:
        """One block of members, bundle after bundle: radius, velocity, pressure, status, steps."""
        settings = self.accuracy
        bubbles = Bubbles.of(parameters, designs, self.conditions, self.terms)
        inside, outside = (grid.to(parameters) for grid in settings.resolution.grids())
        controller = Controller(settings.tolerance)
        last = times[:, -1].unflatten(0, (-1, width)).amax(1)
        equations = Equations(bubbles, inside, outside)
        path = Stream(equations, last, controller, settings.slots, settings.max_steps, width).run()
        radius, velocity, pressure = path.at(times)
        return radius, velocity, pressure + bubbles["constant_vapour"][:, None], path.status, path.count
