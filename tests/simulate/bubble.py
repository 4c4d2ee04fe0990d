"""What the tests of both simulators share: gels, times, and the equations of a polytropic bubble
written a second time.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from imr_torch.float64 import linspace, rand
from imr_torch.material import MATERIALS, PARAMETERS, reference_case
from imr_torch.random import generator
from imr_torch.simulate import (
    LIQUIDS,
    PRESETS,
    RADIAL_EQUATIONS,
    Conditions,
    GasMixture,
    Medium,
    Stepping,
    TabulatedDriving,
)

CLOSURES = {
    **PRESETS,
    "cold gel": Conditions(medium=Medium(warm=False)),
    "dry gas": Conditions(mixture=GasMixture(vapour="absent")),
    "constant vapour": Conditions(mixture=GasMixture(vapour="constant")),
    "frozen vapour": Conditions(mixture=GasMixture(vapour="frozen")),
}
"""What heat and vapour may do."""
FINE = Stepping(0.03, max_steps=100_000)
GEL = {"G": 2770.0, "mu": 0.186, "alpha": 0.48}
DESIGN = (1000.0, 0.2)
SI = GEL | {
    "G_lin": 4e3,
    "alpha_fung2": 0.1,
    "alpha_fung": 0.02,
    "thinning": 0.4,
    "shear_time": 2e-6,
    "tau": 5e-6,
    "retardation": 0.2,
    "tau_sls": 2e-5,
    "tau_sns": 2e-5,
    "tau_ucm": 5e-6,
}
"""A plausible value of every parameter of a registered model."""
MOTIONS = [
    motion
    for equation in RADIAL_EQUATIONS.values()
    for motion in (
        [replace(equation, liquid=liquid) for liquid in LIQUIDS.values()]
        if fields(equation)[0].init
        else [equation]
    )
]
"""Every radial equation in every liquid that it may have."""


def tensor(*values) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def grid(last: float = 3.0, count: int = 61) -> Tensor:
    return linspace(0.0, last, count)


def gel(**values: float) -> Tensor:
    return PARAMETERS.pack({name: tensor(value)[0] for name, value in values.items()})


def gel_of(model: str) -> Tensor:
    return gel(**{name: SI[name] for name in MATERIALS[model].names})


def draw_bubbles(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Gels of the paper's prior, ``count x p``, and designs all over its box, ``count x 2``."""
    low, high = tensor([100.0, 0.14], [1000.0, 0.30])
    unit = rand(count, 2, generator=generator(seed))
    gels = reference_case("stiff-pa").prior.sample(count, seed=seed).parameters
    return gels, low + (high - low) * unit


def assert_that_rates_are_derivatives(
    pressure: tuple[Tensor, Tensor, Tensor], time: Tensor, errors: tuple[float, float]
) -> None:
    """Of a pressure and its two rates, each rate is what autograd finds of the one before it."""
    for value, rate, error in zip(pressure, pressure[1:], errors, strict=False):
        (derivative,) = torch.autograd.grad(value.sum(), time, retain_graph=True)
        torch.testing.assert_close(rate.detach(), derivative, rtol=1e-12, atol=error)


def sampled(
    pressure: Callable[[np.ndarray], np.ndarray], last: float = 5e-4
) -> TabulatedDriving:
    """A pressure (Pa) as a function of time (s), sampled so finely that it is its own spline."""
    times = np.linspace(-2e-5, last, 8001)
    return TabulatedDriving(tuple(times.tolist()), tuple(pressure(times).tolist()))


def sine(amplitude: float, frequency: float, phase: float = 0.0) -> TabulatedDriving:
    return sampled(lambda t: amplitude * np.sin(2.0 * math.pi * frequency * t + phase))


@dataclass(frozen=True)
class Reference:
    """Keller-Miksis in SI pressures, ``U'`` from ``d/dt`` of every pressure written out; units of
    the dimensionless design.
    """

    conditions: Conditions
    G: float = 0.0
    mu: float = 0.0
    alpha: float = 0.0
    vapour_stiffens: bool = False  # the departure of the other public code: p' = -3 kappa p U/R with the total p

    def right_side(self, weber: float, rest: float) -> Callable:
        s = self.conditions.surroundings
        gas = self.conditions.gas
        p_inf = s.far_field_pressure
        rho = s.density
        kappa = gas.exponent
        r_max = weber * 2.0 * s.surface_tension / p_inf
        r_inf = rest * r_max
        p_v = 1.17e11 * math.exp(-5200.0 / s.temperature) if gas.vapour else 0.0
        p_rest = p_inf + 2.0 * s.surface_tension / r_inf - p_v
        p_top = (
            p_rest * rest**3
            if gas.reference == "maximum"
            else p_rest * rest ** (3.0 * kappa)
        )
        time = r_max * math.sqrt(rho / p_inf)

        def rate(t: float, y: np.ndarray) -> list[float]:
            radius = y[0] * r_max
            speed = y[1] * r_max / time
            l = radius / r_inf  # noqa: E741
            p_gas = p_top * (r_max / radius) ** (3.0 * kappa)
            p_gas_dot = (
                -3.0
                * kappa
                * (p_gas + (p_v if self.vapour_stiffens else 0.0))
                * speed
                / radius
            )
            tension = 2.0 * s.surface_tension / radius
            tension_dot = -2.0 * s.surface_tension * speed / radius**2
            excess = 2.0 * l**2 + l**-4 - 3.0
            # 2 (tau_rr - tau_tt) at the wall
            wall = 2.0 * self.G * (1.0 + self.alpha * excess) * (l**-4 - l**2)
            # dS/dt = 2 (tau_rr - tau_tt)|_R (U/R)/(l^3 - 1): the quadrature over the stretch ratio
            # differentiated at its end
            limit = -4.0 * self.G
            slope = wall / (l**3 - 1.0) if abs(l - 1.0) > 1e-9 else limit
            poly = (
                177 / 20
                + 1 / (4 * l**8)
                + 2 / (5 * l**5)
                - 3 / (2 * l**4)
                + 2 / l**2
                - 6 / l
                - 4 * l
            )
            elastic = -0.5 * self.G * (5.0 - 4.0 / l - l**-4) + self.alpha * self.G * poly
            elastic_dot = slope * speed / radius
            viscous = -4.0 * self.mu * speed / radius
            viscous_known = 4.0 * self.mu * speed**2 / radius**2
            p = p_gas + p_v - tension + elastic + viscous - p_inf
            p_dot = p_gas_dot - tension_dot + elastic_dot + viscous_known
            mach = speed / s.sound_speed
            right = ((1.0 + mach) * p + radius / s.sound_speed * p_dot) / rho - 1.5 * (
                1.0 - mach / 3.0
            ) * speed**2
            inertia = (1.0 - mach) * radius + 4.0 * self.mu / (rho * s.sound_speed)
            return [y[1], right / inertia * time**2 / r_max]

        return rate

    def solve(
        self, weber: float, rest: float, times: np.ndarray, *, rtol: float = 1e-11
    ) -> np.ndarray:
        """Radius and velocity, ``2 x n_t``."""
        span = (0.0, float(times[-1]))
        solution = solve_ivp(
            self.right_side(weber, rest),
            span,
            [1.0, 0.0],
            method="DOP853",
            t_eval=times,
            rtol=rtol,
            atol=1e-2 * rtol,
        )
        assert solution.success
        return solution.y
