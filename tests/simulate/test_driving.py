"""Far-field driving: its derivatives, its table, and what it does to a bubble."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from torch.testing import assert_close

from imr_torch.float64 import linspace
from imr_torch.simulate import (
    RADIAL_EQUATIONS,
    Accuracy,
    Conditions,
    GasMixture,
    Medium,
    PolytropicGas,
    PolytropicSimulator,
    RadialEquation,
    Resolution,
    TabulatedDriving,
    TransportSimulator,
)
from imr_torch.units import Surroundings
from tests.refusals import refusals
from tests.simulate.bubble import (
    FINE,
    MOTIONS,
    assert_that_rates_are_derivatives,
    gel,
    grid,
    sampled,
    sine,
    tensor,
)
from tests.tables import for_each

PERIOD = 4e-5
SINE = sine(6e4, 1.0 / PERIOD, 0.4)


TABLE = TabulatedDriving((0.0, 1e-5, 3e-5, 6e-5), (0.0, 2e4, -5e4, 1e4))
EVERY = {"sine": SINE, "table": TABLE}


@for_each("driving", EVERY)
def test_that_both_derivatives_are_those_of_the_pressure(driving):
    """By autograd, so that gradients through a solve that knows only the pressure are right too."""
    time = linspace(1e-7, 5.9e-5, 97, requires_grad=True)
    assert_that_rates_are_derivatives(driving(time), time, (1e-6, 1e-1))


def test_that_a_table_is_met_at_its_samples_and_held_beyond_them():
    driving = TABLE
    knots = torch.tensor(driving.times, dtype=torch.float64)
    assert driving(knots)[0].tolist() == pytest.approx(driving.pressures, abs=1e-9)
    value, rate, bend = driving(tensor(-1e-5, -1.0, 6.1e-5, 1.0).reshape(2, 2))
    assert value.tolist() == [[0.0, 0.0], [pytest.approx(1e4)] * 2]
    assert rate.abs().sum() + bend.abs().sum() == 0.0
    # the spline joins the constants without a kink
    near = driving(tensor(1e-12, 6e-5 - 1e-12))[1]
    assert near.abs().max() < 1e-5 * 1e9


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


GAUSS = np.polynomial.legendre.leggauss(12)


def driven_reference(
    driving: TabulatedDriving,
    motion: RadialEquation,
    weber: float,
    rest: float,
    mu: float,
    times: np.ndarray,
) -> np.ndarray:
    """A polytropic bubble in SI by SciPy, each equation as its paper has it, the pressure and its rate
    written out.
    """
    s = Surroundings()
    key = motion.key
    kappa = 1.3
    p_inf = s.far_field_pressure
    rho = s.density
    c0 = s.sound_speed
    water = Water(motion.liquid.key, p_inf, rho, c0)
    r_max = s.max_radius(weber)
    unit = s.time_scale(r_max)
    vapour = 1.17e11 * math.exp(-5200.0 / s.temperature)
    p_rest = p_inf + 2.0 * s.surface_tension / (rest * r_max) - vapour

    def rate(t: float, y: np.ndarray) -> list[float]:
        r, u = y
        gas = p_rest * rest**3 * (r_max / r) ** (3.0 * kappa)
        wall = gas + vapour - 2.0 * s.surface_tension / r - 4.0 * mu * u / r
        known = (
            -3.0 * kappa * gas + 2.0 * s.surface_tension / r
        ) * u / r + 4.0 * mu * u**2 / r**2
        push, push_rate, _ = (
            float(x) for x in driving(torch.tensor(t, dtype=torch.float64))
        )
        far = p_inf + push
        if key == "rayleigh_plesset":
            return [u, ((wall - far) / rho - 1.5 * u * u) / r]
        h = water.enthalpy(wall) - water.enthalpy(far)
        inertia = 1.0 / water.density(wall)
        known = known * inertia - push_rate / water.density(far)
        viscous = 4.0 * mu / r * inertia
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

    span = (0.0, float(times[-1]) * unit)
    result = solve_ivp(
        rate,
        span,
        [r_max, 0.0],
        method="DOP853",
        t_eval=times * unit,
        rtol=1e-9,
        atol=1e-15,
    )
    assert result.success
    return result.y[0] / r_max


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda x: f"{x.key}-{x.liquid.key}")
def test_that_a_driven_bubble_is_scipys_in_every_radial_equation(motion):
    times = grid(1.6, 33)
    expected = driven_reference(SINE, motion, 300.0, 0.25, 0.02, times.numpy())
    conditions = Conditions(motion=motion, driving=SINE)
    solution = PolytropicSimulator(conditions, FINE)(
        gel(mu=0.02), tensor(300.0, 0.25), times
    )
    assert_close(solution.radius, torch.tensor(expected), rtol=0.0, atol=2e-6)


def isothermal(**options) -> Conditions:
    """Gas that conducts so well that it is polytropic with exponent 1, in both simulators."""
    mixture = GasMixture(
        conductivity_slope=5.3e2, conductivity_offset=1.17e5, vapour="absent"
    )
    return Conditions(
        gas=PolytropicGas(1.0, vapour=False),
        mixture=mixture,
        medium=Medium(warm=False),
        **options,
    )


@pytest.mark.parametrize("key", RADIAL_EQUATIONS)
def test_that_both_simulators_are_driven_alike(key):
    conditions = isothermal(
        motion=RADIAL_EQUATIONS[key], driving=SINE, initial_velocity=-1.5
    )
    arguments = gel(G=4e3, mu=0.1), tensor(300.0, 0.5), grid(1.5, 16)
    polytropic = PolytropicSimulator(conditions, FINE)(*arguments)
    transport = TransportSimulator(conditions, Accuracy(3e-5, Resolution(8, 4)))(*arguments)
    assert transport.ok
    assert transport.velocity[0] == pytest.approx(-1.5 / Surroundings().velocity_scale)
    assert (transport.radius - polytropic.radius).abs().max() < 3e-4


PULSED = {
    "linkv": {"G_lin": 1e3},
    "nhkv": {"G": 1e3},
    "gen_qkv": {"G": 1e3, "alpha": 0.25},
    "zener": {"G": 1e3, "tau": 1e-7},
}
PULSED |= {"ucm": {"tau_ucm": 1e-7, "retardation": 0.1}}


@pytest.mark.parametrize("key", RADIAL_EQUATIONS)
def test_that_a_bubble_returns_to_rest_after_a_slow_pulse_of_tension(key):
    """A bubble of 10 um at rest in a very viscous gel, a tension of almost one atmosphere for .1 ms: 2000 units of time,
    which only the implicit solver strides over.
    """
    pulse = sampled(lambda t: -1e5 * np.exp(-(((t - 3e-4) / 1e-4) ** 2)), 2.1e-3)
    gels = torch.stack([gel(mu=0.5, **values) for values in PULSED.values()])
    outer = Surroundings(101325.0, 1064.0, 0.07, 298.15, 1484.0)
    times = linspace(0.0, 2e-3, 101) / outer.time_scale(10e-6)
    mixture = GasMixture(vapour="frozen")
    conditions = Conditions(
        outer,
        PolytropicGas(1.4, "rest"),
        mixture,
        Medium(warm=False),
        RADIAL_EQUATIONS[key],
        driving=pulse,
    )
    simulator = TransportSimulator(conditions, Accuracy(3e-4, Resolution(6, 4)))
    radius = simulator(gels, tensor(outer.weber(10e-6), 1.0 - 1e-9), times).radius
    assert (radius[:, -1] - 1.0).abs().max() < 1e-2
    assert (radius.amax(1) > 1.02).all()  # it did swell


test_that_bad_options_are_named = refusals(
    (
        lambda: TabulatedDriving((0.0, 1.0), (0.0, 1.0)),
        r"2 times and 2 pressures; expected as many of each, at least three",
    ),
    (
        lambda: TabulatedDriving((0.0, 1.0, 1.0), (0.0, 1.0, 2.0)),
        r"times must increase; sort them and drop repeated ones",
    ),
    (
        lambda: Conditions(motion="gilmore"),
        r"Conditions.motion is 'gilmore'; expected a RadialEquation",
    ),
)
