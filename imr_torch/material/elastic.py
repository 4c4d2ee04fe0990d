"""Stress terms of elasticity: each the integral of a strain energy over the gel round the bubble.

With the hoop stretch ``b`` of the material at a distance, ``S = -2 int_1^l (b^-2 + b^-5) dW/dI_1 / (G/2) db/Ca`` over ``b``
from 1 (far away) to ``l = R/R_inf`` (the wall), and ``I_1 = b^-4 + 2 b^2``.

Sources: Gaudron, Warnez & Johnsen (J. Fluid Mech. 766, 2015) for the neo-Hookean integral; Yang et al. (Soft Matter 16,
2020) for the quadratic (qKV) term; Fung (Am. J. Physiol. 213, 1967) for the exponential law, of which qKV is the first order.
"""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from imr_torch.material.stress import Stress, StressSlopes


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
        """See :class:`imr_torch.material.stress.StressTerm`."""
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
        x2 = x * x
        x3 = x2 * x
        stretch = 4.0 / x
        scale = theta["alpha"] * theta["G"]
        value = scale * (8.85 - stretch + x * (x3 * (x * (0.4 + 0.25 * x3) - 1.5) + 2.0 * x - 6.0))
        slope = scale * (-2.0 * x * (x3 * (x + x2 * x2 - 3.0) + 2.0 * x - 3.0) - stretch)  # dS/d(ln l)
        return Stress(value, slope * velocity / radius, torch.zeros_like(value))

    def slopes(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> StressSlopes:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        x = rest_radius / radius
        stretch = 4.0 * radius / rest_radius
        x2 = x * x
        x4 = x2 * x2
        eighth, fifth, fourth, second, first = -2.0 * x4 * x4, -2.0 * x4 * x, 6.0 * x4, -4.0 * x2, 6.0 * x
        scale = theta["alpha"] * theta["G"]
        slope = scale * (eighth + fifth + fourth + second + first - stretch)
        bend = -scale * (8.0 * eighth + 5.0 * fifth + 4.0 * fourth + 2.0 * second + first + stretch)
        return _elastic_slopes(slope, bend, radius, velocity)


class LinearElasticity:
    """The small-strain limit, ``S = -(4/3) G (1 - 1/l^3)`` (Estrada et al. 2018, section 2.2)."""

    names: ClassVar[tuple[str, ...]] = ("G_lin",)
    switch: ClassVar[str] = "G_lin"

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        cubed = (rest_radius / radius) ** 3
        value = -4.0 / 3.0 * theta["G_lin"] * (1.0 - cubed)
        return Stress(value, -4.0 * theta["G_lin"] * cubed * velocity / radius, torch.zeros_like(value))

    def slopes(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> StressSlopes:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        slope = -4.0 * theta["G_lin"] * (rest_radius / radius) ** 3
        return _elastic_slopes(slope, -3.0 * slope, radius, velocity)


def _graded_rule(count: int) -> tuple[Tensor, Tensor]:
    """Nodes and weights on [0, 1], Gauss-Legendre in ``u`` of ``1 - (1 - u)^2``: dense at 1, where exponentials live."""
    nodes, weights = (torch.as_tensor(x) for x in np.polynomial.legendre.leggauss(count))
    left = 0.5 * (1.0 - nodes)
    return 1.0 - left * left, weights * left


_NODES, _WEIGHTS = _graded_rule(32)


class _FungElasticity:
    """Stiffening beyond neo-Hookean, ``2 (b^-2 + b^-5) G (f(I_1 - 3) - 1)`` integrated over ``ln b`` by quadrature.

    The error is below 1e-11 of the integral up to ``alpha (I_1 - 3) = 20`` and below 1e-6 up to 100.
    """

    names: ClassVar[tuple[str, ...]]
    switch: ClassVar[str]
    analytic: ClassVar[bool] = True

    def excess(self, alpha: Tensor, invariant: Tensor) -> Tensor:
        """``f - 1``: the relative increase of the modulus at ``I_1 - 3``."""
        raise NotImplementedError

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        stretch = radius / rest_radius
        nodes = _NODES.to(radius).reshape(-1, *[1] * radius.ndim)
        weights = _WEIGHTS.to(radius).reshape(nodes.shape)
        span = torch.log(stretch)
        value = span * (weights * self._density(torch.exp(nodes * span), theta)).sum(0)
        rate = self._density(stretch, theta) * velocity / radius
        return Stress(value, rate, torch.zeros_like(value))

    def _density(self, stretch: Tensor, theta: Mapping[str, Tensor]) -> Tensor:
        """``dS/d ln b`` at a hoop stretch."""
        inverse = 1.0 / stretch
        invariant = inverse**4 + 2.0 * stretch * stretch - 3.0
        return -2.0 * theta["G"] * (inverse + inverse**4) * self.excess(theta[self.switch], invariant)


class SecondOrderFung(_FungElasticity):
    """The exponential law to second order: ``f = 1 + a x + a^2 x^2/2``."""

    names: ClassVar[tuple[str, ...]] = ("G", "alpha_fung2")
    switch: ClassVar[str] = "alpha_fung2"

    def excess(self, alpha: Tensor, invariant: Tensor) -> Tensor:
        """See :class:`_FungElasticity`."""
        scaled = alpha * invariant
        return scaled * (1.0 + 0.5 * scaled)


class ExponentialFung(_FungElasticity):
    """``W = G/(2 a) (exp(a (I_1 - 3)) - 1)`` (Fung 1967): ``f = exp(a x)``."""

    names: ClassVar[tuple[str, ...]] = ("G", "alpha_fung")
    switch: ClassVar[str] = "alpha_fung"

    def excess(self, alpha: Tensor, invariant: Tensor) -> Tensor:
        """See :class:`_FungElasticity`."""
        exponent = alpha * invariant
        return torch.expm1(torch.where(exponent.real > 300.0, 300.0, exponent))  # stiffer than any bubble all the same


def _elastic_slopes(slope: Tensor, bend: Tensor, radius: Tensor, velocity: Tensor) -> StressSlopes:
    """Derivatives of an elastic term from its first and second derivative in ``ln l``."""
    per_radius = 1.0 / radius
    zero = torch.zeros_like(slope)
    by_radius = slope * per_radius
    return StressSlopes(
        Stress(by_radius, (bend - slope) * velocity * per_radius**2, zero),
        Stress(zero, by_radius, zero),
    )
