"""Departures from the base physics: each nothing at its neutral value, something beyond it, and
that what its name says.
"""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor
from torch.testing import assert_close

from imr_torch.material import PARAMETERS, PARTS
from imr_torch.simulate import (
    Accuracy,
    Conditions,
    GasMixture,
    Medium,
    PolytropicGas,
    PolytropicSimulator,
    RayleighPlesset,
    Resolution,
    TabulatedDriving,
    TransportSimulator,
)
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.contents import conductivity_of, temperature_of, warm_profile
from imr_torch.units import Surroundings
from tests.simulate.bubble import (
    FINE,
    SI,
    gel,
    grid,
    largest_difference,
    sampled,
    sine,
    tensor,
)
from tests.tables import for_each

BASE = {"G": 4e3, "mu": 0.08}
DESIGN = tensor(300.0, 0.3)
TIMES = grid(1.5, 31)
BEYOND = {
    "sound_speed": 0.5,
    "compressibility": 1.0,
    "density": 0.1,
    "medium_tension": 0.5,
    "medium_pressure": 0.05,
    "medium_temperature": 0.02,
    "surface_tension": 1.0,
    "heat_exchange": 0.7,
    "vapour_pressure": 0.05,
    "far_field_pressure": 0.1,
    "wall": 0.1,
    "residual_velocity": 0.1,
    "condensation": 0.5,
    "gas_loss": 0.5,
    "energy_loss": 0.5,
    "size_drag": 1e7,
    "sound_field": 0.2,
    "sound_frequency": 1.0,
    "sound_phase": 1.0,
    "pulse": 0.3,
    "pulse_time": 0.7,
    "pulse_width": -1.0,
    "excess_gas": 0.4,
    "hot_contents": 0.4,
    "rinf_drift": 5e3,
    "damage": 0.5,
    "healing": 5e4,
    "viscous_damage": 0.5,
    "yield_stress": 1e3,
    "graded_modulus": 2.0,
    "permanent_set": 0.1,
    "law_stretch": 0.05,
    "law_stretch_squared": 0.02,
    "law_compression": 0.05,
    "law_compression_steep": 1e-4,
    "law_velocity": 0.05,
    "law_velocity_squared": 0.02,
    "law_rate_squared": 1e-3,
}
"""A value of each effect at which it can be seen."""
BESIDE = {
    "sound_frequency": {"sound_field": 0.2},
    "sound_phase": {"sound_field": 0.2},
    "pulse_time": {"pulse": 0.3},
    "pulse_width": {"pulse": 0.3},
    "shear_time": {"thinning": 0.4},
    "thinning": {"shear_time": 2e-6},
    "retardation": {"tau": 5e-6},
    "healing": {"damage": 0.5},
}
"""What has to be there for some to act."""


CAMERA = {
    "missed_maximum",
    "trigger_offset",
    "rinf_bias",
    "clock",
    "exposure_blur",
    "refraction",
    "edge_error",
}
"""What a bubble does not feel."""
OF_PARTS = {name for part in PARTS.values() for term in part.terms for name in term.names}
OF_PARTS -= {*SI, *BEYOND}
"""What composed laws alone read: tests/material/test_parts.py has tests of their own."""
NAMES = [name for name in PARAMETERS.names if name not in OF_PARTS]
SEEN_BY_THE_BUBBLE = [name for name in NAMES if name not in CAMERA]


def simulators(
    conditions: Conditions | None = None,
) -> dict[str, PolytropicSimulator | TransportSimulator]:
    conditions = conditions or Conditions()
    return {
        "polytropic": PolytropicSimulator(conditions),
        "transport": TransportSimulator(conditions, Accuracy(3e-4, Resolution(6, 6))),
    }


BOTH = pytest.mark.parametrize("kind", ["polytropic", "transport"])


def radii(kind: str, conditions: Conditions | None = None, **values: float) -> Tensor:
    return simulators(conditions)[kind](gel(**BASE | values), DESIGN, TIMES).radius


def test_that_every_effect_has_a_value_to_be_seen_at():
    assert set(BEYOND) | set(SI) == set(SEEN_BY_THE_BUBBLE)


def bases_and_neighbours(*, acting: bool) -> Tensor:
    """For every parameter a bubble that has what it needs, and beside it one where it acts (or another without)."""
    rows = []
    for name in NAMES:
        base = BASE | BESIDE.get(name, {})
        value = (
            BASE[name] * 1.5
            if name in BASE
            else {**SI, **BEYOND}.get(name, min(0.05, PARAMETERS[name].upper))
        )
        rows += [gel(**base), gel(**base | {name: value}) if acting else gel(**base)]
    return torch.stack(rows)


@pytest.fixture(scope="module")
def solutions():
    """Of either simulator: a batch in which nothing acts in any member, and one in which everything
    does in some.
    """
    return {
        kind: [
            simulator(bases_and_neighbours(acting=acting), DESIGN, TIMES)
            for acting in (False, True)
        ]
        for kind, simulator in simulators().items()
    }


@BOTH
def test_that_at_neutral_it_does_nothing_bit_for_bit_even_beside_bubbles_where_it_acts(
    solutions, kind
):
    without, among = solutions[kind]
    for entry in ("radius", "velocity", "bubble_pressure"):
        assert torch.equal(getattr(without, entry)[::2], getattr(among, entry)[::2])


@BOTH
@pytest.mark.parametrize("name", NAMES)
def test_that_beyond_it_does_something_unless_it_is_the_cameras(solutions, kind, name):
    solution = solutions[kind][1]
    row = 2 * NAMES.index(name)
    assert solution.ok[row : row + 2].all()
    change = float((solution.radius[row] - solution.radius[row + 1]).abs().max())
    assert (change == 0.0) if name in CAMERA else (change > 1e-4)


# ---------------------------------------------------------------- each is what its name says


ATMOSPHERE = Surroundings().far_field_pressure
SECOND = float(Surroundings().time_scale(Surroundings().max_radius(DESIGN[0])))
PULSE_WIDTH = math.exp(-1.5) * SECOND
AS_CONDITIONS = {
    "sound speed": (
        {"sound_speed": -1.2},
        Conditions(Surroundings(sound_speed=1430.0 * math.exp(-1.2))),
    ),
    "a constant drive": (
        {"far_field_pressure": 0.1},
        Conditions(driving=TabulatedDriving((0.0, 1e-3, 2e-3), (0.1 * ATMOSPHERE,) * 3)),
    ),
    "initial velocity": (
        {"residual_velocity": 0.1},
        Conditions(initial_velocity=0.1 * Surroundings().velocity_scale),
    ),
    "a sine": (
        {"sound_field": 0.2, "sound_frequency": 1.3, "sound_phase": 0.6},
        Conditions(
            driving=sine(0.2 * ATMOSPHERE, math.exp(1.3) / (2.0 * math.pi * SECOND), 0.6)
        ),
    ),
    "a Gaussian pulse": (
        {"pulse": 0.5, "pulse_time": 0.6, "pulse_width": -1.5},
        Conditions(
            driving=sampled(
                lambda t: (
                    0.5 * ATMOSPHERE * np.exp(-(((t - 0.6 * SECOND) / PULSE_WIDTH) ** 2))
                )
            )
        ),
    ),
}


@BOTH
@for_each(("effect", "conditions"), AS_CONDITIONS)
def test_that_an_effect_is_that_of_the_conditions_that_it_stands_for(
    kind, effect, conditions
):
    error = 1e-12 if conditions.initial_velocity else 1e-9
    assert largest_difference(radii(kind, **effect), radii(kind, conditions)) < error


def test_that_vapour_pressure_is_that_of_a_warmer_liquid():
    """Where temperature enters by the vapour alone: with polytropic gas."""
    warm = Conditions(Surroundings(temperature=310.0))
    excess = warm.saturation - Conditions().saturation
    assert (
        radii("polytropic", vapour_pressure=excess) - radii("polytropic", warm)
    ).abs().max() < 1e-12


def test_that_surface_tension_acts_in_its_own_term_and_not_in_the_gas():
    """Against SciPy: the gas was shut in under the tension of the design."""
    weber = 20.0
    rest = 0.4
    factor = 0.8
    gas = (1.0 + 1.0 / (weber * rest)) * rest**3

    def rate(t: float, y: np.ndarray) -> list[float]:
        r, u = y
        return [u, (gas * r**-4.2 - math.exp(factor) / (weber * r) - 1.0 - 1.5 * u * u) / r]

    times = grid(1.5, 16)
    exact = solve_ivp(
        rate,
        (0.0, 1.5),
        [1.0, 0.0],
        t_eval=times.numpy(),
        rtol=1e-11,
        atol=1e-13,
        method="DOP853",
    ).y[0]
    conditions = Conditions(gas=PolytropicGas(1.4, vapour=False), motion=RayleighPlesset())
    solution = PolytropicSimulator(conditions, FINE)(
        gel(surface_tension=factor), tensor(weber, rest), times
    )
    assert_close(solution.radius, torch.tensor(exact), rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("factor", "exponent"), [(6.0, 1.0), (-6.0, 1.4)], ids=["isothermal", "adiabatic"]
)
def test_that_heat_exchange_leads_from_adiabatic_to_isothermal(factor, exponent):
    """Of dry air in a cold gel, with conduction; and of the polytropic exponent itself."""
    limit = Conditions(
        gas=PolytropicGas(exponent, vapour=False),
        mixture=GasMixture(vapour="absent"),
        medium=Medium(warm=False),
    )
    expected = PolytropicSimulator(limit)(gel(**BASE), tensor(300.0, 0.7), TIMES).radius
    steps = torch.stack([gel(**BASE, heat_exchange=f) for f in (0.0, 0.5 * factor, factor)])
    radius = TransportSimulator(limit, Accuracy(1e-4, Resolution(24, 4)))(
        steps, tensor(300.0, 0.7), TIMES
    ).radius
    errors = (radius - expected).abs().amax(1).tolist()
    assert errors[0] > 2.0 * errors[1] > 4.0 * errors[2]
    assert errors[2] < 5e-3
    exponents = Bubbles.of(steps, DESIGN.expand(3, 2), Conditions()).numbers.exponent
    assert exponents[0] == 1.3
    assert exponents[2] == pytest.approx(exponent, abs=4e-3)
    assert (exponents.diff() * (exponent - 1.3) > 0.0).all()


def swing_about_rest(**effect: float) -> tuple[Tensor, float, Conditions]:
    """A small swing, 1 at first, at We 500; its stiffness without the effect, and the conditions."""
    rest = 1.0 - 1e-4
    stiffness = 3.0 * 1.4 * (1.0 + 1.0 / (500.0 * rest)) - 1.0 / (500.0 * rest)
    conditions = Conditions(
        gas=PolytropicGas(1.4, "rest", vapour=False), motion=RayleighPlesset()
    )
    radius = PolytropicSimulator(conditions, FINE)(
        gel(**effect), tensor(500.0, rest), grid(6.0)
    ).radius
    return (radius - rest) / (1.0 - rest), stiffness, conditions


def test_that_a_drag_that_grows_with_size_damps_by_half_its_strength():
    """About rest ``x'' + k Rmax U_c/p_inf x' + omega^2 x = 0``, so the damping is half of that."""
    drag = 1e7
    found, stiffness, conditions = swing_about_rest(size_drag=drag)
    around = conditions.surroundings
    size = float(around.max_radius(tensor(500.0)))
    speed = math.sqrt(around.far_field_pressure / around.density)
    damping = 0.5 * drag * size * speed / around.far_field_pressure
    omega = math.sqrt(stiffness - damping**2)
    swing = torch.cos(omega * grid(6.0)) + damping / omega * torch.sin(omega * grid(6.0))
    assert_close(found, torch.exp(-damping * grid(6.0)) * swing, rtol=0.0, atol=2e-3)


@pytest.mark.parametrize("strength", [-0.2, 0.3])
def test_that_a_mirror_bubble_adds_to_the_mass_that_moves(strength):
    """The pressure of the mirror image at the wall is ``b d(R^2 U)/dt``:

    ``omega^2`` falls to ``omega^2/(1 + b)``.
    """
    found, stiffness, _ = swing_about_rest(wall=strength)
    omega = math.sqrt(stiffness / (1.0 + strength))
    assert_close(found, torch.cos(omega * grid(6.0)), rtol=0.0, atol=2e-3)


def test_that_fully_trapped_vapour_is_a_gas():
    conditions = Conditions(gas=PolytropicGas(1.3))
    solution = PolytropicSimulator(conditions)(gel(**BASE, condensation=1.0), DESIGN, TIMES)
    assert_close(
        solution.bubble_pressure,
        solution.bubble_pressure[0] * solution.radius**-3.9,
        rtol=1e-9,
        atol=0.0,
    )


def test_that_gas_is_lost_along_the_path_below_rest():
    """``n_end/n = exp(-eta int |dR|/R (1 - R/R_inf)^2)`` down and up, whatever the speed."""
    conditions = Conditions(gas=PolytropicGas(1.4, vapour=False))
    eta = 0.4
    times = grid(1.5, 6001)
    solution = PolytropicSimulator(conditions, FINE)(
        gel(**BASE, gas_loss=eta), DESIGN, times
    )
    amount = solution.bubble_pressure * solution.radius**4.2
    depth = 0.3 / float(solution.radius.min())
    path = math.log(depth) - 2.0 * (1.0 - 1.0 / depth) + 0.5 * (1.0 - 1.0 / depth**2)
    expected = math.exp(-2.0 * eta * path)
    assert depth > 2.0
    assert amount[-1] / amount[0] == pytest.approx(expected, rel=2e-3)
    assert (amount.diff() < 1e-9).all()


@pytest.mark.parametrize("excess", [-0.5, 0.4])
def test_that_excess_gas_comes_to_rest_where_its_pressure_balances(excess):
    """Isothermal gas in a viscous liquid:

    ``(p_0 - p_v) e^x (R_inf/R)^3 + p_v = 1 + 1/(We R)`` at rest.
    """
    weber = 20.0
    rest = 0.4
    conditions = Conditions(gas=PolytropicGas(1.0, vapour=False))
    radius = PolytropicSimulator(conditions)(
        gel(mu=0.1, excess_gas=excess), tensor(weber, rest), grid(40.0, 3)
    ).radius[-1]
    amount = (1.0 + 1.0 / (weber * rest)) * rest**3 * math.exp(excess)
    assert amount / radius**3 - 1.0 - 1.0 / (weber * radius) == pytest.approx(0.0, abs=1e-5)
    assert abs(radius - rest) > 0.05


def test_that_hot_contents_press_by_their_mean_temperature_and_come_to_rest_at_r_inf_as_cold_ones_do():
    gels = torch.stack([gel(mu=1.0, hot_contents=x) for x in (0.0, 0.4, -0.2)])
    conditions = Conditions(mixture=GasMixture(vapour="absent"))
    solution = TransportSimulator(conditions, Accuracy(3e-4, Resolution(12, 12)))(
        gels, tensor(300.0, 0.3), grid(20.0, 201)
    )
    start = solution.bubble_pressure[:, 0] / solution.bubble_pressure[0, 0]
    assert_close(start, tensor(1.0, 1.4, 0.8), rtol=1e-12, atol=0.0)
    assert largest_difference(solution.radius[1:], solution.radius[0]) > 1e-3
    assert_close(solution.radius[:, -1], tensor(0.3, 0.3, 0.3), rtol=0.0, atol=5e-4)


@pytest.mark.parametrize("warmth", [-0.3, 0.2, 0.6])
def test_that_the_profile_of_hot_contents_has_its_mean_temperature(warmth):
    """By quadrature of ``1/T`` over the volume;

    ``T`` is 1 at the wall, and ``tau`` that of the contents' law.
    """
    constants = Bubbles.of(gel(**BASE)[None], DESIGN[None], Conditions()).constants
    nodes, weights = (torch.as_tensor(x) for x in np.polynomial.legendre.leggauss(40))
    y = 0.5 * (1.0 + nodes)
    tau = warm_profile(y, torch.tensor(warmth, dtype=torch.float64), constants)
    temperature = temperature_of(conductivity_of(tau, constants), constants)
    assert (1.5 * weights * y * y / temperature).sum() == pytest.approx(
        1.0 / (1.0 + warmth), rel=1e-10
    )
    assert warm_profile(torch.tensor(1.0), torch.tensor(warmth), constants) == 0.0


def test_that_a_drift_of_r_inf_is_exponential_in_time_and_the_same_for_bubbles_of_any_size():
    """``n = n_0 exp(3 d t)`` in seconds, whatever the bubble does."""
    conditions = Conditions(gas=PolytropicGas(1.4, vapour=False))
    drift = -2e3
    designs = torch.stack((tensor(100.0, 0.3), tensor(900.0, 0.3)))
    solution = PolytropicSimulator(conditions, FINE)(
        gel(**BASE, rinf_drift=drift), designs, grid(1.5, 7)
    )
    amount = solution.bubble_pressure * solution.radius**4.2
    outer = conditions.surroundings
    seconds = grid(1.5, 7) * outer.time_scale(outer.max_radius(designs[:, :1]))
    assert_close(
        amount / amount[:, :1], torch.exp(3.0 * drift * seconds), rtol=1e-4, atol=0.0
    )


@BOTH
def test_that_energy_lost_lowers_every_rebound_and_leaves_the_fall_to_rest_nearly_alone(
    kind,
):
    gels = torch.stack([gel(**BASE, energy_loss=x) for x in (0.0, 0.3, 1.0)])
    radius = simulators()[kind](gels, DESIGN, grid(1.8, 181)).radius
    assert (radius[:, 110:].amax(1).diff() < -0.01).all()
    assert largest_difference(radius[:, :80], radius[:1, :80]) < 0.02
