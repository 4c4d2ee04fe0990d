"""Every registered model against calculus and against the strain energy it stands for.

A spherical bubble in an incompressible medium carries the point at ``r0`` to ``r`` with ``r^3 - R^3 = r0^3 - R_inf^3``,
so the hoop stretch is ``l = r/r0`` and ``I_1 = 2 l^2 + l^-4``. A strain energy ``W(I_1)`` gives
``tau_rr - tau_tt = 2 W' (l^-4 - l^2)``; a Newtonian liquid adds ``-6 mu R^2 U / r^3``.
"""

from collections.abc import Callable

import pytest
import torch
from scipy.integrate import quad
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.material import (
    MATERIALS,
    PARAMETERS,
    TERMS,
    Material,
    Parameter,
    Stress,
    active_terms,
    dimensionless,
    material,
    materials,
    register,
    stress_integral,
)
from imr_torch.units import Surroundings

VALUES = {"G": 0.08, "mu": 0.05, "alpha": 0.7}  # dimensionless: 1/Ca, 1/Re, alpha
REST = 0.23
STATES = [(1.0, 0.0), (0.9, -0.7), (REST, -3.0), (0.11, 5.0), (0.06, -9.0), (1.3, 0.4)]
MODELS = pytest.mark.parametrize("model", MATERIALS.values(), ids=MATERIALS.keys())

Energy = Callable[[float, dict[str, float]], float]
"""``dW/dI_1`` at ``I_1 - 3``, over ``p_inf``."""


def quadratic_energy(excess: float, theta: dict[str, float]) -> float:
    """Of ``W = G/2 [(I_1 - 3) + alpha/2 (I_1 - 3)^2]``: neo-Hookean at ``alpha = 0``, nothing at ``G = 0``."""
    return 0.5 * theta["G"] * (1.0 + theta["alpha"] * excess)


REFERENCE: dict[str, Energy] = dict.fromkeys(("newtonian", "nhe", "nhkv", "qkv", "gen_qkv"), quadratic_energy)
"""Model -> strain energy. A new model needs an entry (and its own quadrature if it is not of this kind)."""


def integral(energy: Energy, radius: float, velocity: float, theta: dict[str, float]) -> float:
    """``2 int_R^inf (tau_rr - tau_tt)/r dr`` by adaptive quadrature over ``s = R/r``."""

    def integrand(s: float) -> float:
        squared = (1.0 - s**3 * (1.0 - (REST / radius) ** 3)) ** (-2.0 / 3.0)  # l^2
        excess = 2.0 * squared + squared**-2 - 3.0
        elastic = 2.0 * energy(excess, theta) * (squared**-2 - squared)
        viscous = -6.0 * theta["mu"] * velocity * s**3 / radius
        return 2.0 * (elastic + viscous) / s

    return quad(integrand, 0.0, 1.0, epsabs=1e-13, epsrel=1e-12, limit=400)[0]


def values_of(model: Material) -> dict[str, float]:
    return {p.name: VALUES[p.name] if p.name in model.names else p.neutral for p in PARAMETERS}


def tensors(values: dict[str, float]) -> dict[str, Tensor]:
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}


def evaluate(model: Material, radius: float | Tensor, velocity: float | Tensor, values: dict[str, float]) -> Stress:
    radius, velocity = (torch.as_tensor(x, dtype=torch.float64) for x in (radius, velocity))
    return model.stress(radius, velocity, torch.tensor(REST, dtype=torch.float64), tensors(values))


def test_that_every_model_has_a_reference_and_every_parameter_a_test_value() -> None:
    assert set(REFERENCE) == set(MATERIALS)
    assert set(VALUES) == set(PARAMETERS.names)
    for parameter in PARAMETERS:
        assert VALUES[parameter.name] != parameter.neutral


@MODELS
@pytest.mark.parametrize(("radius", "velocity"), STATES)
def test_that_the_stress_integral_is_the_quadrature_of_its_strain_energy(
    model: Material, radius: float, velocity: float
) -> None:
    values = values_of(model)
    expected = integral(REFERENCE[model.key], radius, velocity, values)
    assert float(evaluate(model, radius, velocity, values).value) == pytest.approx(expected, rel=1e-9, abs=1e-10)


@pytest.mark.parametrize("half", [0.5, 1.0])
def test_that_qkv_is_half_the_square_of_the_first_invariant(half: float) -> None:
    """``177/20 + ...`` follows from ``W = G/2 [(I_1-3) + alpha/2 (I_1-3)^2]`` and not from the form without the 1/2."""

    def energy(excess: float, theta: dict[str, float]) -> float:
        return 0.5 * theta["G"] * (1.0 + 2.0 * half * theta["alpha"] * excess)

    model = material("qkv")
    values = values_of(model)
    expected = integral(energy, 0.9, 0.0, values)
    agrees = float(evaluate(model, 0.9, 0.0, values).value) == pytest.approx(expected, rel=1e-6)
    assert agrees == (half == 0.5)


def test_that_the_stiffening_polynomial_is_177_20_and_no_decimal_of_it() -> None:
    l = 4.1  # noqa: E741
    formula = 177 / 20 + 1 / (4 * l**8) + 2 / (5 * l**5) - 3 / (2 * l**4) + 2 / l**2 - 6 / l - 4 * l
    values = {"G": 1.0, "mu": 0.0, "alpha": 1.0}
    stiff = evaluate(material("qkv"), l * REST, 0.0, values).value - evaluate(material("nhe"), l * REST, 0.0, values).value
    assert float(stiff) == pytest.approx(formula, rel=1e-13)


@MODELS
def test_that_rate_and_acceleration_make_the_time_derivative_of_the_stress(model: Material) -> None:
    """Along ``R = .7 + .5 cos 3t``, against autograd through the stress integral."""
    values = values_of(model)
    t = torch.linspace(0.0, 2.0, 41, dtype=torch.float64, requires_grad=True)
    radius, velocity = 0.7 + 0.5 * torch.cos(3.0 * t), -1.5 * torch.sin(3.0 * t)
    stress = evaluate(model, radius, velocity, values)
    (slope,) = torch.autograd.grad(stress.value.sum(), t)
    composed = stress.rate + stress.acceleration * (-4.5 * torch.cos(3.0 * t))
    torch.testing.assert_close(composed.detach(), slope, rtol=1e-11, atol=1e-11)


@MODELS
def test_that_the_acceleration_factor_is_the_slope_of_the_stress_over_the_velocity(model: Material) -> None:
    values = values_of(model)
    velocity = torch.tensor(-2.0, dtype=torch.float64, requires_grad=True)
    stress = evaluate(model, 0.3, velocity, values)
    slope = torch.autograd.grad(stress.value, velocity)[0] if stress.value.requires_grad else torch.zeros(())
    assert float(stress.acceleration) == pytest.approx(float(slope), abs=1e-15)


@MODELS
def test_that_a_gel_at_rest_has_no_stress(model: Material) -> None:
    stress = evaluate(model, REST, 0.0, values_of(model))
    assert abs(float(stress.value)) < 1e-15
    assert float(stress.rate) == 0.0


@MODELS
@pytest.mark.parametrize("radius", [0.1, 0.2, 0.3, 0.9])
def test_that_elastic_stress_pushes_towards_the_rest_radius(model: Material, radius: float) -> None:
    value = float(evaluate(model, radius, 0.0, values_of(model)).value)
    assert value * (radius - REST) < 0.0 or model.key == "newtonian"


@MODELS
@pytest.mark.parametrize("velocity", [-2.0, 2.0])
def test_that_viscous_stress_opposes_the_motion(model: Material, velocity: float) -> None:
    value = float(evaluate(model, REST, velocity, values_of(model)).value)
    assert (value * velocity < 0.0) if "mu" in model.names else abs(value) < 1e-15


@MODELS
@pytest.mark.parametrize(("radius", "velocity"), STATES)
def test_that_neutral_parameters_do_nothing_exactly(model: Material, radius: float, velocity: float) -> None:
    stress = evaluate(model, radius, velocity, {p.name: p.neutral for p in PARAMETERS})
    assert float(stress.value) == float(stress.rate) == float(stress.acceleration) == 0.0


@MODELS
@pytest.mark.parametrize(("radius", "velocity"), STATES)
def test_that_a_model_inside_the_full_set_of_terms_is_the_model_alone(model: Material, radius: float, velocity: float) -> None:
    values = values_of(model)
    alone = evaluate(model, radius, velocity, values)
    point = (torch.tensor(x, dtype=torch.float64) for x in (radius, velocity, REST))
    among_all = stress_integral(TERMS, *point, tensors(values))
    for name in ("value", "rate", "acceleration"):
        assert float(getattr(alone, name)) == float(getattr(among_all, name))


def test_that_a_batch_of_mixed_models_equals_its_members_alone() -> None:
    models = list(MATERIALS.values())
    theta = {name: torch.tensor([values_of(m)[name] for m in models], dtype=torch.float64) for name in PARAMETERS.names}
    radius = torch.linspace(0.2, 1.0, len(models), dtype=torch.float64)
    velocity = torch.linspace(-2.0, 2.0, len(models), dtype=torch.float64)
    mixed = stress_integral(active_terms(theta), radius, velocity, torch.full_like(radius, REST), theta)
    for i, model in enumerate(models):
        alone = evaluate(model, radius[i], velocity[i], values_of(model))
        for name in ("value", "rate", "acceleration"):
            assert float(getattr(mixed, name)[i]) == pytest.approx(float(getattr(alone, name)), rel=1e-15, abs=0.0)


@pytest.mark.parametrize("name", list(PARAMETERS.names))
def test_that_only_terms_that_act_are_active(name: str) -> None:
    theta = {p.name: torch.full((3,), p.neutral, dtype=torch.float64) for p in PARAMETERS}
    assert active_terms(theta) == ()
    theta[name][1] = VALUES[name]
    assert {term.switch for term in active_terms(theta)} == {name}


def test_that_every_term_switches_off_at_the_neutral_value_of_its_switch() -> None:
    point = [torch.tensor(x, dtype=torch.float64) for x in (0.4, -1.0, REST)]
    for term in TERMS:
        assert term.switch in term.names
        on, off = tensors(VALUES), tensors(VALUES | {term.switch: PARAMETERS[term.switch].neutral})
        assert float(term(*point, on).value) != 0.0
        assert float(term(*point, off).value) == 0.0


@MODELS
def test_that_names_are_those_the_stress_depends_on(model: Material) -> None:
    base = {p.name: VALUES[p.name] for p in PARAMETERS}
    before = float(evaluate(model, 0.4, -1.0, base).value)
    for name in PARAMETERS.names:
        after = float(evaluate(model, 0.4, -1.0, base | {name: 1.7 * base[name]}).value)
        assert (after != before) == (name in model.names), name
    assert model.free == tuple(name for name in model.names if name not in model.known)
    assert set(model.known) <= set(model.names)
    assert [p.name for p in model.parameters] == list(model.names)


@MODELS
def test_that_a_model_is_found_by_its_key_and_says_where_it_is_from(model: Material) -> None:
    assert material(model.key) is model
    assert model.title
    assert model.reference[-5:-1].isdigit() or "(20" in model.reference
    assert all(name in repr(model) for name in model.names)


def test_that_models_come_in_the_order_asked_for() -> None:
    assert [m.key for m in materials(["qkv", "newtonian"])] == ["qkv", "newtonian"]


def test_that_parameters_are_made_dimensionless_by_the_published_numbers() -> None:
    s = Surroundings()
    max_radius = torch.tensor([2e-4, 5e-4], dtype=torch.float64)
    theta = dimensionless(PARAMETERS.pack({"G": 2770.0, "mu": 0.186, "alpha": 0.48}), max_radius, s)
    speed = (101325.0 / 1060.0) ** 0.5
    torch.testing.assert_close(theta["G"].expand(2), torch.full((2,), 2770.0 / 101325.0, dtype=torch.float64))
    torch.testing.assert_close(theta["mu"], 0.186 * speed / (101325.0 * max_radius))
    assert float(theta["alpha"]) == pytest.approx(0.48)


def test_that_plain_numbers_are_packed_with_all_their_digits() -> None:
    packed = PARAMETERS.pack({"G": 1234.5678, "mu": 0.186, "alpha": 0.48})
    assert packed[PARAMETERS.index(["G", "mu", "alpha"])].tolist() == [1234.5678, 0.186, 0.48]


def test_that_units_convert_there_and_back() -> None:
    s = Surroundings(far_field_pressure=9e4, density=998.0, surface_tension=0.072)
    assert s.weber(2e-4) == pytest.approx(9e4 * 2e-4 / 0.144)
    assert s.max_radius(s.weber(2e-4)) == pytest.approx(2e-4, rel=1e-15)
    assert s.time_scale(2e-4) == pytest.approx(2e-4 * (998.0 / 9e4) ** 0.5)


@pytest.mark.parametrize("name", list(PARAMETERS.names))
def test_that_bounds_are_inclusive_and_what_lies_beyond_is_named(name: str) -> None:
    entry = PARAMETERS[name]
    for bound, beyond in ((entry.lower, entry.lower - 1.0), (entry.upper, 2.0 * entry.upper)):
        assert float(PARAMETERS.pack({name: bound})[PARAMETERS.index([name])[0]]) == bound
        for bad in (beyond, float("nan")):
            with pytest.raises(InputDataError, match=rf"Parameter '{name}' is .*Parameters are given in SI units\."):
                PARAMETERS.pack({name: torch.tensor([bound, bad], dtype=torch.float64)})


def test_that_packed_values_broadcast_and_the_rest_is_neutral() -> None:
    G = torch.tensor([[1e3], [2e3]], dtype=torch.float64)
    mu = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    packed = PARAMETERS.pack({"G": G, "mu": mu})
    assert packed.shape == (2, 3, len(PARAMETERS))
    assert packed.dtype == torch.float64
    columns = PARAMETERS.index(["G", "mu", "alpha"])
    assert torch.equal(packed[..., columns[0]], G.expand(2, 3))
    assert torch.equal(packed[..., columns[1]], mu.expand(2, 3))
    assert bool((packed[..., columns[2]] == PARAMETERS["alpha"].neutral).all())
    assert torch.equal(PARAMETERS.pack({}), PARAMETERS.neutral())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: material("hooke"), r"Unknown model 'hooke'; known are newtonian, nhe, nhkv, qkv, gen_qkv"),
        (lambda: materials(["nhkv", "x"]), r"Unknown model 'x'"),
        (lambda: PARAMETERS["E"], r"Unknown parameter 'E'; known are G, mu, alpha"),
        (lambda: PARAMETERS.pack({"E": 1.0}), r"Unknown parameter 'E'"),
        (lambda: PARAMETERS.index(["G", "E"]), r"Unknown parameter 'E'"),
        (lambda: register(material("nhkv")), r"A material of the key 'nhkv' is registered already"),
        (
            lambda: PARAMETERS.register(Parameter("G", "another", "Pa", "pressure", 0.0, 1.0, 0.0)),
            r"Parameter 'G' is registered already with another definition",
        ),
        (lambda: Parameter("x", "x", "1", "none", 1.0, 2.0, 0.0), r"neutral value 0.0 lies outside its bounds \[1.0, 2.0\]"),
        (lambda: Surroundings(density=-1.0), r"Surroundings.density is -1.0; it must be a positive finite number"),
        (lambda: Surroundings(sound_speed=float("inf")), r"Surroundings.sound_speed is inf"),
        (lambda: Surroundings(temperature=float("nan")), r"Surroundings.temperature is nan"),
    ],
)
def test_that_bad_input_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InputDataError, match=message):
        call()


def test_that_registering_the_same_parameter_twice_changes_nothing() -> None:
    before = PARAMETERS.names
    assert PARAMETERS.register(PARAMETERS["G"]) == PARAMETERS["G"]
    assert PARAMETERS.names == before
