"""The stress terms of the Kelvin-Voigt family: Newtonian viscosity, neo-Hookean elasticity, strain stiffening.

Sources: Gaudron, Warnez & Johnsen (J. Fluid Mech. 766, 2015) for the neo-Hookean integral; Yang et al. (Soft Matter 16,
2020) for the quadratic (qKV) strain-stiffening term; Estrada et al. (2018) for the viscous one.
"""

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from imr_torch.material.stress import Stress, StressSlopes, StressTerm


class NewtonianViscosity:
    """``S = -4 U / (Re R)`` (Estrada et al. 2018, eq. 10)."""

    names: ClassVar[tuple[str, ...]] = ("mu",)
    switch: ClassVar[str] = "mu"

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        factor = -4.0 * theta["mu"] / radius
        value = factor * velocity
        return Stress(value, -value * velocity / radius, factor)

    def slopes(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> StressSlopes:
        """See :func:`stress_slopes`."""
        per_radius = 1.0 / radius
        factor = -4.0 * theta["mu"] * per_radius
        strain = velocity * per_radius
        by_radius = Stress(-factor * strain, 2.0 * factor * strain * strain, -factor * per_radius)
        return StressSlopes(by_radius, Stress(factor, -2.0 * factor * strain, torch.zeros_like(factor)))


class NeoHookeanElasticity:
    """``S = -(5 - 4/l - 1/l^4) / (2 Ca)`` with ``l = R/R_inf`` (Gaudron et al. 2015, eq. 2.22)."""

    names: ClassVar[tuple[str, ...]] = ("G",)
    switch: ClassVar[str] = "G"

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        inverse = rest_radius / radius
        cubed = inverse**3
        half = 0.5 * theta["G"]
        value = -half * (5.0 - inverse * (4.0 + cubed))
        slope = -4.0 * half * inverse * (1.0 + cubed)  # dS/d(ln l)
        return Stress(value, slope * velocity / radius, torch.zeros_like(value))

    def slopes(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> StressSlopes:
        """See :func:`stress_slopes`."""
        inverse = rest_radius / radius
        cubed = inverse**3
        scale = -2.0 * theta["G"] * inverse
        return _elastic_slopes(scale * (1.0 + cubed), -scale * (1.0 + 4.0 * cubed), radius, velocity)


class StrainStiffening:
    """The quadratic term of qKV, ``(alpha/Ca)(177/20 + 1/(4 l^8) + 2/(5 l^5) - 3/(2 l^4) + 2/l^2 - 6/l - 4 l)``.

    Yang et al. (2020), eq. 13; ``alpha`` weighs the square of the first invariant ``I_1 - 3``.
    """

    names: ClassVar[tuple[str, ...]] = ("G", "alpha")
    switch: ClassVar[str] = "alpha"

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        x = rest_radius / radius
        stretch = radius / rest_radius
        x2 = x * x
        x4 = x2 * x2
        scale = theta["alpha"] * theta["G"]
        value = scale * (8.85 + 0.25 * x4 * x4 + 0.4 * x4 * x - 1.5 * x4 + 2.0 * x2 - 6.0 * x - 4.0 * stretch)
        slope = scale * (-2.0 * x4 * x4 - 2.0 * x4 * x + 6.0 * x4 - 4.0 * x2 + 6.0 * x - 4.0 * stretch)  # dS/d(ln l)
        return Stress(value, slope * velocity / radius, torch.zeros_like(value))

    def slopes(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> StressSlopes:
        """See :func:`stress_slopes`."""
        x = rest_radius / radius
        stretch = 4.0 * radius / rest_radius
        x2 = x * x
        x4 = x2 * x2
        eighth, fifth, fourth, second, first = -2.0 * x4 * x4, -2.0 * x4 * x, 6.0 * x4, -4.0 * x2, 6.0 * x
        scale = theta["alpha"] * theta["G"]
        slope = scale * (eighth + fifth + fourth + second + first - stretch)
        bend = -scale * (8.0 * eighth + 5.0 * fifth + 4.0 * fourth + 2.0 * second + first + stretch)
        return _elastic_slopes(slope, bend, radius, velocity)


def _elastic_slopes(slope: Tensor, bend: Tensor, radius: Tensor, velocity: Tensor) -> StressSlopes:
    """Derivatives of an elastic term from its first and second derivative in ``ln l``."""
    per_radius = 1.0 / radius
    zero = torch.zeros_like(slope)
    by_radius = slope * per_radius
    return StressSlopes(
        Stress(by_radius, (bend - slope) * velocity * per_radius**2, zero),
        Stress(zero, by_radius, zero),
    )


TERMS: tuple[StressTerm, ...] = (NewtonianViscosity(), NeoHookeanElasticity(), StrainStiffening())
"""Every term a batch may need. Terms that are neutral in the whole batch cost nothing: see ``active_terms``."""


def active_terms(theta: Mapping[str, Tensor]) -> tuple[StressTerm, ...]:
    """Terms that do something for at least one member of the batch ``theta`` (neutral values are zero)."""
    return tuple(term for term in TERMS if bool((theta[term.switch] != 0.0).any()))


def stress_integral(
    terms: tuple[StressTerm, ...],
    radius: Tensor,
    velocity: Tensor,
    rest_radius: Tensor,
    theta: Mapping[str, Tensor],
) -> Stress:
    """Sum of ``terms``; see :class:`imr_torch.material.stress.StressTerm` for the arguments."""
    zero = torch.zeros_like(radius)
    total = Stress(zero, zero, zero)
    for term in terms:
        total = total + term(radius, velocity, rest_radius, theta)
    return total


def stress_slopes(
    terms: tuple[StressTerm, ...],
    radius: Tensor,
    velocity: Tensor,
    rest_radius: Tensor,
    theta: Mapping[str, Tensor],
) -> StressSlopes:
    """Derivatives in ``R`` and ``U`` of the sum of ``terms``, each argument a ``B`` tensor or broadcastable to it.

    A term may give its own through a method ``slopes`` (same arguments); any other is differentiated automatically,
    which is as exact and takes longer.
    """
    zero = torch.zeros_like(radius)
    nothing = Stress(zero, zero, zero)
    total = StressSlopes(nothing, nothing)
    for term in terms:
        slopes = getattr(term, "slopes", None)
        arguments = (radius, velocity, rest_radius, theta)
        total = total + (slopes(*arguments) if slopes else automatic_slopes(term, *arguments))
    return total


def automatic_slopes(
    term: StressTerm, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]
) -> StressSlopes:
    """Derivatives of one term by forward differentiation; arguments as in :func:`stress_slopes`."""

    def evaluate(radius: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        stress = term(radius, velocity, rest_radius, theta)
        return stress.value, stress.rate, stress.acceleration

    one, zero = torch.ones_like(radius), torch.zeros_like(radius)
    by_radius = torch.func.jvp(evaluate, (radius, velocity), (one, zero))[1]
    by_velocity = torch.func.jvp(evaluate, (radius, velocity), (zero, one))[1]
    return StressSlopes(Stress(*by_radius), Stress(*by_velocity))
