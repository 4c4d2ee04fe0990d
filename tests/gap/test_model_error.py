"""Parameters with model error against closed forms, and against truths whose effect is withheld."""

import math

import pytest
import torch

from imr_torch.float64 import eye, tensor
from imr_torch.gap.hypotheses import overdispersion
from imr_torch.gap.model_error import (
    FOUND,
    _with_known,
    _with_unknown,
    hidden_effects,
    missing_system,
    model_error,
)
from imr_torch.material import LIBRARY
from imr_torch.random import generator
from tests.gap.synthetic import BASE, DESIGNS, GEL, diagnose_offered, fit, shoot

OFFERED = ["gas_loss", "wall", "sound_speed", "clock", "strain_stiffening"]


@pytest.fixture(scope="module")
def matched():
    shots = shoot({}, DESIGNS, repeats=3, end=2.4).experiments
    return diagnose_offered(shots, OFFERED)


def test_that_the_budget_is_that_of_generalised_least_squares(matched):
    """Integrating over what may be missing is noise of covariance ``1 + s^2 B^T B``."""
    line = matched.left.line
    system = missing_system(matched.left)
    rows = system.unknown.mT
    refit = system.solve(2.0)
    fitted = line.fitted.shape[1]
    root = refit.root[:fitted]
    covariance = eye(len(line.residual)) + 4.0 * rows.mT @ rows
    weighted = torch.linalg.solve(covariance, line.fitted)
    information = line.fitted.mT @ weighted
    right = weighted.mT @ line.residual
    expected = torch.linalg.solve(information, right)
    assert torch.allclose(refit.solution[:fitted], expected, atol=1e-7)
    variance = torch.linalg.inv(information)
    assert torch.allclose(root @ root.mT, variance, rtol=1e-5, atol=1e-12)
    square = line.residual @ torch.linalg.solve(covariance, line.residual)
    assert refit.misfit == pytest.approx(float(square - right @ expected), rel=1e-6)
    log_det = -0.5 * (torch.logdet(covariance) + torch.logdet(information))
    assert refit.log_volume == pytest.approx(float(log_det), abs=1e-5)


def test_that_all_that_hides_is_together_as_large_as_two_effects(matched):
    """Without a gap the draws are those of one budget of that size."""
    refit = missing_system(matched.left).solve(2.0 / math.sqrt(len(OFFERED)))
    ((fitted, drawn),) = _with_unknown(matched, 20000, generator(0), inside=True)
    gel = slice(len(fitted.mean))
    noise = max(1.0, refit.misfit / int(matched.batch.mask.sum()))
    sds = refit.root[gel].norm(dim=1) * math.sqrt(noise)
    assert torch.allclose(drawn.std(0), sds, rtol=0.03)
    assert torch.allclose(drawn.mean(0), fitted.mean + refit.solution[gel], atol=0.04)


def test_that_intervals_with_model_error_hold_those_of_the_right_model(matched):
    found = model_error(matched)
    levels = tensor((0.05, 0.95))
    right = matched.null.posterior.quantile(levels)
    for i, (name, (low, middle, high)) in enumerate(found.intervals.items()):
        assert low < middle < high
        assert high - low >= 0.95 * (right[1, i] - right[0, i])
        assert low < GEL[name] < high


def test_that_they_hold_truths_whose_effect_is_withheld_more_often_than_those_of_the_fit():
    """Effects of a usual size, each withheld in turn: of sixteen values the fit's intervals hold few."""
    usual = {"gas_loss": 0.06, "wall": 0.04, "sound_speed": 0.3, "clock": 0.01}
    levels = tensor((0.05, 0.5, 0.95))
    wide = 0
    right = 0
    for seed, (name, size) in enumerate([*usual.items(), *usual.items()]):
        shots = shoot({name: size}, DESIGNS, repeats=3, end=2.4, seed=10 + seed)
        others = [other for other in OFFERED if other != name]
        report = diagnose_offered(shots.experiments, others, seed=seed)
        found = model_error(report)
        low, _, high = report.null.posterior.quantile(levels)
        for i, parameter in enumerate(BASE.names):
            truth = GEL[parameter]
            wide += found.intervals[parameter][0] < truth < found.intervals[parameter][2]
            right += bool(low[i] < truth < high[i])
    assert right <= 6
    assert wide >= 13


def test_that_half_of_an_unknown_are_the_gels_beside_effects_that_come_near():
    """In proportion to a likelihood of twenty independent values, and with the misfit as noise."""
    shots = shoot({"alpha": 0.4}, DESIGNS, repeats=3, end=2.4, seed=3)
    report = diagnose_offered(shots.experiments, OFFERED[:-1], seed=3)
    assert report.found
    drawn = {id(known): moved for known, moved in _with_known(report, 20000, generator(0))}
    fits = [known for step in report.steps for known in step.fits.values()]
    misfits = [overdispersion(known, report.batch) for known in fits]
    weights = [math.exp(-10.0 * (misfit / min(misfits) - 1.0)) for misfit in misfits]
    for known, misfit, weight in zip(fits, misfits, weights, strict=True):
        share = weight / sum(weights)
        count = len(drawn.get(id(known), ()))
        assert count == pytest.approx(
            20000 * share, abs=4.0 * math.sqrt(20000 * share) + 1.0
        )
        if count > 1000:
            covariance = misfit * known.chol @ known.chol.mT
            assert torch.allclose(drawn[id(known)].mean(0), known.mean, atol=0.2)
            assert torch.allclose(
                drawn[id(known)].mT.cov(), covariance, rtol=0.2, atol=0.02
            )


def test_that_an_effect_of_the_size_that_is_said_is_found_as_often_as_is_said(matched):
    rows = {row.effect: row for row in hidden_effects(matched)}
    row = rows["gas_loss"]
    found = 0
    for seed in range(12):
        shots = shoot({"gas_loss": row.size}, DESIGNS, repeats=3, end=2.4, seed=50 + seed)
        report = diagnose_offered(shots.experiments, ["gas_loss"], seed=seed)
        found += report.gap.found
    assert found >= 8
    assert FOUND == 0.9


def test_that_an_unseen_effect_moves_the_gel_as_a_refit_says(matched):
    row = {row.effect: row for row in hidden_effects(matched)}["gas_loss"]
    small = 0.5 * row.size
    moved = fit(shoot({"gas_loss": small}, DESIGNS, repeats=0, end=2.4)).posterior.means
    before = fit(shoot({}, DESIGNS, repeats=0, end=2.4)).posterior.means
    for name, change in zip(BASE.names, (moved / before - 1.0).tolist(), strict=True):
        assert 0.5 * row.shift[name] == pytest.approx(change, rel=0.4, abs=0.01)


def test_that_every_effect_that_was_offered_has_a_row_of_what_would_hide(matched):
    rows = hidden_effects(matched)
    assert {row.effect for row in rows} == set(OFFERED) <= set(LIBRARY)
    largest = [max(map(abs, row.shift.values())) for row in rows]
    assert largest == sorted(largest, reverse=True)
