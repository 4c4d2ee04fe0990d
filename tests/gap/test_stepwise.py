"""The stepwise selection of effects:

it adds what explains, drops what is superfluous, stops at noise, and is judged on unseen designs.
"""

import math
from dataclasses import replace

import pytest
import torch

from imr_torch.gap import (
    Parts,
    StepwiseSelection,
    additions,
    describe,
    diagnose,
    examine,
    library,
    to_json,
)
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.gap.attribute import Inquiry, fitted_values
from imr_torch.gap.hypotheses import GEL_SCATTER, Hypothesis, laplace_evidence
from imr_torch.gap.stepwise import left_over, misfit_in_difference, select_stepwise
from imr_torch.material import LIBRARY
from imr_torch.observe import ExperimentBatch
from tests.gap.synthetic import BASE, DESIGNS, SIMULATOR, fit, shoot

TWO = {"sound_speed": 0.5, "rinf_bias": -0.08}


@pytest.fixture(scope="module")
def selected():
    """A set with two effects, selected with four to choose from."""
    batch = shoot(TWO, DESIGNS, repeats=20)
    report = diagnose(
        list(batch.experiments),
        effects=library(("sound_speed", "rinf_bias", "refraction", "gas_loss")),
        simulator=SIMULATOR,
    )
    return report, examine(report, SIMULATOR)


def test_that_two_effects_are_added_and_the_gap_is_closed_on_designs_that_no_fit_saw(
    selected,
) -> None:
    _, parts = selected
    last = parts.selection.steps[-1]
    assert set(last.effects) == set(TWO)
    assert last.adequate
    assert last.converged
    low, middle, high = last.closed
    assert 0.8 < low < middle < high < 1.05
    difference, error = last.log_score
    assert difference > 5.0 * error
    misfits = [step.misfit for step in parts.selection.steps]
    assert misfits == sorted(misfits, reverse=True)
    assert "what is left is noise" in str(parts.selection)


def test_that_rungs_are_written_down(selected) -> None:
    report, parts = selected
    document = to_json(report, parts)
    assert document["ladder_ended"] == "adequate"
    steps = document["ladder"]
    assert [step["effects"] for step in steps] == [
        list(step.effects) for step in parts.selection.steps
    ]
    assert steps[0]["closed"] is None
    assert steps[-1]["closed"] == list(parts.selection.steps[-1].closed)
    assert set(steps[-1]["parameters"]) == {"G", "mu", *TWO}
    assert all(step["converged"] for step in steps)
    assert [(step["curves"], step["unusual"]) for step in steps] == [
        ({}, {})
    ] * 3  # curves do not differ
    assert str(parts.selection) in describe(report, parts)


def test_that_what_is_left_and_where_is_said_of_a_rung_that_is_not_adequate(selected) -> None:
    selection = selected[1].selection
    last = replace(selection.steps[-1], test=replace(selection.steps[-1].test, p_value=1e-9))
    said = str(StepwiseSelection((*selection.steps[:-1], last)))
    assert "what is left lies most in the phase" in said
    assert last.worst.phase in said
    assert "no further effect" in said


def test_that_an_adequate_last_step_which_predicts_worse_is_told_apart_from_what_is_reported(
    selected,
) -> None:
    selection = selected[1].selection
    before = selection.steps[1]
    last = selection.steps[-1]
    left = replace(
        before,
        test=replace(before.test, p_value=1e-9),
        log_score=(9.0, 1.0),
        closed=(0.1, 0.3, 0.5),
    )
    worse = replace(
        selection, steps=(selection.steps[0], left, replace(last, log_score=(1.0, 1.0)))
    )
    assert worse.best is left
    said = str(worse)
    assert said.endswith(
        "the last step, which leaves only noise on the fitted curves, is not the one that does best on others."
    )
    assert "what is left is noise" not in said


def test_that_differences_between_curves_are_reported_where_no_effect_is_a_step(selected) -> None:
    selection = selected[1].selection
    apart = replace(
        selection.steps[1], effects=(GEL_SCATTER,), log_score=(9.0, 1.0), closed=(0.5, 0.7, 0.9)
    )
    only = replace(selection, steps=selection.steps[:1], differing=apart)
    assert only.best is apart
    assert str(only).startswith("differences between curves close 0.70 (0.50 to 0.90) of the gap")
    assert (
        replace(only, differing=replace(apart, closed=(-0.5, -0.1, 0.2))).best is selection.steps[0]
    )


def test_that_what_explains_the_designs_it_was_fitted_to_but_no_other_closes_nothing() -> None:
    batch = shoot(
        {"sound_field": 0.05, "sound_frequency": 1.5, "sound_phase": 0.3}, DESIGNS, repeats=40
    )
    effects = library(("refraction", "surface_tension", "gas_loss"))
    report = diagnose(list(batch.experiments), effects=effects, simulator=SIMULATOR)
    selection = examine(report, SIMULATOR).selection
    assert report.verdict == "other"
    assert selection is not None
    assert all(step.gained > 3.0 for step in selection.steps[1:])
    assert not selection.steps[-1].adequate
    assert selection.ended == "explains no more"
    short = select_stepwise(
        Inquiry(BASE, effects, report.batch, SIMULATOR),
        report.null,
        report.gap,
        report.fits,
        most=1,
        seed=0,
    )
    assert short.ended == "most"
    assert str(short).endswith("more additions were not tried.")
    assert selection.best.effects == ()
    assert str(selection) == "No effect of the library closes any of the gap."
    assert sum(part.share for part in selection.steps[-1].left) == pytest.approx(1.0)


def test_that_an_effect_which_another_makes_superfluous_is_dropped() -> None:
    batch = shoot({"gas_loss": 0.2}, DESIGNS)
    wrong = LIBRARY["wall"]
    right = LIBRARY["gas_loss"]
    null = fit(batch)
    test = adequacy_test(null, (wrong, right), batch, SIMULATOR, seed=0).test
    alone = fit(batch, Hypothesis(BASE, (wrong,)), wall=0.1)
    far = replace(
        fit(batch, Hypothesis(BASE, (right,)), gas_loss=0.2), cost=1e9
    )  # as if it had been left behind
    known = {"wall": alone, "gas_loss": far}
    inquiry = Inquiry(BASE, (wrong, right), batch, SIMULATOR)
    selection = select_stepwise(inquiry, null, test, known, seed=0)
    assert selection.steps[-1].effects == ("gas_loss",)


def test_that_fits_saved_by_amplitudes_far_from_zero_change_no_step(selected, monkeypatch) -> None:
    report, parts = selected
    inquiry = Inquiry(
        BASE, tuple(LIBRARY[name] for name in report.directions), report.batch, SIMULATOR
    )
    monkeypatch.setattr(
        additions, "_CLEAR", float("inf")
    )  # a refit without each effect decides on every step
    slow = select_stepwise(inquiry, report.null, report.gap, report.fits, seed=0)
    assert [step.effects for step in slow.steps] == [step.effects for step in parts.selection.steps]
    assert slow.ended == "adequate"
    assert slow.steps[-1].test.p_value == pytest.approx(
        parts.selection.steps[-1].test.p_value, rel=0.5
    )


def test_that_a_fit_which_does_not_converge_is_no_step_and_that_the_next_best_addition_is_tried(
    selected, monkeypatch
) -> None:
    report, parts = selected
    inquiry = Inquiry(
        BASE, tuple(LIBRARY[name] for name in report.directions), report.batch, SIMULATOR
    )
    (first,) = parts.selection.steps[1].effects
    finished = additions.finished

    def failing(fit, *rest):
        found = finished(fit, *rest)
        alone = set(fit.prior.names) - set(BASE.names) == set(LIBRARY[first].names)
        return replace(found, certificate=replace(found.certificate, converged=not alone))

    monkeypatch.setattr(additions, "finished", failing)
    selection = select_stepwise(inquiry, report.null, report.gap, report.fits, seed=0)
    assert selection.unsettled == (first,)
    assert selection.steps[1].effects != (first,)
    assert all(step.converged for step in selection.steps)
    said = describe(report, replace(parts, selection=selection))
    assert f"{first} was no step, since its fit did not converge." in said
    assert to_json(report, replace(parts, selection=selection))["ladder_unsettled"] == [[first]]


def test_that_an_effect_which_came_next_is_fitted_again_before_those_that_a_score_test_ranks_first(
    monkeypatch,
) -> None:
    batch = shoot({"gas_loss": 0.2}, DESIGNS)
    asked = []
    effects = tuple(
        LIBRARY[name] for name in ("wall", "gas_loss", "refraction", "rinf_bias", "sound_speed")
    )
    wall = Hypothesis(BASE, effects[:1])
    chosen = fit(batch, wall, wall=0.1)

    def search(hypotheses, near, *, starts, **rest):
        asked.append(([h.effects[-1].name for h in hypotheses], starts))
        return {h.name: near for h in hypotheses}

    monkeypatch.setattr(additions, "fit_hypotheses", search)
    monkeypatch.setattr(additions, "_CANDIDATES", 2)
    inquiry = Inquiry(BASE, effects, batch, SIMULATOR)
    left = adequacy_test(chosen, effects, batch, SIMULATOR, seed=0)
    *ahead, last = (
        block.name
        for block in left.test.blocks
        if block.name in {effect.name for effect in effects[1:]}
    )
    other = Hypothesis(BASE, (LIBRARY[last],))
    beaten = fit(batch, other, **{last: 0.05})
    for others in ((), ((other, beaten),)):
        additions.next_step(inquiry, additions.Here(wall, chosen, left, others), {}, set(), seed=0)
    (first, _), (then, starts) = asked
    assert first == ahead[:2]
    assert then == [last, ahead[0]]
    assert starts[last][0] == pytest.approx(
        fitted_values(beaten, LIBRARY[last])
    )  # where the fit in its place has it


def test_that_effects_which_are_not_clearly_worse_are_named_and_no_others() -> None:
    batch = shoot({"rinf_bias": -0.08}, DESIGNS, repeats=1)
    effects = library(("rinf_bias", "excess_gas", "refraction", "sound_speed"))
    report = diagnose(list(batch.experiments), effects=effects, simulator=SIMULATOR)
    parts = examine(report, SIMULATOR)
    base, only = parts.selection.steps
    assert base.alternatives == ()
    assert {*only.effects, *only.alternatives} == {"rinf_bias", "excess_gas"}
    (other,) = only.alternatives
    assert f"Not clearly worse in place of {only.effects[0]}: {other}." in describe(report, parts)
    assert [step["alternatives"] for step in to_json(report, parts)["ladder"]] == [[], [other]]


@pytest.mark.parametrize(("behind", "named"), [(0.9, True), (1.1, False)])
def test_that_the_misfit_that_is_left_counts_when_alternatives_are_sought(
    selected, monkeypatch, behind, named
) -> None:
    monkeypatch.setattr(
        additions, "_CANDIDATES", 1
    )  # the attribution's fits serve, though it had few
    report, parts = selected
    first = parts.selection.steps[1]
    other = report.fits["gas_loss"]
    error = misfit_in_difference(first.fit, other, report.batch)
    assert error > 5.0  # the second effect is missing
    ahead = laplace_evidence(first.fit) - laplace_evidence(other)
    moved = replace(other, cost=other.cost - ahead + (3.0 + 1.645 * error) * behind)
    inquiry = Inquiry(
        BASE, tuple(LIBRARY[name] for name in report.directions), report.batch, SIMULATOR
    )
    selection = select_stepwise(
        inquiry, report.null, report.gap, report.fits | {"gas_loss": moved}, most=1, seed=0
    )
    assert selection.steps[1].effects == first.effects
    assert ("gas_loss" in selection.steps[1].alternatives) == named


@pytest.mark.parametrize("size", [0.0, 1.0, 3.0])
def test_that_the_error_of_an_evidence_difference_is_the_spread_that_misfits_make(
    selected, size
) -> None:
    """Misfits that two frames have in common, each drawn anew, of ``size`` standard deviations of the mean curves."""
    report, parts = selected
    one = parts.selection.steps[2].fit
    other = report.fits["sound_speed"]
    source = torch.Generator().manual_seed(0)
    sd = report.batch.sd(one.prediction) / report.batch.counts.sqrt()
    made = []
    stated = []
    for _ in range(300):
        noise, drawn = (
            torch.randn(sd.shape[0], sd.shape[1] + 1, generator=source, dtype=torch.float64)
            for _ in range(2)
        )
        curves = one.prediction + sd * (
            noise[:, 1:] + size * (drawn[:, 1:] + drawn[:, :-1]) / math.sqrt(2.0)
        )
        rows = zip(report.batch.experiments, curves, strict=True)
        batch = ExperimentBatch(
            tuple(replace(e, radius=c.expand_as(e.radius)) for e, c in rows), report.batch.noise
        )
        apart = [((curves - fit.prediction) / sd).square().sum() / 2.0 for fit in (other, one)]
        made.append(float(apart[0] - apart[1]))
        stated.append(misfit_in_difference(one, other, batch))
    whole = float(torch.tensor(made).var())
    of_noise = float(((one.prediction - other.prediction) / sd).square().sum())
    assert sum(x**2 for x in stated) / 300 == pytest.approx(whole - of_noise, abs=0.2 * whole)


def test_that_what_is_left_of_a_perfect_fit_is_within_its_noise() -> None:
    batch = shoot({}, DESIGNS, repeats=20)
    parts = left_over(fit(batch), batch)
    assert sum(part.misfit**2 for part in parts) < 0.3 * sum(part.noise**2 for part in parts)
    moved = replace(
        fit(batch),
        prediction=fit(batch).prediction + 0.02 * (batch.times > 1.3) * (batch.times < 1.5),
    )
    worst = max(left_over(moved, batch), key=lambda part: part.share)
    assert worst.phase == "first rebound"
    assert 0.0 < worst.misfit <= 0.02


def test_that_there_is_no_selection_without_a_gap() -> None:
    batch = shoot({}, DESIGNS[:1])
    report = diagnose(
        list(batch.experiments), effects=library(("sound_speed",)), simulator=SIMULATOR
    )
    assert examine(report, SIMULATOR) == Parts()
    assert torch.isfinite(torch.tensor(report.gap.p_value))
