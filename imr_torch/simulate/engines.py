"""Choice of the engine that integrates the bubbles: compiled code, or tensors through
``torchdiffeq``.

``"compiled"``, the default, integrates one bubble after the other in machine code
(:mod:`imr_torch.simulate.compiled`), on several processor threads. ``"torchdiffeq"`` integrates
whole batches of tensors: on a GPU, with gradients by autograd, and with laws that have no compiled
form. Where the compiled engine cannot serve, the tensor engine takes over by itself, warns once,
and gives the same answer.
"""

import functools
import warnings
from dataclasses import KW_ONLY, dataclass, field
from typing import ClassVar, Literal

import torch
from torch import Tensor

from imr_torch.elementary import obstacle_of
from imr_torch.errors import EngineWarning, check_at_least, check_choice
from imr_torch.material import StressTerm
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.conditions import Conditions
from imr_torch.simulate.sensitivity import differentiable
from imr_torch.simulate.simulator import (
    Solution,
    in_transform,
    is_tracked,
    solve_batch,
    solve_bundles,
)
from imr_torch.types import DesignVectors, FrameTimes, ParameterVectors

Engine = Literal["compiled", "torchdiffeq"]
"""What integrates the bubbles."""
ENGINES = ("compiled", "torchdiffeq")
"""The names of the engines."""


@dataclass(frozen=True)
class EngineSimulator:
    """What both simulators share: a batch or bundles, checked, cut into blocks and integrated.

    Attributes:
        members: integrated together on a processor.
        member_bytes: memory of a member while tensors of it are integrated.
    """

    conditions: Conditions = field(default_factory=Conditions)
    _: KW_ONLY
    terms: tuple[StressTerm, ...] | None = None
    engine: Engine = field(default="compiled", repr=False, compare=False)
    threads: int | None = field(default=None, repr=False, compare=False)
    members: ClassVar[int]
    member_bytes: ClassVar[int]

    def __post_init__(self) -> None:
        check_choice(self, "engine", ENGINES)
        check_at_least(self, 1, "threads", note=", or None for all cores")

    def __call__(
        self,
        parameters: ParameterVectors,
        designs: DesignVectors,
        times: FrameTimes,
    ) -> Solution:
        """Simulate a batch; see :class:`imr_torch.simulate.Simulator`.

        Where an argument requires a gradient, radii carry it: see
        :func:`imr_torch.simulate.sensitivity.differentiable`.

        Raises:
            ShapeError: if shapes do not fit.
            InputDataError: if a design is impossible, or times are not increasing and finite.
        """
        inputs = (parameters, designs, times)
        if in_transform(*inputs) or is_tracked(*inputs):
            return differentiable(self, *inputs)
        return solve_batch(self._solve, self._count_together(parameters), inputs)

    def bundle(
        self,
        parameters: ParameterVectors,
        designs: DesignVectors,
        times: FrameTimes,
    ) -> Solution:
        """Simulate bundles in lock step; see :meth:`imr_torch.simulate.Simulator.bundle`."""
        size = self._count_together(parameters)
        with torch.no_grad():
            return solve_bundles(self._solve, size, (parameters, designs, times))

    def _count_together(self, parameters: Tensor) -> int:
        """Members integrated together: on a processor so many that its cache holds them; on a GPU
        as many as memory holds.

        A GPU takes as long for one bubble as for thousands. Half of the memory that is free is used.
        """
        if not parameters.is_cuda:
            return self.members
        free, _ = torch.cuda.mem_get_info(parameters.device)
        return max(self.members, free // (2 * self.member_bytes))

    def _solve(
        self, parameters: Tensor, designs: Tensor, times: Tensor, width: int = 1
    ) -> tuple[Tensor, ...]:
        """One block of members, bundle after bundle: radius, velocity, pressure, status, steps."""
        raise NotImplementedError

    def _can_compile(self, bubbles: Bubbles) -> bool:
        """Whether the compiled engine integrates a batch.

        If it was asked for and cannot, the reason is given once.
        """
        if self.engine != "compiled":
            return False
        reason = _find_obstacle(bubbles)
        if reason is not None:
            _warn_once(
                f"Bubbles are integrated by the torchdiffeq engine, since {reason}; results are "
                "the same and take longer."
            )
        return reason is None


def _find_obstacle(bubbles: Bubbles) -> str | None:
    """What keeps a batch from the compiled engine, in words; laws that do not act are no obstacle."""
    parameters = bubbles.parameters
    if parameters.device.type != "cpu":
        return f"the compiled engine does not run on {parameters.device}"
    if parameters.dtype != torch.float64:
        return f"the compiled engine computes in float64, not in {parameters.dtype}"
    motion = bubbles.conditions.motion
    laws = [type(part).law for part in (motion, motion.liquid, bubbles.conditions.gas)]
    missing = [
        *(law.__qualname__ for law in laws if obstacle_of(law) is not None),
        *(part.name for part in (*bubbles.terms, *bubbles.effects) if not part.compilable),
    ]
    return f"{missing[0]} has no compiled form" if missing else None


@functools.cache
def _warn_once(message: str) -> None:
    warnings.warn(message, EngineWarning, stacklevel=5)
