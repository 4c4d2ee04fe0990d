"""Parameters with model error against closed forms, and against truths whose effect is withheld."""

import pytest
import torch

from imr_torch.gap import diagnose, library
from imr_torch.gap.hidden import FOUND, hidden_effects
from imr_torch.gap.model_error import _groups, _Place, _Unknown, model_error
from imr_torch.material import LIBRARY
from tests.gap.synthetic import BASE, DESIGNS, GEL, SIMULATOR, fit, shoot

OFFERED = ["gas_loss", "wall", "sound_speed", "clock", "strain_stiffening"]


@pytest.fixture(scope="module")
def matched():
    shots = shoot({}, DESIGNS, repeats=3, end=2.4).experiments
    return diagnose(shots, effects=library(OFFERED), simulator=SIMULATOR)


@pytest.fixture(scope="module")
def withheld():
    shots = shoot({"gas_loss": 0.06}, DESIGNS, repeats=3, end=2.4).experiments
    offered = [name for name in OFFERED if name != "gas_loss"]
    return diagnose(shots, effects=library(offered), simulator=SIMULATOR)


def test_that_the_shift_with_one_unknown_is_that_of_generalised_least_squares(matched) -> None:
    """Integrating over the unknown is noise of covariance ``1 + B B^T``."""
    place = _Place(matched.null, matched.left, 1.0)
    unknown = _Unknown(place, True, 0.0)
    option = next(o for o in unknown.options if len(o.groups) == 1 and float(o.scale[-1]) == 1.0)
    (group,) = option.groups
    line = matched.left.line
    rows = _groups(matched.left, True)[group]
    covariance = torch.eye(len(line.residual), dtype=torch.float64) + rows.mT @ rows
    weighted = torch.linalg.solve(covariance, line.fitted)
    information = line.fitted.mT @ weighted
    expected = torch.linalg.solve(information, weighted.mT @ line.residual)
    mean, sd = unknown.moments(line.residual, [option])
    size = len(mean)
    assert torch.allclose(mean, expected[:size], atol=1e-8)
    misfit = unknown.seen(line.residual, option)[1] / int(matched.batch.mask.sum())
    variance = max(misfit, 1.0) * torch.linalg.inv(information).diagonal()[:size]
    assert torch.allclose(sd, variance.sqrt(), rtol=1e-6)


def test_that_the_misfit_is_that_of_the_same_covariance(matched) -> None:
    unknown = _Unknown(_Place(matched.null, matched.left, 1.0), True, 0.0)
    option = unknown.options[0]
    (group,) = option.groups
    line = matched.left.line
    rows = float(option.scale[-1]) * _groups(matched.left, True)[group]
    covariance = torch.eye(len(line.residual), dtype=torch.float64) + rows.mT @ rows
    weighted = torch.linalg.solve(covariance, line.fitted)
    right = weighted.mT @ line.residual
    square = line.residual @ torch.linalg.solve(covariance, line.residual)
    expected = square - right @ torch.linalg.solve(line.fitted.mT @ weighted, right)
    assert unknown.seen(line.residual, option)[1] == pytest.approx(float(expected), rel=1e-6)


def test_that_a_library_without_an_effect_does_not_hold_it(matched) -> None:
    unknown = _Unknown(_Place(matched.null, matched.left, 1.0), True, 0.0)
    assert all(2 not in option.groups for option in unknown.without(2))
    assert len(unknown.without(2)) == len(unknown.options) - 3


def test_that_intervals_with_model_error_hold_those_of_the_right_model(matched) -> None:
    found = model_error(matched)
    levels = torch.tensor((0.05, 0.95), dtype=torch.float64)
    right = matched.null.posterior.quantile(levels)
    for i, (name, (low, middle, high)) in enumerate(found.intervals.items()):
        assert low < middle < high
        assert high - low >= 0.95 * float(right[1, i] - right[0, i])
        assert low < GEL[name] < high
    assert found.unknown == 1.0


def test_that_they_hold_the_truth_where_an_effect_is_withheld_and_those_of_the_fit_do_not(
    withheld,
) -> None:
    found = model_error(withheld)
    biased = fit(withheld.batch).posterior.quantile(torch.tensor((0.05, 0.95)).double())
    outside = [
        not low < GEL[name] < high
        for name, low, high in zip(BASE.names, *biased.tolist(), strict=True)
    ]
    assert any(outside)
    for name, (low, _, high) in found.intervals.items():
        assert low < GEL[name] < high
    assert found.bound["G"] > 1.0


def test_that_an_effect_of_the_size_that_is_said_is_found_as_often_as_is_said(matched) -> None:
    rows = {row.effect: row for row in hidden_effects(matched)}
    row = rows["gas_loss"]
    found = 0
    for seed in range(12):
        shots = shoot({"gas_loss": row.size}, DESIGNS, repeats=3, end=2.4, seed=50 + seed)
        effects = library(["gas_loss"])
        report = diagnose(shots.experiments, effects=effects, simulator=SIMULATOR, seed=seed)
        found += report.gap.found
    assert found >= 8
    assert FOUND == 0.9


def test_that_an_unseen_effect_moves_the_gel_as_a_refit_says(matched) -> None:
    row = {row.effect: row for row in hidden_effects(matched)}["gas_loss"]
    small = 0.5 * row.size
    moved = fit(shoot({"gas_loss": small}, DESIGNS, repeats=0, end=2.4)).posterior.means
    before = fit(shoot({}, DESIGNS, repeats=0, end=2.4)).posterior.means
    for name, change in zip(BASE.names, (moved / before - 1.0).tolist(), strict=True):
        assert 0.5 * row.shift[name] == pytest.approx(change, rel=0.4, abs=0.01)


def test_that_every_effect_that_was_offered_has_a_row_of_what_would_hide(matched) -> None:
    rows = hidden_effects(matched)
    assert {row.effect for row in rows} == set(OFFERED) <= set(LIBRARY)
    largest = [max(map(abs, row.shift.values())) for row in rows]
    assert largest == sorted(largest, reverse=True)
    assert all(row.sentence().startswith(row.effect) for row in rows)
