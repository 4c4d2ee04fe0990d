"""The noise of single traces: its amounts are recovered from their roughness, whatever the frames and the correlation."""

from dataclasses import replace

import pytest
import torch

from imr_torch.errors import InputDataError
from imr_torch.gap import LIBRARY, library
from imr_torch.gap.adequacy import adequacy_test
from imr_torch.goodness.score import LEVEL
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance, predict
from imr_torch.observe.roughness import LEAST, LEAST_CONSTANT, noise_of_traces
from imr_torch.random import generator
from tests.gap.synthetic import DESIGNS, GEL, SIMULATOR, fit


def traces(noise: Noise, *, spacing: float = 0.02, uneven: bool = False) -> list[Experiment]:
    source = generator(3)
    times = torch.arange(0.0, 3.0, spacing, dtype=torch.float64)
    if uneven:
        times = times + 0.4 * spacing * torch.rand(len(times), generator=source, dtype=torch.float64)
    truth = 0.5 + 0.5 * torch.cos(2.0 * times) * torch.exp(-0.3 * times)
    rows = [noise.draw(truth, times, 1, generator=source) for _ in range(6)]
    return [Experiment(f"{i}", (300.0, 0.2), times, row) for i, row in enumerate(rows)]


@pytest.mark.parametrize("correlation_time", [0.0, 0.14, 0.4])
@pytest.mark.parametrize("uneven", [False, True])
def test_that_the_scale_of_the_noise_is_recovered(correlation_time, uneven):
    noise = Noise(scale=1.2, correlation_time=correlation_time)
    found = noise_of_traces(traces(noise, uneven=uneven), correlation_time=correlation_time)
    assert found.scale == pytest.approx(1.2, rel=0.1)
    assert found.correlation_time == correlation_time


@pytest.mark.parametrize(("scale", "constant"), [(0.5, 0.004), (1.5, 0.003), (1.0, 0.01)])
def test_that_a_constant_part_and_a_multiple_of_the_law_are_told_apart(scale, constant):
    noise = Noise(scale=scale, floor=constant / scale)
    found = noise_of_traces([e for _ in range(2) for e in traces(noise)], correlation_time=0.0)
    assert found.scale == pytest.approx(scale, rel=0.2)
    assert found.scale * found.floor == pytest.approx(constant, rel=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_that_pixel_noise_at_several_frame_rates_makes_no_gap_and_a_wall_does(seed):
    """As a camera of one frame rate films bubbles of several sizes: no law of sizes and times, and no correlation."""

    def p_value(effect: dict[str, float]) -> float:
        source, experiments = generator(seed), []
        for spacing, design in zip((0.04, 0.03, 0.02), DESIGNS, strict=True):
            times = torch.arange(0.0, 2.6, spacing, dtype=torch.float64)
            blank = Experiment(f"{spacing}", design, times, torch.ones(1, len(times), dtype=torch.float64))
            truth = predict(SIMULATOR, PARAMETERS.pack(GEL | effect)[None], ExperimentBatch((blank,)))[0]
            pixels = 0.004 * torch.randn(truth.shape, generator=source, dtype=torch.float64)
            experiments.append(replace(blank, radius=truth + pixels))
        batch = ExperimentBatch(tuple(experiments), noise_of_traces(experiments))
        return adequacy_test(fit(batch), (LIBRARY["wall"],), batch, SIMULATOR, seed=0).test.p_value

    assert p_value({}) > LEVEL
    assert p_value({"wall": 0.2}) < 1e-3


def short(seed: int, **effect: float) -> list[Experiment]:
    """Two curves of six and seven frames, with the published noise, as of bubbles that were filmed to their first collapse."""
    source, experiments = generator(seed), []
    sds = torch.tensor([0.007, 0.012, 0.1], dtype=torch.float64)
    for frames, design in ((6, (140.0, 0.2)), (7, (150.0, 0.2))):
        times = 0.045 + 0.15 * torch.arange(frames, dtype=torch.float64)
        times = times + 0.02 * torch.rand(frames, generator=source, dtype=torch.float64)
        blank = torch.ones(1, frames, dtype=torch.float64)
        plan = Experiment(f"{frames}", design, times, blank, Nuisance(*sds.tolist()))
        shifts = sds * torch.randn(1, 1, 3, generator=source, dtype=torch.float64)
        truth = predict(SIMULATOR, PARAMETERS.pack(GEL | effect)[None], ExperimentBatch((plan,)), shifts)[0, 0]
        radius = Noise(correlation_time=0.14).draw(truth, times, 1, generator=source)
        experiments.append(replace(plan, radius=radius))
    return experiments


def test_that_a_handful_of_frames_is_not_taken_for_quiet_and_a_gap_is_seen_all_the_same(monkeypatch):
    """Two amounts read off five frames may be a quarter of the truth."""

    def p_value(curves: list[Experiment]) -> float:
        batch = ExperimentBatch(tuple(curves), noise_of_traces(curves))
        return adequacy_test(fit(batch), library(), batch, SIMULATOR, seed=0).test.p_value

    quiet = short(6)  # by chance, as in a quarter of such pairs
    assert noise_of_traces(quiet).scale == 1.0
    assert p_value(quiet) > LEVEL
    assert p_value(short(6, wall=0.4)) < LEVEL
    monkeypatch.setattr("imr_torch.observe.roughness.FEW", 0)
    assert p_value(quiet) < 1e-3


def test_that_a_few_wild_frames_do_not_count():
    experiments = traces(Noise(scale=1.2))
    experiments[0].radius[0, 20:26] += torch.tensor([0.3, -0.3, 0.3, -0.3, 0.3, -0.3], dtype=torch.float64)
    assert noise_of_traces(experiments, correlation_time=0.0).scale == pytest.approx(1.2, rel=0.1)


def test_that_white_noise_taken_as_correlated_is_never_underestimated():
    """Fewer independent frames than assumed make false gaps; more only cost power."""
    experiments = traces(Noise(scale=1.2))
    assert noise_of_traces(experiments).scale > 1.2


def test_that_a_perfect_trace_is_not_believed():
    found = noise_of_traces(traces(Noise(scale=1e-6)), correlation_time=0.0)
    assert (found.scale, found.scale * found.floor) == (LEAST, LEAST_CONSTANT)


def test_that_traces_of_four_frames_are_refused():
    short = [e.until(0.06) for e in traces(Noise())]
    with pytest.raises(InputDataError, match="five frames"):
        noise_of_traces(short)
