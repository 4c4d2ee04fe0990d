"""Stress integrals: what the gel around the bubble adds to the balance of pressures at its wall.

For a spherical bubble in an incompressible medium the stress integral ``S = 2 int_R^inf (tau_rr - tau_tt)/r dr`` is a
function of the stretch ratio ``lambda = R/R_inf``, the wall velocity ``U`` and, where the gel remembers, of *memory
states* with rates of their own. The radial equations also need ``dS/dt``, which holds ``dU/dt``; each term therefore
returns ``S``, the part of ``dS/dt`` that is known from the state, and the factor of ``dU/dt``. All quantities are
dimensionless (pressures over ``p_inf``).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

from torch import Tensor
from typing_extensions import TypeIs


@dataclass(frozen=True)
class Stress:
    """A stress integral and its time derivative ``dS/dt = rate + acceleration * dU/dt``.

    Args:
        value: ``batch_shape`` tensor, ``S`` over ``p_inf``.
        rate: ``batch_shape`` tensor, the part of ``dS/dt`` without ``dU/dt``.
        acceleration: ``batch_shape`` tensor, the factor of ``dU/dt``.
    """

    value: Tensor
    rate: Tensor
    acceleration: Tensor

    def __add__(self, other: "Stress") -> "Stress":
        return Stress(self.value + other.value, self.rate + other.rate, self.acceleration + other.acceleration)


class StressTerm(Protocol):
    """One additive contribution to the stress integral; vanishes when ``switch`` is at its neutral value.

    A term may offer a method ``slopes`` of the same arguments that returns its :class:`StressSlopes`; any other term is
    differentiated automatically, which is as exact and takes longer. A term that is an analytic function of ``R``, ``U`` and
    memory (no ``abs``, ``sign``, ``clamp`` or comparison of them) may say ``analytic = True``, which makes that fast.
    """

    names: ClassVar[tuple[str, ...]]
    """Parameters that the term reads."""
    switch: ClassVar[str]
    """The parameter whose neutral value turns the term off."""

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """Evaluate the term; all arguments dimensionless and broadcastable to ``batch_shape``."""
        ...


class MemoryTerm(Protocol):
    """A term with memory: ``states`` numbers a member that follow rates of their own.

    A memory state is scaled as a pressure over ``p_inf``. Members whose ``switch`` is neutral have it too where another
    member of the batch needs it; it must do nothing for them.
    """

    names: ClassVar[tuple[str, ...]]
    switch: ClassVar[str]
    states: ClassVar[int]
    """How many memory states the term carries."""

    def __call__(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Stress:
        """Evaluate the term; ``memory`` is ``states x batch_shape``. ``rate`` includes what the memory's own rate does."""
        ...

    def start(self, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Tensor:
        """``memory`` at time zero, where ``R = 1``, ``states x batch_shape``."""
        ...

    def memory_rate(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Tensor:
        """Time derivative of ``memory``, ``states x batch_shape``."""
        ...

    def fastest(self, theta: Mapping[str, Tensor]) -> Tensor:
        """Rate at which the fastest state relaxes, ``batch_shape``; explicit solvers must resolve it."""
        ...


AnyTerm = StressTerm | MemoryTerm


def remembers(term: AnyTerm) -> TypeIs[MemoryTerm]:
    """Whether a term has memory; asked at every step, where ``isinstance`` of a protocol takes a tenth of a small batch."""
    return hasattr(term, "states")


@dataclass(frozen=True)
class StressSlopes:
    """Partial derivatives of a :class:`Stress`, for solvers that need an exact Jacobian.

    Args:
        radius: derivative of each entry in ``R``.
        velocity: derivative of each entry in ``U``.
    """

    radius: Stress
    velocity: Stress

    def __add__(self, other: "StressSlopes") -> "StressSlopes":
        return StressSlopes(self.radius + other.radius, self.velocity + other.velocity)
