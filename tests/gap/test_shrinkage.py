"""Shrinkage on unseen curves: what freedom and random effects earn, that the selection does not see
the curve that judges, and that the interval covers.
"""

import math
from dataclasses import replace

import pytest
import torch
from scipy.optimize import minimize

from imr_torch.assimilate import Point, Posterior
from imr_torch.float64 import arange, linspace, rand, randn, tensor, zeros
from imr_torch.gap.held_out import HeldOut, Judged, default_folds, held_out, judge_designs
from imr_torch.gap.hypotheses import Hypothesis
from imr_torch.gap.shrinkage import (
    Shrinkage,
    _interval,
    shrinkage,
)
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance
from imr_torch.random import generator
from tests.gap.synthetic import BASE, DESIGNS, SIMULATOR, diagnose_offered, fit, shoot

RIVALS = ["wall", "sound_speed"]


def diagnose_loss(offered):
    shots = shoot({"gas_loss": 0.3}, DESIGNS, repeats=10, end=2.4).experiments
    return diagnose_offered(shots, offered)


@pytest.fixture(scope="module")
def right():
    return diagnose_loss(["gas_loss", *RIVALS])


@pytest.fixture(scope="module")
def withheld():
    return diagnose_loss(RIVALS)


def test_that_the_right_effect_closes_the_gap_and_random_ones_do_not(right):
    found = shrinkage(right, SIMULATOR)
    low, middle, high = found.share
    assert low <= middle <= high
    assert low > 0.85
    assert abs(middle - 1.0) < 0.1
    assert found.later[1] > 0.85
    assert found.selected == (("gas_loss",),) * 3
    assert found.converged
    assert len(found.placebo) == 20
    assert found.placebo_high < 0.5
    assert found.word(right.adequacy_p) == "closed"


def test_that_what_was_selected_in_its_place_is_not_called_closed(withheld):
    found = shrinkage(withheld, SIMULATOR)
    assert withheld.verdict == "other"
    assert found.share[0] < 0.85
    assert found.word(withheld.adequacy_p) != "closed"


def test_that_each_experiment_is_held_out_once_and_at_most_a_quarter_of_many_at_a_time():
    for count in (2, 5, 6, 10):
        groups = default_folds(count)
        assert sorted(i for group in groups for i in group) == list(range(count))
        assert max(len(group) for group in groups) <= max(1, math.ceil(count / 4))


def test_that_curves_held_out_before_the_fits_judge_what_was_selected_with_all(right):
    unseen = shoot(
        {"gas_loss": 0.3}, ((300.0, 0.22), (550.0, 0.18)), repeats=10, seed=7, end=2.4
    )
    found = shrinkage(right, SIMULATOR, unseen)
    assert found.share[1] == pytest.approx(1.0, abs=0.1)
    assert len(found.selected) == 2


def test_that_the_curve_that_judges_has_no_say_in_what_is_selected():
    """An effect that acts in one curve alone is not selected without it."""
    quiet = shoot({}, DESIGNS[:2], repeats=10, end=2.4).experiments
    (loud,) = shoot({"gas_loss": 0.6}, DESIGNS[2:], repeats=10, end=2.4).experiments
    shots = (*quiet, replace(loud, label="loud"))
    report = diagnose_offered(shots, ["gas_loss", *RIVALS])
    judged = judge_designs(report, SIMULATOR, seed=0)
    held = {
        pair.base.line.batch.experiments[0].label: pair.effect.hypothesis for pair in judged
    }
    assert "gas_loss" in report.selected.parts
    assert held["loud"].parts == ()


def pair(bias: float, freedom: int, seed: int) -> Judged:
    """A held-out design whose effect predicts no better than the base, with more freedom of its own."""
    source = generator(seed)
    times = linspace(0.0, 2.4, 90)
    radius = 0.2 + 0.8 * torch.cos(1.7 * times).abs()
    batch = ExperimentBatch((Experiment("shot", (400.0, 0.2), times, radius[None]),))
    rows = arange(90) / 90.0
    numbers = arange(freedom)
    smooth = torch.cos(torch.pi * rows[:, None] * numbers)
    gap = bias * torch.sin(7.0 * rows + 6.0 * rand(1, generator=source))
    residual = gap + randn(90, generator=source)
    nothing = zeros(90, 0)

    class Line:
        pass

    line = Line()
    line.batch = batch

    def held(by_nuisance: torch.Tensor) -> HeldOut:
        fitted = (
            torch.linalg.lstsq(by_nuisance, residual).solution
            if by_nuisance.numel()
            else None
        )
        left = residual if fitted is None else residual - by_nuisance @ fitted
        values = zeros(0) if fitted is None else fitted
        return HeldOut(Hypothesis(BASE), left, by_nuisance, values, nothing, line, True)

    return Judged(held(nothing), held(smooth), line)


@pytest.mark.parametrize("freedom", [2, 4, 8])
def test_that_freedom_alone_earns_nothing(freedom):
    """Directions of its own close much of a gap in the plain residual, and none of it here."""
    plain = []
    beside = []
    for seed in range(30):
        judged = pair(3.0, freedom, seed)
        squares = [float(x.residual.square().sum()) for x in (judged.base, judged.effect)]
        plain.append(1.0 - (squares[1] - 90 + freedom) / (squares[0] - 90))
        base, effect = judged.excess_by_phase().sum(1)
        beside.append(float(base - effect))
    assert sum(plain) / 30 > 0.1
    assert max(map(abs, beside)) < 1e-9


@pytest.mark.parametrize(("curves", "phases"), [(8, 1), (3, 5), (2, 5)])
def test_that_the_interval_covers_the_mean_over_curves(curves, phases):
    """Squared gaps scatter between curves and between phases of a curve; the interval is for the mean
    over all curves there are.
    """
    source = generator(0)
    inside = 0
    for _ in range(600):
        base = 5.0 + 10.0 * rand(curves, phases, generator=source)
        share = 0.6 + 0.2 * (
            randn(curves, 1, generator=source) + randn(curves, phases, generator=source)
        )
        rows = torch.stack((base, base * (1.0 - share)), 1)
        low, middle, high = _interval(rows, source)
        assert low <= middle <= high
        inside += low <= 0.6 <= high
    assert 0.83 <= inside / 600 <= 0.95


def test_that_words_need_more_than_random_effects_close():
    found = Shrinkage(
        (0.7, 0.8, 0.9), None, (0.1,) * 19 + (0.2,), 1.0, 0.0, (("wall",),), True
    )
    assert found.word(0.5) == "closed"
    assert found.word(0.01) == "partly closed"
    chance = replace(found, placebo=(0.75,) * 20)
    assert chance.word(0.5) == "partly closed, not told from chance"
    assert replace(found, placebo=(0.85,) * 20).word(0.5) == "not closed"
    assert replace(found, share=None, placebo=()).word(0.5) == "no gap left"


def test_that_nothing_is_judged_without_an_effect_or_a_second_curve(right):
    nothing = replace(right, selected=Hypothesis(BASE))
    assert shrinkage(nothing, SIMULATOR) is None
    one = replace(right.batch, experiments=right.batch.experiments[:1])
    assert judge_designs(replace(right, batch=one), SIMULATOR, seed=0) == []


def test_that_a_curve_which_the_model_misses_is_judged_at_its_most_probable_nuisances():
    """Another gel makes full Gauss-Newton steps overshoot, and the collapse makes minima of time
    zero: no search by SciPy ends lower.
    """
    unsure = Nuisance(0.01, 0.02, 0.03)
    stiff = {"G": 3e4, "mu": 0.2}
    shot = shoot(stiff, ((400.0, 0.25),), repeats=1, seed=3, nuisance=unsure)
    one = replace(shot, noise=Noise(scale=0.004, slope=0.0, floor=1.0))
    known = fit(shoot({}))
    posterior = Posterior(known.prior, one, SIMULATOR)

    def cost(own):
        point = Point(known.mean[None], tensor(own).reshape(1, 1, 3))
        return -float(posterior.log_joint(point).nan_to_num(nan=-1e9))

    found = held_out(known, Hypothesis(BASE), one, SIMULATOR).nuisances
    starts = ([0.0, time, 0.0] for time in (-4.0, 0.0, 4.0))
    lowest = min(minimize(cost, start, method="Nelder-Mead").fun for start in starts)
    assert cost(found.tolist()) < lowest + 0.5


def test_that_a_quiet_phase_takes_nothing_from_the_gap():
    """Late frames of noise far below the law would cancel what is left of the gap in early ones."""
    gaps = []
    for seed in range(12):
        judged = pair(0.0, 0, seed)
        phase = judged.phase
        noise = randn(90, generator=generator(seed))
        residual = torch.where(phase < 2, noise + 1.0, 0.1 * noise)
        loud = replace(judged.base, residual=residual)
        excess = replace(judged, base=loud, effect=loud).excess_by_phase()[0]
        gaps.append(float(excess.sum()) / int((phase < 2).sum()))
    assert sum(gaps) / 12 == pytest.approx(1.0, abs=0.3)
