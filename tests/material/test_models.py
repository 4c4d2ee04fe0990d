"""What every registered model must do, whatever it stands for: calculus, neutral values, mixing,
its entry in the registry.
"""

from dataclasses import replace

import pytest
import torch

from imr_torch.float64 import tensor
from imr_torch.material import (
    MATERIALS,
    PARAMETERS,
    TERMS,
    Material,
    StressTerm,
    gel_response,
    material,
    register,
    register_term,
)
from tests.material.gels import (
    REST,
    STATES,
    VALUES,
    evaluate,
    has_memory,
    memory_of,
    memory_rate,
    memory_start,
    stress_of,
    stress_of_term,
    tensors,
    values_for,
    values_of,
)
from tests.refusals import refusals, refused
from tests.tables import for_each

MODELS = for_each("model", MATERIALS)


def point_at(radius, velocity):
    return [tensor(x) for x in (radius, velocity, REST)]


POINT = point_at(0.4, -1.0)
ENTRIES = ("value", "rate", "acceleration")


def test_that_every_parameter_of_a_term_has_a_test_value_that_is_not_neutral():
    assert set(VALUES) == {name for term in TERMS for name in term.names}
    assert {name for model in MATERIALS.values() for name in model.names} <= set(VALUES)
    for name, value in VALUES.items():
        assert value != PARAMETERS[name].neutral


@MODELS
def test_that_a_gel_at_rest_has_no_stress(model):
    stress = evaluate(model, REST, 0.0, values_of(model), 0.0 * memory_of(model.terms))
    assert abs(stress.value) < 1e-15
    assert stress.rate == 0.0


def relaxed(model: Material, radius: float) -> torch.Tensor:
    """Memory of a gel that has long been held at a radius: its start at ``R = 1`` for the same
    stretch.
    """
    held = tensor([REST / radius])
    return memory_start(model, held, tensors(values_of(model)))[:, 0]


@MODELS
@pytest.mark.parametrize("radius", [0.1, 0.2, 0.3, 0.9])
def test_that_held_memory_neither_changes_nor_forgets_which_way_to_push(model, radius):
    memory = relaxed(model, radius)
    stress = evaluate(model, radius, 0.0, values_of(model), memory)
    assert abs(stress.rate) < 1e-15
    elastic = {"G", "G_lin"} & set(model.names)
    assert (
        float(stress.value) * (radius - REST) < 0.0
        if elastic
        else abs(float(stress.value)) < 1e-15
    )


@MODELS
@pytest.mark.parametrize("velocity", [-2.0, 2.0])
def test_that_viscous_stress_opposes_the_motion(model, velocity):
    """At once, or as the memory of a Maxwell branch builds up."""
    theta = tensors(values_of(model))
    point = point_at(REST, velocity)
    memory = 0.0 * memory_of(model.terms)
    value = float(stress_of(model, *point, theta, memory).value)
    growth = float(memory_rate(model.terms, *point, theta, memory).sum())
    if "mu" not in model.names:
        assert abs(value) < 1e-15
    else:
        assert value * velocity < 0.0 or growth * velocity < 0.0
        assert max(value * velocity, growth * velocity) < 1e-15


@MODELS
@pytest.mark.parametrize(("radius", "velocity"), STATES)
def test_that_neutral_parameters_do_nothing_exactly(model, radius, velocity):
    """Whatever the memory holds, which in a mixed batch is another member's business."""
    stress = evaluate(model, radius, velocity, {})
    assert stress.value == stress.rate == stress.acceleration == 0.0


@MODELS
@pytest.mark.parametrize(("radius", "velocity"), STATES)
def test_that_a_model_inside_the_full_set_of_terms_is_the_model_alone(
    model, radius, velocity
):
    theta = tensors(values_of(model))
    point = point_at(radius, velocity)
    own = set(model.terms)
    rows = []
    start = 0
    for term in TERMS:
        rows += list(range(start, start + term.states)) if term in own else []
        start += term.states
    memory = 0.0 * memory_of(TERMS)  # where members of other models start, and stay
    memory[rows] = memory_of(model.terms)
    alone = stress_of(model, *point, theta, memory[rows])
    among_all, rates = gel_response(TERMS, *point, theta, memory)
    for name in ENTRIES:
        assert getattr(alone, name) == getattr(among_all, name)
    assert torch.equal(rates[rows], memory_rate(model.terms, *point, theta, memory[rows]))
    assert rates.abs().sum() == rates[rows].abs().sum()


@pytest.mark.parametrize("term", TERMS, ids=lambda term: term.name)
def test_that_a_term_is_switched_off_by_its_switch_alone(term):
    states = (memory_of([term]),) if term.states else ()
    assert term.switch in term.names
    on = tensors(values_for(term))
    off = tensors(values_for(term) | {term.switch: PARAMETERS[term.switch].neutral})
    assert stress_of_term(term, *POINT, on, *states).value != 0.0
    if term.states:  # a member without it starts without memory, which then stays away
        still = 0.0 * states[0]
        assert stress_of_term(term, *POINT, off, still).value == 0.0
        assert memory_rate([term], *POINT, off, still).abs().sum() == 0.0
        assert term.memory_start(POINT[2][None], off).abs().sum() == 0.0
    else:
        assert stress_of_term(term, *POINT, off).value == 0.0


@MODELS
def test_that_names_are_those_that_stress_and_memory_depend_on(model):

    def response(values: dict[str, float]) -> list[float]:
        memory = memory_of(model.terms)
        theta = tensors(values)
        stress = stress_of(model, *POINT, theta, memory)
        rates = memory_rate(model.terms, *POINT, theta, memory).tolist()
        return [float(getattr(stress, name)) for name in ENTRIES] + rates

    of_others = dict.fromkeys((name for term in model.terms for name in term.beside), 0.0)
    values = VALUES | of_others
    before = response(values)
    for name, value in values.items():
        assert (response(values | {name: 1.3 * value}) != before) == (
            name in model.names
        ), name
    assert model.free == tuple(name for name in model.names if name not in model.known)
    assert set(model.known) <= set(model.names)
    assert has_memory(model) == (len(before) > 3)


@MODELS
def test_that_a_model_is_found_by_its_key_and_says_where_it_is_from(model):
    assert material(model.key) is model
    assert model.title
    assert "(19" in model.reference or "(20" in model.reference
    assert all(name in repr(model) for name in model.names)


def test_that_a_model_extended_by_name_has_that_parameter_too():
    extended = material("nhkv+alpha")
    assert extended.key == "nhkv+alpha"
    assert extended.names == material("gen_qkv").names
    assert extended.free == ("G", "mu", "alpha")
    one, other = (evaluate(m, 0.6, -1.0, VALUES) for m in (extended, material("gen_qkv")))
    assert [float(getattr(one, name)) for name in ENTRIES] == [
        float(getattr(other, name)) for name in ENTRIES
    ]


def test_that_a_term_is_registered_once():
    before = list(TERMS)
    assert register_term(replace(TERMS[0])) == TERMS[0]
    assert before == TERMS


def test_that_memory_left_out_is_named():
    with refused(r"maxwell has memory; its states must be given"):
        stress_of(material("zener"), *POINT, tensors(VALUES))


def reads_unknown(radius, velocity, rest_radius, G, unheard_of):
    return -G * unheard_of, 0.0, 0.0


def forgets_the_velocity(radius, rest_radius, G):
    return -G, 0.0, 0.0


test_that_bad_input_is_named = refusals(
    (
        lambda: material("hooke"),
        r"Unknown model 'hooke'; known are newtonian, nhe, nhkv, qkv, gen_qkv",
    ),
    (lambda: material("nhkv+wool"), r"Unknown parameter 'wool'"),
    (lambda: material("nhkv+G"), r"names 'G' twice, or 'nhkv' has it already"),
    (
        lambda: register(material("nhkv")),
        r"A material of the key 'nhkv' is registered already",
    ),
    (
        lambda: register_term(StressTerm(reads_unknown, switch="G")),
        r"Unknown parameter 'unheard_of'",
    ),
    (lambda: register_term(replace(TERMS[0], switch="wool")), r"Unknown parameter 'wool'"),
    (
        lambda: StressTerm(forgets_the_velocity, switch="G"),
        r"takes radius, velocity, rest_radius, its 0 memory states",
    ),
)
