"""Stress integrals: what the gel around the bubble adds to the balance of pressures at its wall.

For a spherical bubble in an incompressible medium the stress integral ``S = 2 int_R^inf (tau_rr - tau_tt)/r dr`` is a
function of the stretch ratio ``lambda = R/R_inf`` and the wall velocity ``U``. The Keller-Miksis equation also needs
``dS/dt``, which holds ``dU/dt``; each term therefore returns ``S``, the part of ``dS/dt`` that is known from the state,
and the factor of ``dU/dt``. All quantities are dimensionless (pressures over ``p_inf``).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

from torch import Tensor


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
    """One additive contribution to the stress integral; vanishes when ``switch`` is at its neutral value."""

    names: ClassVar[tuple[str, ...]]
    """Parameters that the term reads."""
    switch: ClassVar[str]
    """The parameter whose neutral value turns the term off."""

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """Evaluate the term; all arguments dimensionless and broadcastable to ``batch_shape``."""
        ...


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
