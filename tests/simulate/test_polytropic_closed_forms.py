"""The polytropic simulator against closed forms: energy, Rayleigh's time, small oscillations, rest."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from torch.testing import assert_close

from imr_torch.simulate import Conditions, PolytropicGas, PolytropicSimulator
from imr_torch.units import Surroundings
from tests.simulate.bubble import FINE, gel, grid, tensor
from tests.tables import for_each


def empty_bubble(exponent: float) -> Conditions:
    """No sound, no vapour; with a huge Weber number no surface tension either: Rayleigh's bubble
    with a little gas.
    """
    return Conditions(Surroundings(sound_speed=1e15), PolytropicGas(exponent, vapour=False))


def energy_speed(radius: float, gas: float, kappa: float) -> float:
    """``|U|`` from ``d(R^3 U^2) = 2 R^2 (p - 1) dR`` with ``p = gas R^(-3 kappa)``, at rest at ``R = 1``."""
    power = 3.0 - 3.0 * kappa
    work = 2.0 / 3.0 * (1.0 - radius**3) - 2.0 * gas * (1.0 - radius**power) / power
    return math.sqrt(work / radius**3)


def test_that_an_empty_bubble_collapses_in_rayleighs_time():
    """.914681 (``sqrt(3/2) B(5/6, 1/2)/3``).

    Gas of 1e-9 p_inf turns the wall at R = 4e-5 Rmax, within 1e-9 of that time.
    """
    rayleigh = (
        math.sqrt(1.5) / 3.0 * math.gamma(5 / 6) * math.gamma(0.5) / math.gamma(4 / 3)
    )
    assert rayleigh == pytest.approx(0.914681, abs=1e-6)
    times = rayleigh + tensor(-1e-6, 1e-6)
    solution = PolytropicSimulator(empty_bubble(5.0 / 3.0), FINE)(
        gel(), tensor(1e12, 1e-3), times
    )
    assert solution.velocity[0] < -1e3
    assert solution.velocity[1] > 1e3


@pytest.mark.parametrize(
    ("rest", "kappa"), [(0.1, 1.4), (0.1, 5.0 / 3.0), (0.02, 1.3), (0.3, 1.4)]
)
def test_that_the_collapse_follows_from_the_energy_alone(rest, kappa):
    """Time and speed at radii on the way down, by quadrature of ``dR/|U|`` (substituting ``R = 1 - s^2``)."""
    gas = rest**3 * (1.0 + 1.0 / (1e12 * rest))
    radii = np.array([0.99, 0.9, 0.7, 0.5, 0.4])
    times = [
        quad(
            lambda s: 2.0 * s / energy_speed(1.0 - s * s, gas, kappa),
            1e-9,
            math.sqrt(1.0 - r),
            epsabs=1e-12,
            epsrel=1e-11,
        )[0]
        for r in radii
    ]
    solution = PolytropicSimulator(empty_bubble(kappa), FINE)(
        gel(), tensor(1e12, rest), tensor(*times)
    )
    assert_close(solution.radius, torch.tensor(radii), rtol=0.0, atol=2e-7)
    speed = tensor(*[-energy_speed(r, gas, kappa) for r in radii])
    assert_close(solution.velocity, speed, rtol=1e-6, atol=0.0)


def test_that_energy_is_kept_without_sound_and_viscosity_through_three_rebounds():
    kappa = 1.4
    rest = 0.2
    gas = rest**3 * (1.0 + 1.0 / (1e12 * rest))
    solution = PolytropicSimulator(empty_bubble(kappa), FINE)(
        gel(), tensor(1e12, rest), grid(6.0, 601)
    )
    power = 3.0 - 3.0 * kappa
    radius = solution.radius
    velocity = solution.velocity
    kinetic = 1.5 * radius**3 * velocity**2
    potential = radius**3 - 3.0 * gas * radius**power / power
    total = kinetic + potential
    assert (total / total[0] - 1.0).abs().max() < 1e-5
    assert kinetic.max() > 0.5


AT_REST = Conditions(gas=PolytropicGas(1.3, "rest"))
LINEAR = {
    "gas alone": (Conditions(gas=PolytropicGas(1.4, "rest", vapour=False)), {}, 50.0),
    "small bubble, surface tension": (
        Conditions(gas=PolytropicGas(1.0, "rest", vapour=False)),
        {},
        2.0,
    ),
    "vapour": (Conditions(gas=PolytropicGas(1.3, "rest", vapour=True)), {}, 500.0),
    "elastic": (AT_REST, {"G": 2e4}, 500.0),
    "elastic and viscous": (
        AT_REST,
        {"G": 2e4, "mu": 0.2},
        500.0,
    ),
    "stiffening does nothing at rest": (
        AT_REST,
        {"G": 2e4, "mu": 0.2, "alpha": 2.0},
        500.0,
    ),
    "slow sound": (
        Conditions(Surroundings(sound_speed=80.0), PolytropicGas(1.4, "rest")),
        {"G": 1e4, "mu": 0.1},
        500.0,
    ),
}


@for_each(("conditions", "values", "weber"), LINEAR)
def test_that_a_small_oscillation_has_the_linear_frequency_and_damping(
    conditions, values, weber
):
    """``R = R_e + x``: ``R_e (1 + b/c) x'' + (b + R_e k/c) x' + k x = 0`` with ``k = (3 kappa p_g - 1/(We R_e) + 4/Ca)/R_e``
    and ``b = 4/(Re R_e)``; the error is of the order of the amplitude, 1e-4.
    """
    s = conditions.surroundings
    rest = 1.0 - 1e-4
    time = s.time_scale(s.max_radius(weber))
    gas = 1.0 + 1.0 / (weber * rest) - conditions.saturation * conditions.gas.vapour
    c = s.sound_speed / s.velocity_scale
    cauchy = values.get("G", 0.0) / s.far_field_pressure
    k = (3.0 * conditions.gas.exponent * gas - 1.0 / (weber * rest) + 4.0 * cauchy) / rest
    b = 4.0 * values.get("mu", 0.0) / (s.far_field_pressure * time) / rest
    mass = rest * (1.0 + b / c)
    friction = b + rest * k / c
    decay = 0.5 * friction / mass
    omega = math.sqrt(k / mass - decay**2)
    t = grid(8.0, 161)
    x = torch.exp(-decay * t) * (
        torch.cos(omega * t) + decay / omega * torch.sin(omega * t)
    )
    solution = PolytropicSimulator(conditions, FINE)(gel(**values), tensor(weber, rest), t)
    assert_close((solution.radius - rest) / (1.0 - rest), x, rtol=0.0, atol=2e-3)
