"""Stress terms of viscosity without memory: Newtonian, and thinning with the shear rate.

In spherical motion the velocity is ``u = R^2 U/r^2`` and the shear rate ``2 sqrt(3) R^2 |U|/r^3``. With
``x = (R/r)^3`` a viscosity that depends on the shear rate gives ``S = -4 (U/R) int_0^1 mu(gamma_wall x) dx``, so ``S``
depends on ``U/R`` alone and ``dS/d(U/R)`` is four times the viscosity at the wall: nothing but ``S`` itself needs
quadrature.

Sources: Estrada et al. (J. Mech. Phys. Solids 112, 2018), eq. 10; Carreau (Trans. Soc. Rheol. 16, 1972); Gaudron, Warnez &
Johnsen (J. Fluid Mech. 766, 2015), section 2.3 for the integral.
"""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from imr_torch.material.stress import Stress, StressSlopes


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
        """See :class:`imr_torch.material.stress.StressTerm`."""
        per_radius = 1.0 / radius
        factor = -4.0 * theta["mu"] * per_radius
        strain = velocity * per_radius
        by_radius = Stress(-factor * strain, 2.0 * factor * strain * strain, -factor * per_radius)
        return StressSlopes(by_radius, Stress(factor, -2.0 * factor * strain, torch.zeros_like(factor)))


_NODES, _WEIGHTS = (torch.as_tensor(x) for x in np.polynomial.legendre.leggauss(16))
_SHEAR = 2.0 * 3.0**0.5  # shear rate at the wall over |U|/R


class CarreauThinning:
    """What shear thinning takes off the Newtonian term: ``mu(g) = mu (1 + (t_s g)^2)^(-s/2)``, Carreau (1972).

    ``s = 1 - n`` with the flow index ``n``; ``s = 0`` is Newtonian. The integral over the gel is taken by Gauss-Legendre
    quadrature in ``asinh`` of the shear rate, where the integrand is smooth: 16 nodes leave less than 1e-12 of ``mu`` up to
    ``t_s g = 1e4``.
    """

    names: ClassVar[tuple[str, ...]] = ("mu", "thinning", "shear_time")
    switch: ClassVar[str] = "thinning"
    analytic: ClassVar[bool] = True

    def __call__(self, radius: Tensor, velocity: Tensor, rest_radius: Tensor, theta: Mapping[str, Tensor]) -> Stress:
        """See :class:`imr_torch.material.stress.StressTerm`."""
        factor = 4.0 * theta["mu"]
        strain = velocity / radius
        reduced = _SHEAR * theta["shear_time"] * strain
        span = torch.asinh(reduced)
        nodes = 0.5 * (1.0 + _NODES.to(radius)).reshape(-1, *[1] * radius.ndim)
        weights = 0.5 * _WEIGHTS.to(radius).reshape(nodes.shape)
        cosh = torch.cosh(nodes * span)
        thinned = -cosh * torch.expm1(-theta["thinning"] * torch.log(cosh))  # exactly 0 without thinning
        stretch = torch.where(reduced == 0.0, 1.0, span / torch.where(reduced == 0.0, 1.0, reduced))
        lost = stretch * (weights * thinned).sum(0)  # of the mean viscosity over mu
        lost_at_wall = -torch.expm1(-0.5 * theta["thinning"] * torch.log(1.0 + reduced**2))
        return Stress(factor * strain * lost, -factor * lost_at_wall * strain * strain, factor * lost_at_wall / radius)
