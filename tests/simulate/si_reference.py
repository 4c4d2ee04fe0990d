"""A polytropic bubble by SciPy in SI units, each radial equation as its paper has it and every pressure
and its rate written out: nothing is shared with the package but the numbers of the conditions.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from imr_torch.simulate import Conditions

GAUSS = np.polynomial.legendre.leggauss(12)


@dataclass(frozen=True)
class Water:
    """A liquid in SI: density, enthalpy and sound speed from its equation of state alone; enthalpy is
    integrated numerically where it has no short form.
    """

    key: str
    p_inf: float
    rho: float
    c: float

    def density(self, p: float) -> float:
        if self.key == "constant_density":
            return self.rho
        if self.key == "tait":
            return self.rho * ((p + 304.913e6) / (self.p_inf + 304.913e6)) ** (1.0 / 7.15)
        if self.key == "noble_abel":
            b = 6.61e-4 * 997.0 / self.rho
            free = (1.0 / self.rho - b) * ((self.p_inf + 702.8e6) / (p + 702.8e6)) ** (
                1.0 / 1.19
            )
            return 1.0 / (b + free)
        top = 0.9 / 0.921

        def excess(m: float) -> float:
            return (
                self.rho * self.c**2 * m * (1.0 + m) / (1.0 - 0.921 * m) ** 2
                - p
                + self.p_inf
            )

        return self.rho * (1.0 + brentq(excess, -0.3, top, xtol=1e-16, rtol=1e-14))

    def enthalpy(self, p: float) -> float:
        """Above that at ``p_inf``."""
        if self.key == "constant_density":
            return (p - self.p_inf) / self.rho
        nodes, weights = GAUSS
        half = 0.5 * (p - self.p_inf)
        middle = 0.5 * (p + self.p_inf)
        return half * sum(
            w / self.density(middle + half * x) for x, w in zip(nodes, weights, strict=True)
        )

    def speed(self, p: float) -> float:
        """Over that at ``p_inf`` of its own, times ``c``."""
        if self.key == "constant_density":
            return self.c

        def own(q: float) -> float:
            step = 1e-5 * (q + 3e8)
            return 2.0 * step / (self.density(q + step) - self.density(q - step))

        return self.c * math.sqrt(own(p) / own(self.p_inf))


@dataclass(frozen=True)
class Reference:
    """A gel of the quadratic law in its conditions, SI.

    Args:
        conditions: of the bubble.
        G: modulus.
        mu: viscosity.
        alpha: stiffening.
        vapour_stiffens: the departure of the other public code: ``p' = -3 kappa p U/R`` with the
            total ``p``.
    """

    conditions: Conditions
    G: float = 0.0
    mu: float = 0.0
    alpha: float = 0.0
    vapour_stiffens: bool = False

    def press_wall(self, radius, speed, top: float, rest: float):
        """Pressure of the liquid at the wall and its rate without ``U'``, of numbers or arrays; ``top``
        is Rmax.
        """
        s = self.conditions.surroundings
        gas = self.conditions.gas
        kappa = 3.0 * gas.exponent
        vapour = 1.17e11 * math.exp(-5200.0 / s.temperature) if gas.vapour else 0.0
        at_rest = s.far_field_pressure + 2.0 * s.surface_tension / rest - vapour
        share = (rest / top) ** (3.0 if gas.reference == "maximum" else kappa)
        dry = at_rest * share * (top / radius) ** kappa
        tension = 2.0 * s.surface_tension / radius
        l = radius / rest  # noqa: E741
        excess = 2.0 * l**2 + l**-4 - 3.0
        poly = (
            177 / 20 + l**-8 / 4 + 2 / (5 * l**5) - 1.5 * l**-4 + 2 / l**2 - 6 / l - 4 * l
        )
        elastic = self.G * (self.alpha * poly - 0.5 * (5.0 - 4.0 / l - l**-4))
        viscous = -4.0 * self.mu * speed / radius
        # dS/dl = 2 (tau_rr - tau_tt)/(l^3 - 1): the quadrature over the stretch, differentiated at its end
        slope = -2.0 * self.G * (1.0 + self.alpha * excess) * (1.0 / l + l**-4)
        slope += tension - viscous - kappa * (dry + vapour * self.vapour_stiffens)
        return vapour + dry - tension + elastic + viscous, slope * speed / radius

    def right_side(self, top: float, rest: float) -> Callable:
        """``(U, U')`` of time, radius and velocity."""
        s = self.conditions.surroundings
        motion = self.conditions.motion
        driving = self.conditions.driving
        key = motion.key
        p_inf = s.far_field_pressure
        c0 = s.sound_speed
        water = Water(motion.liquid.key, p_inf, s.density, c0)

        def rate(t: float, y: NDArray[np.float64]) -> list[float]:
            r, u = y
            wall, known = self.press_wall(r, u, top, rest)
            push = push_rate = 0.0
            if driving:
                push, push_rate, _ = map(float, driving(torch.tensor(t).double()))
            far = p_inf + push
            if key == "rayleigh_plesset":
                return [u, ((wall - far) / s.density - 1.5 * u * u) / r]
            h = water.enthalpy(wall) - water.enthalpy(far)
            inertia = 1.0 / water.density(wall)
            known = known * inertia - push_rate / water.density(far)
            viscous = 4.0 * self.mu / r * inertia
            if key == "herring":  # R R'' (1 - 2 M) + 3/2 U^2 (1 - 4/3 M) = h + R/c h'
                force = h + r / c0 * known - 1.5 * u * u * (1.0 - 4.0 * u / (3.0 * c0))
                return [u, force / (r * (1.0 - 2.0 * u / c0) + r / c0 * viscous)]
            if key == "second_order":
                # q'/R = E + (1 - U/c) (R E)'/c - (E^2 - 16/5 U^2 E + 2 U^4)/c^2, E = h + U^2/2, q = R^2 U
                e = h + 0.5 * u * u
                late = (1.0 - u / c0) / c0
                force = e + late * (u * e + r * known) - 2.0 * u * u
                force -= (e * e - 3.2 * u * u * e + 2.0 * u**4) / c0**2
                return [u, force / (r - late * r * (u - viscous))]
            c = water.speed(wall) if key == "gilmore" else c0
            f = 1.0 - u / c if key == "gilmore" else 1.0
            mach = u / c
            force = (1.0 + mach) * h + r / c * f * known - 1.5 * (1.0 - mach / 3.0) * u * u
            return [u, force / ((1.0 - mach) * r + r / c * f * viscous)]

        return rate

    def solve(
        self, weber: float, rest: float, times: NDArray[np.float64], *, rtol: float = 1e-11
    ) -> NDArray[np.float64]:
        """Radius and velocity, ``2 x n_t``, in units of the dimensionless design."""
        s = self.conditions.surroundings
        top = s.max_radius(weber)
        units = np.array([top, s.velocity_scale])
        unit = s.time_scale(top)
        found = solve_ivp(
            self.right_side(top, rest * top),
            (0.0, times[-1] * unit),
            [top, 0.0],
            method="DOP853",
            t_eval=times * unit,
            rtol=rtol,
            atol=1e-2 * rtol * units,
        )
        assert found.success
        return found.y / units[:, None]
