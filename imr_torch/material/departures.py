"""Stress terms of gels that are not what a model says: damaged, plastic, graded, or set.

Each is a correction to the elastic stress beside it with one number that does nothing at zero, so that it can be put on any
model and inferred with it. They are closures, chosen to be simple and to act where the effect does, not laws of their own.
"""

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from imr_torch.material.elastic import NeoHookeanElasticity, StrainStiffening
from imr_torch.material.stress import Stress

_SMOOTH = 0.02  # velocity below which |U| and sign(U) are rounded off
_SLOWEST = 0.1  # shear rate below which a yield stress is not felt


def _elastic(radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
    """The elastic stress of the models that may be damaged or set."""
    gel = (radius, velocity, rest_radius, theta)
    return NeoHookeanElasticity()(*gel) + StrainStiffening()(*gel)


class Damage:
    """Softening with accumulated strain: ``S_e (1 - D)``, ``D' = k (1 - D) |U|/R``. The state is ``D``."""

    names: ClassVar[tuple[str, ...]] = ("G", "alpha", "damage")
    switch: ClassVar[str] = "damage"
    states: ClassVar[int] = 1
    analytic: ClassVar[bool] = True

    def __call__(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Stress:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        whole = _elastic(radius, velocity, rest_radius, theta)
        growth = self.memory_rate(radius, velocity, rest_radius, theta, memory)[0]
        return Stress(-memory[0] * whole.value, -growth * whole.value - memory[0] * whole.rate, whole.acceleration)

    def start(self, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Tensor:
        """Whole: see :class:`imr_torch.material.stress.MemoryTerm`."""
        return torch.zeros_like(rest_radius)[None]

    def memory_rate(
        self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor], memory: Tensor
    ) -> Tensor:
        """See :class:`imr_torch.material.stress.MemoryTerm`."""
        speed = torch.sqrt(velocity * velocity + _SMOOTH**2) - _SMOOTH
        return theta["damage"] * (1.0 - memory) * speed / radius

    def fastest(self, theta: Mapping[str, Tensor]) -> Tensor:
        """Damage grows no faster than the bubble moves."""
        return torch.zeros_like(theta["damage"])


class YieldStress:
    """A stress to overcome: ``S = -2 tau_y sign(U) ln(r_y/R)``, with ``r_y`` where the shear rate falls to a slow one.

    The shear rate falls as ``r^-3``, so ``ln(r_y/R)`` is a third of the log of the shear rate at the wall over the slow one.
    """

    names: ClassVar[tuple[str, ...]] = ("yield_stress",)
    switch: ClassVar[str] = "yield_stress"
    analytic: ClassVar[bool] = True

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        strain = velocity / radius
        ratio = strain / _SLOWEST
        square = 1.0 + ratio * ratio
        rounded = 1.0 + (_SMOOTH / _SLOWEST) ** -2 * ratio * ratio
        direction = (_SMOOTH / _SLOWEST) ** -1 * ratio * torch.rsqrt(rounded)
        extent = torch.log(square) / 6.0
        scale = -2.0 * theta["yield_stress"]
        by_strain = direction * ratio / (3.0 * square * _SLOWEST) + extent / (_SMOOTH * rounded**1.5)
        return Stress(scale * direction * extent, -scale * by_strain * strain * strain, scale * by_strain / radius)


class GradedModulus:
    """A modulus ``G (1 + g (R_inf/r_0)^3)`` of the gel at rest: harder (or softer) towards the bubble.

    With the hoop stretch ``b``, ``(R_inf/r_0)^3 = (b^3 - 1)/(l^3 - 1)``: ``S = -2 G g int (b^2 - b^-4)/(l^3 - 1) d ln b`` from
    1 to ``l``, which is ``-2 G g (l^3 - 1) q`` with ``q = ((l + 1)/(2 l^2 (l^2 + l + 1)))^2 (2 l^2 + 1)``.
    """

    names: ClassVar[tuple[str, ...]] = ("G", "graded_modulus")
    switch: ClassVar[str] = "graded_modulus"
    analytic: ClassVar[bool] = True

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        stretch = radius / rest_radius
        inverse = rest_radius / radius
        square, cube = stretch * stretch, stretch * stretch * stretch
        root = (stretch + 1.0) / (2.0 * square * (square + stretch + 1.0))
        q = root * root * (2.0 * square + 1.0)
        slope = inverse * (1.0 + inverse * inverse * inverse) - 3.0 * cube * q  # of (l^3 - 1) q in ln l
        scale = -2.0 * theta["G"] * theta["graded_modulus"]
        value = scale * (cube - 1.0) * q
        return Stress(value, scale * slope * velocity / radius, torch.zeros_like(value))


class PermanentSet:
    """Growth has stretched the gel for good: its elastic stress is referred to ``R_inf (1 + s (1/R_inf - 1))``.

    The gas is not: it still rests at ``R_inf``. The set grows with the stretch ``1/R_inf`` at the maximum radius.
    """

    names: ClassVar[tuple[str, ...]] = ("G", "alpha", "permanent_set")
    switch: ClassVar[str] = "permanent_set"
    analytic: ClassVar[bool] = True

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        moved = rest_radius + theta["permanent_set"] * (1.0 - rest_radius)
        rests = torch.stack((moved, rest_radius)).reshape(2, *[1] * (radius.ndim - moved.ndim), *moved.shape)
        both = _elastic(radius, velocity, rests, theta)
        return Stress(both.value[0] - both.value[1], both.rate[0] - both.rate[1], both.acceleration[0])
