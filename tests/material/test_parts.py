"""Parts that compose: each law against what it stands for, its limits, and every combination."""

import contextlib
import functools
import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad, solve_ivp

from imr_torch.errors import InputDataError
from imr_torch.float64 import arange, linspace, zeros
from imr_torch.material import (
    MATERIALS,
    PARAMETERS,
    PARTS,
    gel_response,
    material,
    wide_prior,
)
from imr_torch.simulate import (
    Accuracy,
    PolytropicSimulator,
    Resolution,
    Status,
    Stepping,
    TransportSimulator,
)
from tests.material.gels import (
    REST,
    STATES,
    VALUES,
    evaluate,
    memory_of,
    memory_start,
    tensors,
    values_of,
)
from tests.material.test_strain_energy import quadrature
from tests.refusals import refused
from tests.simulate.bubble import tensor

ELASTIC, VISCOUS, MEMORY = (
    ["", *(key for key, part in PARTS.items() if part.kind == kind)]
    for kind in ("elastic", "viscous", "memory")
)
EVERYWHERE = pytest.mark.parametrize(("radius", "velocity"), STATES)


def langevin_inverse(y: float) -> float:
    """By Newton's method on ``coth x - 1/x = y``."""
    x = 3.0 * y / (1.0 - y * y)
    for _ in range(50):
        x -= (1.0 / math.tanh(x) - 1.0 / x - y) / (1.0 / (x * x) - 1.0 / math.sinh(x) ** 2)
    return x


def principal(exponent: float):
    return lambda b: 2.0 / exponent**2 * (2.0 * b**exponent + b ** (-2.0 * exponent) - 3.0)


def chain_energy(inverse: float):
    """Eight-chain energy of unit modulus at small strain, with the exact inverse Langevin function."""
    number = 1.0 / inverse

    def energy(b: float) -> float:
        y = math.sqrt((2.0 * b * b + b**-4) / (3.0 * number))
        x = langevin_inverse(y)
        return number * (y * x + math.log(x / math.sinh(x)))

    at_rest = langevin_inverse(math.sqrt(inverse)) / (3.0 * math.sqrt(inverse))
    return lambda b: energy(b) / at_rest


def excess(b: float) -> float:
    return 2.0 * b * b + b**-4 - 3.0


ENERGIES = {
    "mooney_rivlin": lambda b: (
        0.5
        * (
            (1.0 - VALUES["mooney"]) * excess(b)
            + VALUES["mooney"] * (2.0 * b**-2 + b**4 - 3.0)
        )
    ),
    "yeoh": lambda b: (
        0.5 * excess(b)
        + VALUES["alpha"] / 4.0 * excess(b) ** 2
        + VALUES["cubic"] / 6.0 * excess(b) ** 3
    ),
    "gent": lambda b: -0.5 / VALUES["gent"] * math.log1p(-VALUES["gent"] * excess(b)),
    "arruda_boyce": chain_energy(VALUES["chain"]),
    "ogden": principal(2.0 + VALUES["ogden"]),
}
"""Energy of unit modulus at a hoop stretch."""


@pytest.mark.parametrize("key", ENERGIES)
@pytest.mark.parametrize("stretch", [0.3, 0.6, 0.95, 1.05, 2.0, 5.0])
def test_that_the_elastic_stress_is_the_integral_of_the_strain_energy(key, stretch):
    """``S = -int W'(b)/(b^3 - 1) db``, with ``W'`` by a central difference of a complex step's size."""
    energy = ENERGIES[key]

    def slope(b: float) -> float:
        h = 1e-4 * b
        return (
            8.0 * (energy(b + h) - energy(b - h)) - energy(b + 2 * h) + energy(b - 2 * h)
        ) / (12.0 * h)

    expected = -quad(lambda b: slope(b) / (b**3 - 1.0), 1.0, stretch, epsrel=1e-9)[0]
    found = float(evaluate(material(key), stretch * REST, 0.0, VALUES | {"G": 1.0}).value)
    assert found == pytest.approx(expected, rel=3e-3 if key == "arruda_boyce" else 1e-6)


def shear_thinned(key: str, shear: float) -> float:
    """Viscosity over ``mu`` at a shear rate."""
    v = VALUES | {"plateau": 0.0}
    power = (shear / v["reference_rate"]) ** -v["power_thinning"]
    return {
        "carreau_yasuda": (1.0 + (v["shear_time"] * shear) ** v["yasuda"])
        ** (-v["thinning_yasuda"] / v["yasuda"]),
        "cross": 1.0 / (1.0 + (v["cross_time"] * shear) ** v["cross_exponent"]),
        "powell_eyring": math.asinh(v["eyring_time"] * shear) / (v["eyring_time"] * shear),
        "power_law": power,
    }[key]


@pytest.mark.parametrize("key", ["carreau_yasuda", "cross", "powell_eyring", "power_law"])
@pytest.mark.parametrize("velocity", [-9.0, -0.5, 0.02, 3.0, 300.0])
@pytest.mark.parametrize("plateau", [0.0, 0.4])
def test_that_the_viscous_stress_is_the_integral_of_the_viscosity(key, velocity, plateau):
    radius = 0.4
    has_plateau = "plateau" in material(key).terms[-1].names
    share = plateau if has_plateau else 0.0

    def viscosity(shear: float, values: dict[str, float]) -> float:
        shear = max(shear, 1e-30)
        return values["mu"] * (share + (1.0 - share) * shear_thinned(key, shear))

    model = material(key)
    mu = {"mu": VALUES["mu"]}
    expected = quadrature(radius, velocity, mu, viscosity=viscosity)
    gel = VALUES | {"plateau": plateau, "G": 0.0}
    found = float(evaluate(model, radius, velocity, gel).value)
    # |U| of the power law is rounded off at .02
    tolerance = 0.3 if key == "power_law" and abs(velocity) < 0.1 else 1e-3 / velocity**2
    assert found == pytest.approx(expected, rel=max(1e-7, tolerance * (key == "power_law")))


@EVERYWHERE
@pytest.mark.parametrize(
    ("key", "neutral", "plain"),
    [
        ("mooney_rivlin", "mooney", "nhe"),
        ("yeoh", "cubic", "quadratic"),
        ("gent", "gent", "nhe"),
        ("arruda_boyce", "chain", "nhe"),
        ("ogden", "ogden", "nhe"),
        ("carreau_yasuda", "thinning_yasuda", "newtonian"),
        ("cross", "cross_time", "newtonian"),
        ("powell_eyring", "eyring_time", "newtonian"),
        ("power_law", "power_thinning", "newtonian"),
        ("bingham", "yield_stress", "newtonian"),
        ("nhkv+springpot", "G_frac", "nhkv"),
        ("nhkv+two_maxwell", "G_arm_slow", "nhkv+maxwell"),
        ("nhkv+maxwell", "G_arm", "nhkv"),
    ],
)
def test_that_a_part_at_its_neutral_parameter_does_nothing_exactly(
    key, neutral, plain, radius, velocity
):
    model, limit = material(key), material(plain)
    values = VALUES | {neutral: 0.0}
    rest = tensor(REST)
    memory = memory_start(model, rest, tensors(values))[:, 0]
    of_limit = memory_start(limit, rest, tensors(values))[:, 0]
    one = evaluate(model, radius, velocity, values, memory)
    other = evaluate(limit, radius, velocity, values, of_limit)
    for name in ("value", "rate", "acceleration"):
        assert getattr(one, name) == getattr(other, name)


def test_that_an_arm_beside_a_dashpot_is_the_jeffreys_branch():
    """``G_arm = (1 - s) mu/tau`` beside ``s mu``."""
    mu, tau, s = 0.05, 0.4, 0.3
    arm = {"mu": s * mu, "G_arm": (1.0 - s) * mu / tau, "tau_arm": tau, "G": 0.08}
    zener = {"mu": mu, "tau": tau, "retardation": s, "G": 0.08}
    memory = tensor(-0.02)
    for radius, velocity in STATES:
        one = evaluate(material("nhkv+maxwell"), radius, velocity, arm, memory)
        other = evaluate(material("zener"), radius, velocity, zener, memory)
        for name in ("value", "rate"):
            assert getattr(one, name) == pytest.approx(
                float(getattr(other, name)), rel=1e-13, abs=1e-14
            )


@pytest.mark.parametrize("order", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_that_the_springpot_has_the_complex_modulus_of_a_power(order):
    """Small oscillations of the volume at rest: ``S = -4 G* strain`` within 2 % over three decades."""
    term = material("springpot").terms[0]
    theta = tensors({"G_frac": 1.0, "fractional": order, "reference_rate": 1.0})
    one = tensor(1.0)[0]
    zero = 0.0 * one

    def linear(radius, velocity, memory):
        return torch.stack(term.evaluate_law(radius, velocity, one, theta, memory))

    none = zeros(term.states)
    by_radius, by_velocity = torch.autograd.functional.jacobian(linear, (one, zero, none))[
        :2
    ]
    by_memory = torch.autograd.functional.jacobian(linear, (one, zero, none))[2].numpy()
    for frequency in np.geomspace(0.1, 300.0, 15):
        s = 1j * frequency
        drive = by_radius[3:].numpy() + s * by_velocity[3:].numpy()
        memory = np.linalg.solve(s * np.eye(term.states) - by_memory[3:], drive)
        modulus = -(by_radius[0] + s * by_velocity[0] + by_memory[0] @ memory) / 4.0
        assert abs(complex(modulus) / s**order - 1.0) < 0.02


def combinations():
    for names in itertools.product(ELASTIC, VISCOUS, MEMORY):
        if any(names):
            yield "+".join(name for name in names if name)


def test_that_every_combination_is_built_or_refused_with_a_reason():
    """Its parameters have priors, and its stress is finite and zero where all parameters are neutral."""
    built, refused = [], []
    point = [tensor(x)[0] for x in (0.4, -1.0, REST)]
    for key in combinations():
        names = [name for name in key.split("+") if name in PARTS]
        with contextlib.suppress(InputDataError):
            model = None
            model = material(key)
        if model is None:
            refused.append(key)
            continue
        built.append(key)
        if key not in MATERIALS:
            assert set(model.terms) == {t for name in names for t in PARTS[name].terms} or (
                names[0] in MATERIALS
            )
            assert wide_prior([key])[key].names == model.free
        assert material(model.base) == model
        theta = tensors(values_of(model) | {"reference_rate": 2.0})
        stress, rates = gel_response(model.terms, *point, theta, memory_of(model.terms))
        assert math.isfinite(float(stress.value))
        assert torch.isfinite(rates).all()
        still = 0.0 * memory_of(model.terms)
        assert gel_response(model.terms, *point, tensors({}), still)[0].value == 0.0
    assert len(built) > 300
    assert all(
        key.split("+")[-1] in ("sls", "sns", "ucm", "jeffreys", "giesekus", "ptt")
        for key in refused
    )


OMEGA = 3.0


def oscillate(t):
    """Radius and velocity of an oscillation about ``R_inf``."""
    t = torch.as_tensor(t, dtype=torch.float64)
    radius = REST * (1.0 + 0.6 * torch.sin(OMEGA * t))
    return radius, 0.6 * REST * OMEGA * torch.cos(OMEGA * t)


def work_of_a_period(key: str, values: dict[str, float]) -> float:
    """Work that a gel without memory takes up, by the trapezoidal rule, exact for what is periodic."""
    times = arange(2048) * (2.0 * math.pi / OMEGA / 2048)
    radius, velocity = oscillate(times)
    stress = evaluate(material(key), radius, velocity, values)
    return -float((stress.value * radius**2 * velocity).mean())


def work_with_memory(key: str, values: dict[str, float]) -> float:
    """Work that it takes up in the second period, from memory at rest at first."""
    model = material(key)
    theta = tensors(values)
    rest = tensor(REST)[0]

    def rates(t, y):
        state = oscillate(t)
        memory = torch.tensor(y[1:], dtype=torch.float64)
        stress, change = gel_response(model.terms, *state, rest, theta, memory)
        return [-float(stress.value * state[0] ** 2 * state[1]), *change.tolist()]

    ends = [2.0 * math.pi / OMEGA * k for k in range(3)]
    begin = [0.0] * (1 + sum(term.states for term in model.terms))
    found = solve_ivp(rates, (0.0, ends[-1]), begin, "LSODA", ends, rtol=1e-4, atol=1e-7)
    return found.y[0, 2] - found.y[0, 1]


@pytest.mark.parametrize("key", [key for key in ELASTIC if key])
def test_that_an_elastic_part_stores_all_work(key):
    elastic = {n: v for n, v in VALUES.items() if n != "mu"}
    assert abs(work_of_a_period(key, elastic)) < 1e-12


@pytest.mark.parametrize("key", [key for key in VISCOUS if key])
def test_that_a_viscous_part_takes_up_work(key):
    assert work_of_a_period(key, VALUES | {"G": 0.0}) > 1e-6


@pytest.mark.parametrize(
    "key",
    [
        "maxwell",
        "ucm",
        "giesekus",
        "ptt",
        "nhkv+maxwell",
        "gent+cross+two_maxwell",
        "ogden+springpot",
    ],
)
def test_that_no_cycle_of_a_memory_creates_energy(key):
    assert work_with_memory(key, VALUES) > 1e-6


GELS = {
    "gent+newtonian": {"G": 2e3, "mu": 0.06, "gent": 1e-3},
    "arruda_boyce+newtonian": {"G": 2e3, "mu": 0.06, "chain": 3e-3},
    "mooney_rivlin+cross": {
        "G": 2e3,
        "mu": 0.08,
        "mooney": 0.3,
        "cross_time": 1e-6,
        "cross_exponent": 0.8,
    },
    "ogden+carreau_yasuda+maxwell": {
        "G": 3e3,
        "ogden": 0.5,
        "mu": 0.1,
        "thinning_yasuda": 0.4,
        "yasuda": 1.5,
        "shear_time": 1e-5,
        "G_arm": 5e3,
        "tau_arm": 5e-6,
    },
    "yeoh+powell_eyring+two_maxwell": {
        "G": 3e3,
        "alpha": 0.05,
        "cubic": 1e-4,
        "mu": 0.1,
        "eyring_time": 1e-5,
        "G_arm": 5e3,
        "tau_arm": 5e-6,
        "G_arm_slow": 2e3,
        "tau_arm_slow": 5e-5,
    },
    "gent+giesekus": {
        "G": 2e3,
        "mu": 0.1,
        "gent": 1e-3,
        "tau_giesekus": 5e-6,
        "retardation": 0.2,
        "mobility": 0.2,
    },
    "neo_hookean+ptt": {
        "G": 2e3,
        "mu": 0.1,
        "tau_ptt": 1e-5,
        "retardation": 0.1,
        "extensibility": 0.2,
    },
    "neo_hookean+herschel_bulkley+springpot": {
        "G": 3e3,
        "mu": 0.05,
        "power_thinning": 0.3,
        "yield_stress": 500.0,
        "G_frac": 3e3,
        "fractional": 0.4,
    },
}
"""A gel of each kind, SI."""


@functools.cache
def of_all_gels(kind) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Radii of both engines, and without what the parts add: all gels in one batch, since the tensor engine takes little longer for many."""
    gels = torch.stack([PARAMETERS.pack(values) for values in GELS.values()])
    plain = torch.stack(
        [PARAMETERS.pack({"G": x["G"], "mu": x["mu"]}) for x in GELS.values()]
    )
    design = tensor([400.0, 0.25])
    times = linspace(0.0, 1.2, 25)
    coarse = (
        {"stepping": Stepping(0.3)}
        if kind is PolytropicSimulator
        else {"accuracy": Accuracy(1e-3, Resolution(9, 12))}
    )
    ours, reference = (
        kind(engine=engine, **coarse)(gels, design, times)
        for engine in ("compiled", "torchdiffeq")
    )
    assert ours.ok.all()
    return ours.radius, reference.radius, kind(**coarse)(plain, design, times).radius


@pytest.mark.parametrize("key", GELS)
@pytest.mark.parametrize("kind", [TransportSimulator, PolytropicSimulator])
def test_that_both_engines_integrate_a_composed_law_alike(key, kind):
    assert set(GELS[key]) == set(material(key).names)
    ours, reference, plain = (radius[list(GELS).index(key)] for radius in of_all_gels(kind))
    assert (ours - reference).abs().max() < 1e-9
    assert (ours - plain).abs().max() > 1e-4


@pytest.mark.parametrize("kind", [TransportSimulator, PolytropicSimulator])
@pytest.mark.parametrize(
    ("name", "values"), [("gent", (0.5, 0.0168)), ("chain", (0.5, 0.048))]
)
def test_that_a_gel_that_locks_gives_a_status_soon(kind, name, values):
    """Locked from the start, and locking as the bubble collapses."""
    times = linspace(0.0, 3.0, 31)
    gels = torch.stack([PARAMETERS.pack({"G": 5e2, "mu": 1e-3, name: x}) for x in values])
    found = kind()(gels, tensor([700.0, 0.18]), times)
    assert (found.status != Status.DONE).all(), found.status
    assert int(found.steps.max()) < 5000


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("gent+yeoh", "has two elastic parts, Gent and Yeoh"),
        ("zener+maxwell", "has two memory parts, Jeffreys and Maxwell"),
        ("gent+newtonian+sls", "SLS goes with linear alone, not with Gent"),
    ],
)
def test_that_parts_that_do_not_go_together_are_named(key, message):
    with refused(message):
        material(key)


def test_that_titles_and_references_are_those_of_the_parts():
    model = material("gent+carreau_yasuda+maxwell+sound_speed")
    assert model.title == "Gent + Carreau-Yasuda + Maxwell + sound_speed"
    assert model.base == "gent+carreau_yasuda+maxwell"
    for name in ("gent", "carreau_yasuda", "maxwell"):
        assert PARTS[name].reference in model.reference
    assert model.free[-1] == "sound_speed"
