"""Closures and materials together: rest, small oscillations of gels with memory, limits of
relaxation, energy.
"""

import numpy as np
import pytest
import torch
from scipy.integrate import simpson
from scipy.linalg import expm
from torchdiffeq import odeint

from imr_torch.float64 import arange
from imr_torch.simulate import (
    RADIAL_EQUATIONS,
    Accuracy,
    Conditions,
    GasMixture,
    KellerMiksis,
    Medium,
    PolytropicGas,
    PolytropicSimulator,
    RayleighPlesset,
    Resolution,
    TransportSimulator,
)
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.ode_method import ACCEPTED, CONTROL, TransportField
from imr_torch.simulate.rhs import Equations
from imr_torch.units import Surroundings
from tests.simulate.bubble import EVERY_GEL, FINE, gel, grid, largest_difference, tensor
from tests.tables import for_each

VAPOUR = ("transported", "constant", "frozen", "absent")


def closure(
    vapour: str, warm: bool, motion=RADIAL_EQUATIONS["keller_miksis"]
) -> Conditions:
    gas = PolytropicGas(1.3, "rest", vapour != "absent")
    return Conditions(
        gas=gas, mixture=GasMixture(vapour=vapour), medium=Medium(warm=warm), motion=motion
    )  # type: ignore[arg-type]


RELEASED = {  # one batch of all models, with each closure another radial equation
    f"{vapour}, {'warm' if warm else 'cold'}": TransportSimulator(
        closure(vapour, warm, motion), Accuracy(1e-4, Resolution(6, 6))
    )
    for vapour, motion in zip(VAPOUR, RADIAL_EQUATIONS.values(), strict=False)
    for warm in (True, False)
}
RELEASED |= {
    f"polytropic, {key}": PolytropicSimulator(closure("absent", False, motion))
    for key, motion in RADIAL_EQUATIONS.items()
}


@for_each("simulator", RELEASED)
def test_that_every_gel_released_at_rest_stays_put(simulator):
    solution = simulator(EVERY_GEL, tensor(300.0, 1.0 - 1e-12), grid(4.0, 9))
    error = 1e-10 if isinstance(simulator, PolytropicSimulator) else 1e-9
    assert solution.ok.all()
    assert largest_difference(solution.radius, 1.0) < error
    assert solution.velocity.abs().max() < 1e-9


# ---------------------------------------------------------------- small oscillations with memory

LINEAR = {
    "maxwell": {"mu": 0.3, "tau": 2e-5},
    "zener": {"mu": 0.3, "tau": 2e-5, "retardation": 0.3, "G": 1e4},
    "ucm": {"mu": 0.3, "tau_ucm": 1e-5, "retardation": 0.2},
    "sls": {"mu": 0.2, "tau_sls": 3e-5, "G_lin": 2e4},
    "sns": {"mu": 0.2, "tau_sns": 3e-5, "G": 2e4},
}


def linear_gel(
    key: str, values: dict[str, float], unit: float, rest: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Rows of the linear gel in ``(x, x', m)``:

    ``S`` without its part in ``x'``, ``m'``, and the friction at once.
    """
    s = Surroundings()
    g = (values.get("G", 0.0) + values.get("G_lin", 0.0)) / s.far_field_pressure
    mu = values["mu"] / (s.far_field_pressure * unit)
    de = next(v for k, v in values.items() if k.startswith("tau")) / unit
    share = values.get("retardation", 0.0)
    if key in ("sls", "sns"):  # the state is the whole stress
        return (
            np.array([0.0, 0.0, 1.0]),
            np.array([-4.0 * g, -4.0 * mu - 4.0 * g * de, -rest * 1.0]) / (rest * de),
            0.0,
        )
    rate = np.array([0.0, -4.0 * mu * (1.0 - share) / rest, -1.0]) / de
    return np.array([-4.0 * g / rest, 0.0, 1.0]), rate, 4.0 * mu * share / rest


@pytest.mark.parametrize("key", LINEAR)
@pytest.mark.parametrize("sound", [1e9, 150.0], ids=["incompressible", "compressible"])
def test_that_a_gel_with_memory_has_its_third_order_small_oscillation(key, sound):
    """``R_e x'' = (1 + (R_e/c) d/dt)(-k x + S)`` beside one relaxing state: a cubic characteristic equation, solved as the
    exponential of its companion matrix.
    """
    values = LINEAR[key]
    rest = 1.0 - 1e-4
    weber = 300.0
    outer = Surroundings(sound_speed=sound)
    unit = outer.time_scale(outer.max_radius(weber))
    gas = 1.0 + 1.0 / (weber * rest)
    k = (3.0 * 1.3 * gas - 1.0 / (weber * rest)) / rest
    stress, rate, friction = linear_gel(key, values, unit, rest)
    delay = rest * outer.velocity_scale / sound
    pull = stress + np.array([-k, 0.0, 0.0])
    force = (
        pull
        + np.array([0.0, -friction, 0.0])
        + delay * (pull[0] * np.array([0.0, 1.0, 0.0]) + pull[2] * rate)
    )
    matrix = np.stack([np.array([0.0, 1.0, 0.0]), force / (rest + delay * friction), rate])
    start = np.array([1.0, 0.0, 0.0])
    if key in ("sls", "sns"):
        # relaxed at the maximum
        start[2] = (
            -4.0
            * values.get("G", values.get("G_lin", 0.0))
            / outer.far_field_pressure
            / rest
        )
    t = grid(6.0, 61)
    x = torch.tensor([(expm(matrix * float(s)) @ start)[0] for s in t])
    assert np.iscomplex(np.linalg.eigvals(matrix)).any()
    conditions = Conditions(
        outer, PolytropicGas(1.3, "rest", vapour=False), motion=KellerMiksis()
    )
    radius = PolytropicSimulator(conditions, FINE)(
        gel(**values), tensor(weber, rest), t
    ).radius
    torch.testing.assert_close((radius - rest) / (1.0 - rest), x, rtol=0.0, atol=2e-3)


# ---------------------------------------------------------------- limits of relaxation

COLD = closure("absent", False)
EXACT = TransportSimulator(COLD, Accuracy(1e-6, Resolution(6, 4)))
MILD = tensor(300.0, 0.4)


def radii(*gels: dict[str, float]) -> torch.Tensor:
    return EXACT(torch.stack([gel(**g) for g in gels]), MILD, grid(1.3, 27)).radius


@pytest.mark.parametrize("name", ["tau", "tau_ucm", "tau_sns", "tau_sls"])
def test_that_fast_relaxation_is_no_memory_to_first_order_in_its_time(name):
    """Zener, upper-convected Maxwell and both standard solids against the same gel without memory."""
    base = {"mu": 0.08} | (
        {"G_lin": 6e3} if name == "tau_sls" else {} if name == "tau_ucm" else {"G": 6e3}
    )
    curves = radii(base, *(base | {name: t} for t in (1.2e-7, 6e-8, 3e-8)))
    errors = [largest_difference(curve, curves[0]) for curve in curves[1:]]
    assert errors[0] < 0.03
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.15)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.1)


def test_that_slow_relaxation_leaves_the_spring_alone():
    """A Maxwell branch that never relaxes carries ``1/De`` of its viscosity:

    Zener becomes neo-Hookean.
    """
    elastic = {"G": 6e3}
    curves = radii(elastic, *(elastic | {"mu": 0.08, "tau": t} for t in (0.05, 0.1)))
    errors = [largest_difference(curve, curves[0]) for curve in curves[1:]]
    assert errors[1] < 5e-3
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


def test_that_full_retardation_is_no_memory():
    base = {"G": 6e3, "mu": 0.08}
    curves = radii(
        base,
        base | {"tau": 1e-5, "retardation": 1.0},
        base | {"tau_ucm": 1e-5, "retardation": 1.0},
    )
    assert largest_difference(curves, curves[0]) < 1e-5


# ---------------------------------------------------------------- energy


@pytest.mark.parametrize("vapour", ["absent", "constant"])
def test_that_energy_is_kept_when_the_heat_that_leaves_is_counted(vapour):
    """Of liquid, far field, surface, elastic gel and gas, ``p R^3/(3(k-1))``; heat leaves at ``chi
    tau'(1) R``.
    """
    conditions = Conditions(
        mixture=GasMixture(vapour=vapour),
        medium=Medium(warm=False),
        motion=RayleighPlesset(),
    )  # type: ignore[arg-type]
    parameters = gel(G=5e3)[None]
    designs = tensor(300.0, 0.45)[None]
    equations = Equations(
        Bubbles.of(parameters, designs, conditions), *Resolution(12, 4).grids()
    )
    field = TransportField(equations, tolerance=1e-6)
    ticks = arange(301)
    path = odeint(field, field.start(), ticks, method="euler")[:, :, 0]
    times = path[:, -CONTROL]
    accepted = path[:, -1] == ACCEPTED
    states = path[accepted & (times <= 2.0), :-CONTROL]
    times = times[accepted & (times <= 2.0)]
    assert 1.9 < times[-1] < path[-1, -CONTROL]
    fields = field.equations.fields(states.T, times).point
    b, l = field.equations.bubbles, fields.radius / 0.45  # noqa: E741
    vapour_work = float(b.numbers.constant_vapour) * fields.radius**3 / 3.0
    stored = fields.pressure * fields.radius**3 / (3.0 * 0.4) - vapour_work
    spring = (
        0.5
        * float(b.theta["G"])
        * 0.45**3
        * (5.0 / 3.0 * l**3 - 2.0 * l**2 + l**-1 - 2.0 / 3.0)
    )
    liquid = (
        0.5 * fields.radius**3 * fields.velocity**2
        + fields.radius**3 / 3.0
        + fields.radius**2 / 600.0
    )
    heat = float(b.numbers.chi) * fields.heat * fields.radius
    lost = -np.array(
        [
            simpson(heat[: i + 1].numpy(), x=times[: i + 1].numpy())
            for i in range(len(times))
        ]
    )
    total = (stored + spring + liquid).numpy() + lost
    assert np.abs(total - total[0]).max() < 2e-5
    assert lost.max() > 1e-3
    assert fields.velocity.abs().max() > 0.5
