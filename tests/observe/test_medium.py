"""Statements about the medium: how they are read, which of two counts, what is assumed, and what is
refused.
"""

import json
import math

import pytest
import torch

from imr_torch import (
    Characterization,
    PolytropicSimulator,
    load_traces,
    wide_prior,
)
from imr_torch.characterization import medium_of
from imr_torch.float64 import linspace
from imr_torch.material.media import water_density, water_surface_tension
from imr_torch.observe import RadiusTrace, Statement, TraceSet, gel_medium
from imr_torch.random import generator
from imr_torch.units import Surroundings
from tests.filmed import characterize_quickly, film
from tests.refusals import refused


def text(said: str) -> Statement:
    return Statement.from_text(said)


def test_that_a_value_counts_before_a_name_and_a_name_before_what_is_assumed():
    medium = gel_medium(text("water,temperature=310:2,density=1125:11"))
    assert medium.surroundings.density == 1125.0
    assert medium.surroundings.surface_tension == water_surface_tension(310.0)
    assert medium.sds == {"density": 11.0, "temperature": 2.0}
    assert medium.assumed == ("far_field_pressure",)
    assert "density 1125 +- 11 kg/m^3, temperature 310 +- 2 K (--medium)" in medium.report()
    assert "pressure 1.013e+05 Pa (assumed)" in medium.report()


def test_that_a_stated_temperature_moves_a_named_medium_and_no_assumed_value():
    assert gel_medium(text("water,temperature=320")).surroundings.density == water_density(
        320.0
    )
    assert (
        gel_medium(text("temperature=320")).surroundings.density == Surroundings().density
    )


def test_that_a_density_is_loose_where_curves_are_fitted_and_nobody_stated_or_chose_it():
    time = linspace(0.0, 60e-6, 61)
    curves = TraceSet(
        (RadiusTrace("a", time, 200e-6 * (0.6 + 0.4 * torch.cos(2e5 * time)), "a"),)
    )
    assert medium_of(curves).sds == {"density": 30.0}
    assert "density (1060 +- 30 kg/m^3)" in medium_of(curves).unstated
    chosen = Surroundings(density=998.0)
    for exact in (
        medium_of(curves, "density=1060"),
        medium_of(curves, "water"),
        medium_of(curves, None, chosen),
        medium_of(TraceSet(())),
    ):
        assert not exact.sds
        assert not exact.unstated


def test_that_standard_deviations_are_priors_of_the_logarithm_in_every_model():
    belief = gel_medium(text("density=1000:20,pressure=101325:500")).believed(
        wide_prior(["newtonian", "nhkv"])
    )
    assert belief.keys == (
        "newtonian+medium_pressure+density",
        "nhkv+medium_pressure+density",
    )
    part = belief.models[1]
    deviations = dict(zip(part.names, part.sds.tolist(), strict=True))
    assert deviations["density"] == pytest.approx(0.02)
    assert deviations["medium_pressure"] == pytest.approx(500.0 / 101325.0)
    # once
    assert (
        gel_medium(text("density=1000:20,pressure=101325:500")).believed(belief).keys
        == belief.keys
    )


def test_that_the_caller_counts_before_the_file_and_says_so():
    beside = Statement.from_json({"name": "pbs", "density": [1100, 10]}, "gel.json")
    medium = gel_medium(text("density=1125"), [beside])
    assert medium.surroundings.density == 1125.0
    assert not medium.sds  # the file's uncertainty is of the file's value
    assert medium.sources["sound_speed"] == "pbs, gel.json"
    assert (
        medium.notes[-1]
        == "Stated twice, density: 1125 (--medium) and 1100 +- 10 (gel.json); the former counts."
    )


def test_that_files_of_different_media_are_not_fitted_together_unless_the_caller_decides():
    files = [
        Statement.from_json({"density": value}, f"{value}.json") for value in (1000, 1100)
    ]
    with refused(r"density: 1000 \(1000.json\) and 1100 \(1100.json\)"):
        gel_medium(None, files)
    assert gel_medium(text("density=1050"), files).surroundings.density == 1050.0


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ("watr", "Unknown medium 'watr'; known are water"),
        (
            "density=1.06",
            "density is 1.06; expected 500 to 3000 kg/m.3. It looks like g/cm.3: multiply by 1000",
        ),
        (
            "temperature=37",
            "temperature is 37; expected 273.15 to 363.15 K. It looks like degrees Celsius: add 273.15",
        ),
        ("pressure=1", "It looks like bar or atm: multiply by 1e5"),
        ("density=1125:0", "standard deviation of density is 0 kg/m.3; expected above 0"),
        ("density=1125+-11", "is not PROPERTY=VALUE"),
        (
            "viscosity=0.1",
            "unknown property 'viscosity' of a medium; known are density, sound_speed",
        ),
        ("temperature=360,pressure=20000", "so it boils"),
    ],
)
def test_that_what_cannot_be_is_refused_with_a_remedy(said, message):
    with refused(message):
        gel_medium(text(said))


def test_that_the_json_beside_a_file_states_the_medium_and_text_stays_a_remark(tmp_path):
    (tmp_path / "gel.csv").write_text(
        "time (us),R (um)\n0,200\n1,190\n2,170\n3,140\n4,100\n"
    )
    for medium, density in (
        ({"name": "water", "density": [1010, 5]}, 1010.0),
        ("water, degassed", 1060.0),
    ):
        (tmp_path / "gel.json").write_text(json.dumps({"medium": medium}))
        assert medium_of(load_traces(tmp_path / "gel.csv")).surroundings.density == density
    (tmp_path / "gel.json").write_text(
        json.dumps({"experiments": [{"experiment_id": "gel", "medium": {"density": 1e3}}]})
    )
    with refused("state properties once, at the top"):
        load_traces(tmp_path / "gel.csv")


def shots(**gel: float) -> TraceSet:
    """Two shots in a medium of 1120 kg/m^3, with noise of .004 in R*."""
    simulator = gel_medium(text("density=1120")).applied(PolytropicSimulator())
    given = {"noise": 0.004, "simulator": simulator}
    source = generator(3)
    return TraceSet(
        tuple(
            film(gel, size, rest, linspace(0.0, 2.4, 49), source, name=name, **given)
            for name, size, rest in (("a", 250e-6, 0.2), ("b", 320e-6, 0.16))
        )
    )


def fitted(curves: TraceSet, medium: str, model: str = "nhkv") -> Characterization:
    return characterize_quickly(curves, model, medium=medium, rest_radius=(0.18, 0.03))


def test_that_a_density_with_a_standard_deviation_is_inferred_and_widens_the_gel():
    curves = shots(G=6000.0, mu=0.06)
    known = fitted(curves, "density=1120")
    uncertain = fitted(curves, "density=1060:60")
    assert known.posterior.keys == ("nhkv",)
    part = uncertain.posterior["nhkv+density"]
    density = part.names.index("density")
    assert abs(part.means[density] - math.log(1120.0 / 1060.0)) < 3.0 * part.sds[density]
    assert part.sds[density] < 0.9 * 60.0 / 1060.0  # the curves say something of it
    exact = known.posterior["nhkv"]
    assert (part.sds[:2] > 1.1 * exact.sds).any()
    document = uncertain.to_dict()
    assert document["medium"]["density"] == {
        "value": 1060.0,
        "unit": "kg/m^3",
        "sd": 60.0,
        "stated": True,
        "source": "medium",
    }
    assert document["medium"]["sound_speed"]["stated"] is False
    report = uncertain.report()
    assert "Medium: density 1060 +- 60 kg/m^3 (medium)" in report
    assert "density was stated 1060 +- 60 kg/m^3 and is 1" in report
    assert "contradict" not in report
    of_gel = report[report.index("NHKV") : report.index("Medium:")]
    assert "\n  G " in of_gel
    assert "\n  density " not in of_gel  # as a factor it is in the JSON alone


def test_that_curves_which_contradict_a_statement_say_so_and_others_do_not():
    """In a liquid: the modulus of a gel would take up nearly all of a wrong density."""
    curves = shots(mu=0.06)
    for stated, contradicted in (("density=1060:10", True), ("density=1120:10", False)):
        report = fitted(curves, stated, "newtonian").report()
        assert ("the curves contradict what was stated" in report) is contradicted
