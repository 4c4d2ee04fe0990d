import math

import pytest
import torch

from imr_torch.errors import InputDataError
from imr_torch.gap import locate
from imr_torch.gap.latent import CAVEAT, latent_pressure, matern
from imr_torch.gap.locate import Trend, by_experiment, onset
from imr_torch.gap.restrict import calibrate, draw_residuals, refit, restrict
from imr_torch.gap.windows import moving_windows
from imr_torch.goodness.linear import Linearisation, linearise
from imr_torch.goodness.phases import PHASES, phase_clock, phase_name
from imr_torch.observe import Nuisance
from tests.gap.synthetic import DESIGNS, SIMULATOR, fit, shoot

CASES = {
    "matched": ({}, "none"),
    "start": ({"residual_velocity": 0.04}, "start"),
    "collapse": ({"gas_loss": 0.15}, "first collapse"),
    "pulse": ({"pulse": 0.05, "pulse_time": 1.7, "pulse_width": -2.0}, "second collapse"),
}


@pytest.fixture(scope="module")
def cases():
    """Name -> batch, fit and its neighbourhood, made once each."""
    found = {}

    def get(name: str):
        if name not in found:
            batch = shoot(CASES[name][0])
            best = fit(batch)
            found[name] = best, linearise(best, batch, SIMULATOR), batch, SIMULATOR
        return found[name]

    return get


def test_that_the_phase_clock_reads_one_at_the_first_collapse_and_two_at_the_second() -> None:
    times = torch.linspace(0.0, 5.0, 501, dtype=torch.float64)[None]
    curve = (torch.cos(0.5 * math.pi * times)).abs()  # collapses at 1, 3 and 5, tops at 2 and 4
    clock = phase_clock(times, curve, torch.ones_like(times, dtype=torch.bool))[0]
    expected = torch.where(times[0] <= 1.0, times[0], 0.5 * (times[0] + 1.0))
    assert torch.allclose(clock, expected, atol=1e-9)
    assert [phase_name(c) for c in (0.2, 0.9, 1.5, 2.0, 2.5)] == list(PHASES)


def test_that_the_phase_clock_runs_on_where_a_record_ends_before_any_collapse() -> None:
    times = torch.linspace(0.0, 0.5, 11, dtype=torch.float64)[None]
    clock = phase_clock(times, 1.0 - times, torch.ones_like(times, dtype=torch.bool))
    assert torch.isfinite(clock).all()
    assert phase_name(float(clock[0, -1])) == "first collapse"


@pytest.mark.parametrize("name", CASES)
def test_that_the_onset_is_in_the_phase_in_which_the_effect_acts_and_silent_on_matched_data(
    cases, name: str
) -> None:
    found = onset(*cases(name), seed=1)
    assert found.phase == CASES[name][1], str(found)
    assert math.isnan(found.time) == (name == "matched")
    assert found.phase in str(found) or name == "matched"


def test_that_a_linear_refit_to_all_frames_stays_and_to_some_frames_is_the_nonlinear_one() -> None:
    batch = shoot({}, repeats=50, nuisance=Nuisance(time_zero=0.004))
    best = fit(batch)
    line = linearise(best, batch, SIMULATOR)
    shift, to_shift = refit(line)
    size = len(best.mean)
    sd = to_shift.norm(dim=1)
    assert (
        float((shift / sd).abs().max()) < 0.2
    )  # the noise law's own slope is all that differs from least squares
    assert torch.allclose(sd[:size], torch.linalg.norm(best.chol, dim=1), rtol=0.05)
    early = type(batch)(tuple(e.until(1.5) for e in batch.experiments))
    shift, to_shift = refit(restrict(line, batch.times <= 1.5 + 1e-9))
    nonlinear = fit(early).mean - best.mean
    assert float(((shift[:size] - nonlinear) / to_shift[:size].norm(dim=1)).abs().max()) < 0.2


def test_that_calibrated_p_values_are_those_of_the_smallest_of_all_tests() -> None:
    drawn = torch.rand(
        3, 4000, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    ).log()
    observed = [
        torch.tensor([0.02, 0.5], dtype=torch.float64).log(),
        torch.tensor([1e-9], dtype=torch.float64).log(),
    ]
    p_values = calibrate(observed, [drawn[:2], drawn[2:]])
    assert float(p_values[0]) == pytest.approx(1.0 - 0.98**3, abs=0.01)
    assert float(p_values[1]) == pytest.approx(3e-9)
    assert float(calibrate([torch.zeros(0), observed[1]], [drawn[:0], drawn])[0]) == 1.0


def test_that_designs_are_silent_and_parameters_steady_on_matched_data(cases) -> None:
    found = by_experiment(*cases("matched"), seed=1)
    assert min(found.p_values) > 0.05
    assert max(abs(t.z) for t in found.trends) < 3.0
    assert "No fitted parameter drifts" in found.reading
    truth = torch.tensor([8e3, 0.08], dtype=torch.float64)
    sd = 0.5 * (found.high - found.low)
    assert float(((found.values - truth) / sd).abs().max()) < 3.5


def test_that_an_effect_of_the_rate_shows_as_a_drift_of_viscosity_over_we(cases) -> None:
    found = by_experiment(*cases("collapse"), seed=1)
    assert max(found.p_values) < 1e-6
    assert any(t.parameter == "mu" and t.over == "We" and abs(t.z) > 5.0 for t in found.trends)
    assert "rate or size" in found.reading
    assert "do not tell" in found.reading  # two designs differ in both coordinates at once


def test_that_a_drift_over_one_coordinate_or_over_enough_designs_is_called_by_its_name() -> None:
    steady = Trend("G", "R_inf*", 0.0, 0.5)
    over_weber = Trend("mu", "We", 1.0, 9.0)
    over_rest = Trend("G", "R_inf*", 1.0, 9.0)
    assert (
        locate._read((over_weber, steady), 0.01, 2)
        == "Fitted parameters drift: mu over We (points to rate or size)."
    )
    both = locate._read((over_weber, over_rest), 0.01, 4)
    assert "mu over We" in both
    assert "G over R_inf*" in both
    assert "2 experiments do not tell" in locate._read((over_weber, over_rest), 0.01, 2)


def test_that_one_design_shows_no_trends() -> None:
    batch = shoot({}, DESIGNS[:1])
    best = fit(batch)
    found = by_experiment(best, linearise(best, batch, SIMULATOR), batch, SIMULATOR, seed=1)
    assert found.trends == ()
    assert "one design" in found.reading


def test_that_a_latent_pressure_recovers_a_pulse_and_is_nothing_on_matched_data(cases) -> None:
    batch = shoot({"pulse": -0.05, "pulse_time": 0.5, "pulse_width": -1.2}, DESIGNS)
    best = fit(batch)
    found = latent_pressure(best, linearise(best, batch, SIMULATOR), batch, SIMULATOR)
    truth = -0.05 * torch.exp(-(((found.times - 0.5) / math.exp(-1.2)) ** 2))
    assert float(torch.corrcoef(torch.stack((truth, found.mean)))[0, 1]) > 0.75
    assert found.log_bayes > 20.0
    assert found.caveat == CAVEAT
    silent = latent_pressure(*cases("matched"))
    assert silent.log_bayes < 3.0
    assert float((silent.mean / silent.sd).abs().max()) < 3.0


def test_that_the_latent_prior_is_matern_three_halves() -> None:
    times = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)
    root = matern(times, 0.4)
    gap = math.sqrt(3.0) * 0.6 / 0.4
    assert float((root @ root.mT)[0, 3]) == pytest.approx((1.0 + gap) * math.exp(-gap), abs=1e-8)


def test_that_apparent_parameters_are_constant_on_matched_data_and_drift_with_an_effect(
    cases,
) -> None:
    steady = moving_windows(*cases("matched"), windows=4)
    assert float(steady.p_constant.min()) > 0.01
    assert float(steady.drift.abs().max()) < 3.0
    drifting = moving_windows(*cases("collapse"), windows=4)
    assert float(drifting.p_constant.max()) < 1e-6
    assert float(drifting.drift[0]) > 5.0


def test_that_p_values_of_constant_parameters_are_uniform(cases) -> None:
    """Frequency, not luck:

    the windows' estimates are linear in the noise, so many draws cost nothing.
    """
    from imr_torch.gap.windows import _constancy

    line: Linearisation = cases("matched")[1]
    batch = cases("matched")[2]
    starts = torch.linspace(0.0, 2.0, 4, dtype=torch.float64)
    maps = torch.stack(
        [
            refit(restrict(line, (batch.times >= s) & (batch.times <= s + 1.0)))[1][:2]
            for s in starts.tolist()
        ]
    )
    drawn = draw_residuals(line, seed=3, count=300)
    p_values = torch.stack([_constancy(starts, maps @ noise, maps)[1] for noise in drawn])
    assert 0.01 < float((p_values < 0.05).double().mean()) < 0.09


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda case: moving_windows(*case, windows=1), "2 windows or more"),
        (lambda case: moving_windows(*case, width=9.0), "0 < width < 3"),
        (lambda case: latent_pressure(*case, knots=3), "at least 4 knots"),
    ],
)
def test_that_a_bad_request_says_what_was_expected(cases, call, message: str) -> None:
    with pytest.raises(InputDataError, match=message):
        call(cases("matched"))
