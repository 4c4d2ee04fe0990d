"""Scatter of the gel as a cause:

found where gels differ, not where one gel has an effect, not asked of repeats.
"""

from dataclasses import replace

import pytest
import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.gap import GapReport, diagnose, library
from imr_torch.gap.scatter import GelScatter, gel_scatter
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, SimulatedLaboratory, Statement, gel_medium

SIMULATOR = PolytropicSimulator(threads=1)
EFFECTS = library(["gas_loss", "surface_tension"])


def shot(number: int, gel: dict[str, float], *, repeats: int = 1) -> Experiment:
    laboratory = SimulatedLaboratory(SIMULATOR, PARAMETERS.pack(gel), repeats=repeats)
    design = torch.tensor(
        [350.0 + 120.0 * (number % 4), 0.2 + 0.03 * (number % 4)], dtype=torch.float64
    )
    return laboratory.shoot(design, seed=number, label=f"shot {number}")


def diagnosis(gels: list[dict[str, float]], *, repeats: int = 1) -> GapReport:
    shots = [shot(number, gel, repeats=repeats) for number, gel in enumerate(gels)]
    return diagnose(shots, effects=EFFECTS, simulator=SIMULATOR)


@pytest.fixture(scope="module")
def two_gels() -> tuple[GapReport, GelScatter]:
    report = diagnosis([{"G": 6e3, "mu": 0.09}, {"G": 11e3, "mu": 0.09}, {"G": 8e3, "mu": 0.09}])
    found = gel_scatter(report, SIMULATOR)
    assert report.found
    assert found is not None
    return report, found


def test_that_gels_that_differ_are_found_and_no_gap_is_left(
    two_gels: tuple[GapReport, GelScatter],
) -> None:
    _, found = two_gels
    assert found.is_cause
    assert found.leading == "gel_scatter"
    assert found.explained["gel_scatter"] > found.explained[found.rival] + 10.0
    assert found.adequacy_p > 0.05
    low, _, high = found.scatter["G"]
    assert low < 0.3 < high  # the standard deviation of the three logarithms
    assert found.scatter["mu"][1] < 0.1
    assert "the gel differs" in " ".join(found.sentences())


def test_that_scatter_beside_an_effect_counts_the_effect_once(
    two_gels: tuple[GapReport, GelScatter],
) -> None:
    _, found = two_gels
    both = found.explained[f"{found.rival}+gel_scatter"]
    assert (
        both < found.explained["gel_scatter"] + 3.0
    )  # the effect is absent, so it costs evidence or gains nothing


def test_that_an_effect_of_one_gel_is_not_taken_for_scatter() -> None:
    report = diagnosis([{"G": 8e3, "mu": 0.09, "gas_loss": 0.5}] * 3)
    found = gel_scatter(report, SIMULATOR)
    assert report.cause == ("gas_loss",)
    assert found is not None
    assert not found.is_cause
    assert found.explained["gas_loss"] > found.explained["gel_scatter"]


def test_that_the_medium_does_not_differ_between_curves() -> None:
    medium = gel_medium(Statement.from_text("density=1060:20"))
    base = medium.believed_of(wide_prior(["nhkv"]).models[0])
    shots = [shot(number, {"G": G, "mu": 0.09}) for number, G in enumerate((6e3, 11e3, 8e3))]
    report = diagnose(shots, base=base, effects=EFFECTS, simulator=medium.applied(SIMULATOR))
    found = gel_scatter(report, medium.applied(SIMULATOR))
    assert "density" in base.names
    assert found is not None
    assert set(found.scatter) == {"G", "mu"}
    assert found.is_cause


def test_that_repeats_and_a_single_curve_are_not_asked(
    two_gels: tuple[GapReport, GelScatter],
) -> None:
    report, _ = two_gels
    one = replace(report, batch=replace(report.batch, experiments=report.batch.experiments[:1]))
    assert gel_scatter(one, SIMULATOR) is None
    twice = tuple(replace(e, radius=e.radius.expand(2, -1)) for e in report.batch.experiments)
    assert (
        gel_scatter(replace(report, batch=replace(report.batch, experiments=twice)), SIMULATOR)
        is None
    )
