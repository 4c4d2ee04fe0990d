"""The ladder of effects: it adds what explains, drops what is superfluous, stops at noise, and is judged on unseen designs."""

from dataclasses import replace

import pytest
import torch

from imr_torch.gap import Ladder, Parts, describe, diagnose, examine, library, to_json
from imr_torch.gap import ladder as ladder_module
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.gap.attribute import Inquiry
from imr_torch.gap.hypotheses import Hypothesis
from imr_torch.gap.ladder import climb, left_over
from imr_torch.material import LIBRARY
from tests.gap.synthetic import BASE, DESIGNS, SIMULATOR, fit, shoot

TWO = {"sound_speed": 0.5, "rinf_bias": -0.08}


@pytest.fixture(scope="module")
def climbed():
    """A set with two effects, climbed with four to choose from."""
    batch = shoot(TWO, DESIGNS, repeats=20)
    report = diagnose(
        list(batch.experiments), effects=library(("sound_speed", "rinf_bias", "refraction", "gas_loss")), simulator=SIMULATOR
    )
    return report, examine(report, SIMULATOR)


def test_that_two_effects_are_added_and_the_gap_is_closed_on_designs_that_no_fit_saw(climbed) -> None:
    _, parts = climbed
    last = parts.ladder.rungs[-1]
    assert set(last.effects) == set(TWO)
    assert last.adequate
    assert last.converged
    low, middle, high = last.closed
    assert 0.8 < low < middle < high < 1.05
    difference, error = last.log_score
    assert difference > 5.0 * error
    misfits = [rung.misfit for rung in parts.ladder.rungs]
    assert misfits == sorted(misfits, reverse=True)
    assert "what is left is noise" in str(parts.ladder)


def test_that_rungs_are_written_down(climbed) -> None:
    report, parts = climbed
    rungs = to_json(report, parts)["ladder"]
    assert [rung["effects"] for rung in rungs] == [list(rung.effects) for rung in parts.ladder.rungs]
    assert rungs[0]["closed"] is None
    assert rungs[-1]["closed"] == list(parts.ladder.rungs[-1].closed)
    assert set(rungs[-1]["parameters"]) == {"G", "mu", *TWO}
    assert all(rung["converged"] for rung in rungs)
    assert str(parts.ladder) in describe(report, parts)


def test_that_what_is_left_and_where_is_said_of_a_rung_that_is_not_adequate(climbed) -> None:
    ladder = climbed[1].ladder
    last = replace(ladder.rungs[-1], test=replace(ladder.rungs[-1].test, p_value=1e-9))
    said = str(Ladder((*ladder.rungs[:-1], last)))
    assert "what is left lies most in the phase" in said
    assert last.worst.phase in said
    assert "no further effect" in said


def test_that_what_explains_the_designs_it_was_fitted_to_but_no_other_closes_nothing() -> None:
    batch = shoot({"sound_field": 0.05, "sound_frequency": 1.5, "sound_phase": 0.3}, DESIGNS, repeats=40)
    effects = library(("refraction", "surface_tension", "gas_loss"))
    report = diagnose(list(batch.experiments), effects=effects, simulator=SIMULATOR)
    ladder = examine(report, SIMULATOR).ladder
    assert report.verdict == "other"
    assert ladder is not None
    assert all(rung.gained > 3.0 for rung in ladder.rungs[1:])
    assert not ladder.rungs[-1].adequate
    assert ladder.best.effects == ()
    assert str(ladder) == "No effect of the library closes any of the gap."
    assert sum(part.share for part in ladder.rungs[-1].left) == pytest.approx(1.0)


def test_that_an_effect_which_another_makes_superfluous_is_dropped() -> None:
    batch = shoot({"gas_loss": 0.2}, DESIGNS)
    wrong, right = LIBRARY["wall"], LIBRARY["gas_loss"]
    null = fit(batch)
    test = adequacy_test(null, (wrong, right), batch, SIMULATOR, seed=0).test
    alone = fit(batch, Hypothesis(BASE, (wrong,)), wall=0.1)
    far = replace(fit(batch, Hypothesis(BASE, (right,)), gas_loss=0.2), cost=1e9)  # as if it had been left behind
    known = {"wall": alone, "gas_loss": far}
    inquiry = Inquiry(BASE, (wrong, right), batch, SIMULATOR)
    ladder = climb(inquiry, null, test, known, seed=0)
    assert ladder.rungs[-1].effects == ("gas_loss",)


def test_that_fits_saved_by_amplitudes_far_from_zero_change_no_rung(climbed, monkeypatch) -> None:
    report, parts = climbed
    inquiry = Inquiry(BASE, tuple(LIBRARY[name] for name in report.directions), report.batch, SIMULATOR)
    monkeypatch.setattr(ladder_module, "_CLEAR", float("inf"))  # a refit without each effect decides on every rung
    slow = climb(inquiry, report.null, report.gap, report.fits, seed=0)
    assert [rung.effects for rung in slow.rungs] == [rung.effects for rung in parts.ladder.rungs]
    assert slow.rungs[-1].test.p_value == pytest.approx(parts.ladder.rungs[-1].test.p_value, rel=0.5)


def test_that_what_is_left_of_a_perfect_fit_is_within_its_noise() -> None:
    batch = shoot({}, DESIGNS, repeats=20)
    parts = left_over(fit(batch), batch)
    assert sum(part.misfit**2 for part in parts) < 0.3 * sum(part.noise**2 for part in parts)
    moved = replace(fit(batch), prediction=fit(batch).prediction + 0.02 * (batch.times > 1.3) * (batch.times < 1.5))
    worst = max(left_over(moved, batch), key=lambda part: part.share)
    assert worst.phase == "first rebound"
    assert 0.0 < worst.misfit <= 0.02


def test_that_there_is_no_ladder_without_a_gap() -> None:
    batch = shoot({}, DESIGNS[:1])
    report = diagnose(list(batch.experiments), effects=library(("sound_speed",)), simulator=SIMULATOR)
    assert examine(report, SIMULATOR) == Parts()
    assert torch.isfinite(torch.tensor(report.gap.p_value))
