"""Collapse times as data: the time of the minimum, its likelihood, coverage of what is inferred,
files, and their refusal.
"""

import math

import pytest
import torch
from torch.testing import assert_close

from imr_torch import PolytropicSimulator
from imr_torch.float64 import arange, full, linspace, ones, rand, randn, tensor, zeros
from imr_torch.material import PARAMETERS
from imr_torch.observe import (
    CollapseShot,
    CollapseTime,
    Experiment,
    ExperimentBatch,
    Nuisance,
    TraceSet,
    load_collapse_times,
    load_traces,
    predict,
)
from imr_torch.observe.collapse import serial_correlation
from imr_torch.observe.prediction import NodeTimes, _simulate_bubbles, predict_collapse
from imr_torch.random import generator
from imr_torch.units import Surroundings
from tests.filmed import characterize_quickly, film
from tests.refusals import refused

GEL = {"G": 8000.0, "mu": 0.1}
SIMULATOR = PolytropicSimulator()
HEADER = "experiment_id,rmax_m,stretch,collapse_time_s"
ROW = "a,3.4e-4,8.0,3.05e-5"


def designs(*pairs: tuple[float, float]) -> torch.Tensor:
    return tensor(pairs)


def gels_of(**values: list[float]) -> torch.Tensor:
    """One gel for each of the values, as ``GEL`` in what is not named."""
    changed = {name: tensor(value) for name, value in values.items()}
    return PARAMETERS.pack(GEL | changed)


def predict_each(
    gels: torch.Tensor, where: torch.Tensor, measured: torch.Tensor, shifts=None
):
    """The times of shots, each predicted without the others."""
    alone = [
        predict_collapse(
            SIMULATOR,
            gels,
            where[[i]],
            measured[[i]],
            None if shifts is None else shifts[:, [i]],
        )
        for i in range(len(measured))
    ]
    return torch.cat(alone, 1)


def shots(
    count: int,
    *,
    seed: int = 0,
    scatter: float = 0.0,
    timing: float = 0.001,
    gel: torch.Tensor | None = None,
) -> tuple[CollapseShot, ...]:
    """Simulated shots with the errors that they state, and ``scatter`` (over Rmax/U_c) beyond these."""
    source = generator(seed)
    medium = Surroundings()
    sizes = 200e-6 + 200e-6 * rand(count, generator=source)
    stretch = 5.0 + 4.0 * rand(count, generator=source)
    true = torch.stack((medium.weber(sizes), 1.0 / stretch), 1)
    gel = PARAMETERS.pack(GEL) if gel is None else gel
    t = predict_collapse(SIMULATOR, gel, true, full((count,), 0.92))
    e = randn(3, count, generator=source)
    scale = medium.time_scale(sizes)
    measured = (t + math.hypot(timing, scatter) * e[0]) * scale
    rows = zip(
        sizes * (1.0 + 0.003 * e[1]),
        stretch * (1.0 + 0.01 * e[2]),
        measured,
        timing * scale,
        strict=True,
    )
    return tuple(
        CollapseShot(f"shot {i}", float(r), float(s), float(c), float(sd))
        for i, (r, s, c, sd) in enumerate(rows)
    )


def fitted(data: tuple[CollapseShot, ...], traces: TraceSet | None = None, **options):
    how = {"rest_radius": None, "check": False} | options
    return characterize_quickly(traces or TraceSet(()), shots=data, **how)


@pytest.mark.parametrize("gel", [{"G": 500.0, "mu": 0.01}, GEL, {"G": 60e3, "mu": 0.3}])
def test_that_the_time_is_that_of_a_dense_grid(gel):
    where = designs((240.0, 0.13), (400.0, 0.22), (150.0, 0.35))
    parameters = PARAMETERS.pack(gel)
    found = predict_collapse(SIMULATOR, parameters, where, full((3,), 0.9))
    for design, time in zip(where, found, strict=True):
        grid = float(time) + linspace(-2e-3, 2e-3, 4001)
        radius = SIMULATOR(parameters, design, grid).radius
        assert abs(grid[radius.argmin()] - time) < 2e-6
        assert 0 < int(radius.argmin()) < 4000


@pytest.fixture
def thirty() -> tuple[torch.Tensor, torch.Tensor]:
    """Designs and measured times of so many shots."""
    many = [shot.to_experiment(Surroundings()) for shot in shots(30, seed=5)]
    return tensor([shot.design for shot in many]), tensor([shot.time for shot in many])


@pytest.fixture
def made(monkeypatch) -> list[int]:
    """Bubbles of each simulation."""
    counts = []

    def count_bubbles(*args, **options):
        bubbles = _simulate_bubbles(*args, **options)
        counts.append(bubbles[0].shape[-2] * bubbles[0].shape[0])
        return bubbles

    monkeypatch.setattr("imr_torch.observe.prediction._simulate_bubbles", count_bubbles)
    return counts


def test_that_a_gel_which_collapses_in_some_shots_alone_is_simulated_and_no_other(
    thirty, made
):
    gels = gels_of(mu=[0.1, 0.7])
    found = predict_collapse(SIMULATOR, gels, *thirty)
    assert made == [24, 12, 24, 30, 30, 30]  # 12 nodes
    alone = predict_each(gels, *thirty)
    assert_close(found, alone, rtol=0.0, atol=5e-5, equal_nan=True)
    assert 0 < int(found[1].isnan().sum()) < 30


def test_that_gels_of_the_last_call_are_not_simulated_again_and_no_second_time(
    thirty, made
):
    gels = gels_of(mu=[0.1, 0.2])
    shifts = zeros(2, 30, 3)
    shifts[1, :, 2] = 0.01
    kept = NodeTimes()
    for own in (None, shifts):
        found = predict_collapse(SIMULATOR, gels, *thirty, own, kept=kept)
        assert made == [24]
        precise = predict_collapse(SIMULATOR, gels, *thirty, own)
        assert 0.0 < (found - precise).abs().max() < 1e-4
        del made[1:]
    predict_collapse(SIMULATOR, 1.01 * gels, *thirty, kept=kept)
    assert made == [24, 24]


@pytest.mark.parametrize("bundled", [False, True])
def test_that_times_of_many_shots_are_those_of_each_by_itself(bundled, thirty):
    """Interpolated between designs they are as right as simulated ones, nuisances and slopes too."""
    where, measured = thirty
    gels = gels_of(G=[8000.0, 8000.0, 8040.0, 2000.0], mu=[0.1, 0.1, 0.1, 0.05])
    shifts = zeros(4, 30, 3)
    shifts[1] = torch.tensor([0.003, 0.0, 0.01])
    together = predict_collapse(SIMULATOR, gels, where, measured, shifts, bundled=bundled)
    alone = predict_each(gels, where, measured, shifts)
    assert (together - alone).abs().max() < 5e-5
    moved, moved_alone = ((times[1] - times[0])[7] for times in (together, alone))
    assert moved == pytest.approx(float(moved_alone), rel=0.01)


def test_that_the_time_is_smooth_in_the_gel():
    """Its slope over steps of 1e-6 and 1e-3 agrees: a gradient of 1e-3 standard deviations can be
    reached.
    """
    where = designs((240.0, 0.133))
    measured = tensor([0.91])
    slopes = []
    for step in (1e-6, 1e-3):
        gels = gels_of(G=[8000.0 * (1.0 - step), 8000.0 * (1.0 + step)])
        low, high = predict_collapse(SIMULATOR, gels, where, measured)[:, 0].tolist()
        slopes.append((high - low) / (2.0 * step))
    assert slopes[0] == pytest.approx(slopes[1], rel=2e-4)


def test_that_nuisances_move_the_time_as_another_design_does():
    where = designs((240.0, 0.13))
    parameters = PARAMETERS.pack(GEL)
    shifts = tensor([[0.02, 0.0, -0.03]])
    measured = tensor([0.91])
    found = predict_collapse(SIMULATOR, parameters, where, measured, shifts)
    true = designs((240.0 * 1.02, 0.13 * 0.97 / 1.02))
    assert found == pytest.approx(
        1.02 * float(predict_collapse(SIMULATOR, parameters, true, measured)), rel=1e-7
    )
    impossible = tensor([[-2.0, 0.0, 0.0]])
    assert math.isnan(
        float(predict_collapse(SIMULATOR, parameters, where, measured, impossible))
    )


def test_that_a_batch_predicts_curves_and_times_each_as_alone():
    times = linspace(0.0, 2.0, 21)
    curve = Experiment("c", (400.0, 0.22), times, ones(1, 21), exposure=0.02)
    timed = CollapseTime(
        "t", (240.0, 0.13), 0.91, 0.002, Nuisance(max_radius=0.003), scatter=0.003
    )
    mixed = ExperimentBatch((timed, curve))
    seen = predict(SIMULATOR, PARAMETERS.pack(GEL), mixed)
    alone = predict(SIMULATOR, PARAMETERS.pack(GEL), ExperimentBatch((curve,)))
    assert torch.equal(seen[1], alone[0])
    own = predict_collapse(
        SIMULATOR, PARAMETERS.pack(GEL), mixed.designs[:1], mixed.mean[:1, 0]
    )
    assert seen[0, 0] == own
    z = (0.91 - float(own)) / math.hypot(0.002, 0.003)
    expected = (
        -0.5 * z * z - math.log(math.hypot(0.002, 0.003)) - 0.5 * math.log(2.0 * math.pi)
    )
    assert mixed.log_likelihood(seen)[0] == pytest.approx(expected, rel=1e-9)
    assert [e.label for e in mixed.curves] == ["c"]


def test_that_serial_correlation_is_seen_and_not_claimed():
    order = arange(40)
    source = generator(2)
    noise = [randn(40, generator=source) for _ in range(300)]
    values = torch.tensor([serial_correlation(x, order) for x in noise])
    assert (values > 2.6).double().mean() < 0.02
    assert values.std() == pytest.approx(1.0, abs=0.12)
    assert serial_correlation(torch.sin(order / 4.0), order) > 4.0


def test_that_the_posterior_is_that_of_quadrature_and_the_scatter_is_found():
    """Over a grid of gels, with linear nuisances; the further error that was estimated is taken as
    given in both. The posterior of mu has a long tail, so the grid is wide; in its corners some
    bubbles cannot be integrated.
    """
    data = shots(8, seed=3, scatter=0.006)
    result = fitted(data, seed=0)
    fit = result.assimilation["nhkv"]
    batch = result.assimilation.batch
    scatter = result.collapse_times()[0]["scatter"]
    assert scatter == pytest.approx(0.006, rel=0.8)  # of eight shots
    width = fit.posterior.chol.square().sum(1).sqrt()
    axes = [
        m + 6.0 * w * linspace(-1.0, 1.0, 33)
        for m, w in zip(fit.posterior.mean, width, strict=True)
    ]
    gels = torch.cartesian_prod(*axes)
    shifts = zeros(3, 8, 3)
    shifts[1, :, 0] = shifts[2, :, 2] = 1e-3
    near = batch.mean[:, 0]
    times = torch.stack(
        [
            predict_collapse(
                SIMULATOR,
                fit.prior.to_si(gels),
                batch.designs,
                near,
                s.expand(1089, -1, -1),
            )
            for s in shifts
        ]
    )
    slopes = (times[1:] - times[0]) / 1e-3 * tensor([0.003, 0.01])[:, None, None]
    variance = slopes.square().sum(0) + tensor([e.whole_sd**2 for e in batch.experiments])
    log = -0.5 * ((times[0] - near).square() / variance + variance.log()).sum(
        1
    ) - 0.5 * gels.square().sum(1)
    log = log.nan_to_num(nan=-math.inf)
    weights = (log - log.max()).exp() / (log - log.max()).exp().sum()
    mean = weights @ gels
    sd = (weights @ (gels - mean).square()).sqrt()
    assert ((fit.posterior.mean - mean) / sd).tolist() == pytest.approx(
        [0.0, 0.0], abs=0.15
    )
    assert (width / sd).tolist() == pytest.approx([1.0, 1.0], rel=0.1)


def test_that_curves_and_times_of_one_gel_tell_more_than_either():
    times = linspace(0.0, 2.5, 60)
    curve = TraceSet(
        (film(GEL, 300e-6, 0.15, times, generator(5), noise=0.01, name="curve"),)
    )
    data = shots(8, seed=4)
    both = fitted(data, curve, rest_radius=(0.15, 0.0015))
    either = [fitted(data), fitted((), curve, rest_radius=(0.15, 0.0015))]
    sds = [float(torch.linalg.det(r.assimilation["nhkv"].chol)) for r in (both, *either)]
    assert sds[0] < min(sds[1:])
    # beside collapse times the noise is plugged in
    assert both.assimilation["nhkv"].sample.noise is None
    assert "a further error of" in both.report()
    assert len(both.collapse_times()) == 8
    assert [e.label for e in both.experiments] == ["curve"]
    assert set(both.assimilation.rmse_by_experiment("nhkv")) == {"curve"}


def test_that_a_population_is_refused_beside_times():
    data = shots(3)
    with refused(r"A population is inferred from curves, and 3 shot\(s\)"):
        fitted(data, population=True)
    with refused("No curve or collapse time"):
        fitted(())


def test_that_stated_errors_are_read_and_wrong_units_noticed(tmp_path):
    path = tmp_path / "shots.csv"
    path.write_text(
        f"{HEADER},collapse_time_sd_s,rmax_sd_m,stretch_sd\n{ROW},1e-7,3.4e-6,0.16\n"
    )
    shot = load_collapse_times(path)[0]
    experiment = shot.to_experiment(Surroundings())
    assert experiment.nuisance.max_radius == pytest.approx(0.01)
    assert experiment.nuisance.rest_radius == pytest.approx(0.02)
    assert experiment.sd == pytest.approx(1e-7 / float(Surroundings().time_scale(3.4e-4)))
    slow = CollapseShot("b", 3.4e-4, 8.0, 3.05e-3)
    with refused("check the units of rmax_m and collapse_time_s"):
        slow.to_experiment(Surroundings())
    with refused("holds collapse times and no curves"):
        load_traces(path)
    with refused("put the error of time zero into sd"):
        CollapseTime("a", (240.0, 0.13), 0.91, 0.001, Nuisance(time_zero=0.01))
