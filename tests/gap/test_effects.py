"""The registry: one test through every effect of the library, and what a user's own effect must be."""

import pytest
import torch

from imr_torch.errors import ImrError
from imr_torch.float64 import tensor
from imr_torch.material import (
    LIBRARY,
    PARAMETERS,
    Effect,
    LogNormal,
    Parameter,
    TruncatedNormal,
    library,
    register_effect,
)
from imr_torch.material import effect as registry
from imr_torch.material.parameters import ParameterVector
from imr_torch.observe import predict
from tests.gap.synthetic import GEL, SIMULATOR, shoot
from tests.refusals import refused


@pytest.fixture(scope="module")
def batch():
    return shoot({})


def seen(batch, values: dict[str, float]):
    """What the camera would see of the gel with some parameters: ``E x T``."""
    return predict(SIMULATOR, PARAMETERS.pack(GEL | values)[None], batch)[0]


@pytest.mark.parametrize("name", LIBRARY)
def test_that_at_its_neutral_value_it_is_the_base_exactly_and_at_a_start_it_is_not(
    batch, name
):
    effect = LIBRARY[name]
    base = seen(batch, {})
    for start in effect.starts:
        values = dict(zip(effect.names, start, strict=True))
        assert torch.equal(seen(batch, values | {effect.names[0]: 0.0}), base)
        assert (seen(batch, values) - base).abs().amax() > 1e-5


@pytest.mark.parametrize("name", LIBRARY)
def test_that_it_says_where_it_acts_in_which_units_and_how_large_it_may_be(name):
    effect = LIBRARY[name]
    assert effect.name == name
    assert effect.place in (
        "material",
        "gas",
        "liquid",
        "geometry",
        "driving",
        "measurement",
    )
    assert len(effect.meaning) > 10
    for i, (parameter, prior) in enumerate(effect.priors.items()):
        assert PARAMETERS[parameter].unit
        for start in effect.starts:
            control = prior.to_control(tensor(start[i]))
            assert control.abs() < 3.0
    mates = [other for other in LIBRARY.values() if other.family == effect.family]
    assert len(mates) == 1 or effect.group


def test_that_effects_are_offered_by_name_and_to_bases_that_they_can_act_on():
    assert [e.name for e in library(["pulse", "wall"])] == ["pulse", "wall"]
    assert len(library(without=["pulse"])) == len(library()) - 1
    # where it is named
    assert "compressibility" not in [effect.name for effect in library()]
    assert [effect.name for effect in library(["compressibility"])] == ["compressibility"]
    assert "strain_stiffening" in {e.name for e in library(base="nhkv")}
    assert "strain_stiffening" not in {e.name for e in library(base="gen_qkv")}
    assert not {"strain_stiffening", "damage", "permanent_set"} & {
        e.name for e in library(base="newtonian")
    }
    with refused(r"Unknown effect 'wal'; known are strain_stiffening, "):
        library(["wal"])


@pytest.mark.parametrize(
    ("prior", "starts"),
    [
        (TruncatedNormal(0.0, 0.1), (0.04, -0.04)),
        (TruncatedNormal(0.0, 0.1, lower=-0.03), (0.04, -0.04)),
        (TruncatedNormal(0.0, 0.1, lower=0.0), (0.03, 0.12)),
    ],
)
def test_that_usual_starts_are_on_either_side_or_two_sizes_of_a_one_sided_effect(
    prior, starts
):
    effect = Effect("x", "an effect of one parameter", "geometry", {"wall": prior})
    assert [start for (start,) in effect.starts] == pytest.approx(starts)


def test_that_an_effect_is_offered_to_models_that_have_what_it_needs():
    prior = TruncatedNormal(0.0, 0.1)
    free, bound = (
        Effect("x", "a wall that needs", "liquid", {"wall": prior}, needs=needs)
        for needs in ("", "G")
    )
    assert free.applies("nhkv")
    assert free.applies("newtonian")
    assert bound.applies("nhkv")
    assert not bound.applies("newtonian")
    assert not free.applies("nhkv+wall")


def test_that_a_users_effect_is_one_class_and_is_checked(monkeypatch):
    monkeypatch.setattr(registry, "LIBRARY", dict(LIBRARY))
    prior = TruncatedNormal(0.0, 0.1)
    mine = Effect(
        "slow_wall", "a wall far away", "geometry", {"wall": prior}, ((0.05,), (-0.05,))
    )
    register_effect(mine)
    assert library(["slow_wall"]) == (mine,)
    with refused("'slow_wall' is registered already"):
        register_effect(mine)
    with refused("needs starts of 1 values each"):
        Effect(
            "x", "no start of that many values", "geometry", {"wall": prior}, ((0.05, 1.0),)
        )
    with refused(r"needs starts of 3 values each, got \(\)"):
        Effect("x", "no start of several parameters", "driving", LIBRARY["pulse"].priors)
    with refused(r"needs starts of 1 values each, got \(\)"):
        Effect("x", "no start for such a prior", "geometry", {"wall": LogNormal(1.0, 2.0)})
    for law in ("setting", "gas_loss", "vapour", "far_field"):
        with refused(rf"its law {law} takes [13] arguments and then wall"):
            Effect(
                "x",
                "a law of too many arguments",
                "liquid",
                {"wall": prior},
                **{law: lambda a, b, c, d, e: a},
            )
    with refused("stiffness", ImrError):
        Effect(
            "x", "needs what there is not", "geometry", {"wall": prior}, needs="stiffness"
        )
    with refused("wal", ImrError):
        Effect("x", "no such parameter", "geometry", {"wal": prior}, ((0.05,),))


def test_that_an_amplitude_that_is_not_neutral_at_zero_is_named(monkeypatch):
    own = ParameterVector()
    own.register(
        Parameter("slow", "a factor, which does nothing at one", "1", "none", 0.0, 2.0, 1.0)
    )
    monkeypatch.setattr(registry, "PARAMETERS", own)
    with refused("its amplitude 'slow' must be neutral at zero"):
        Effect("x", "a factor", "geometry", {"slow": TruncatedNormal(0.0, 0.1)})
