"""The noise of single traces: its scale is recovered from their roughness, whatever the frames and the correlation."""

import pytest
import torch

from imr_torch.errors import InputDataError
from imr_torch.gap.noise import LEAST, noise_of_traces
from imr_torch.observe import Experiment, Noise
from imr_torch.random import generator


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
    noise = Noise(scale=0.7, correlation_time=correlation_time)
    found = noise_of_traces(traces(noise, uneven=uneven), correlation_time=correlation_time)
    assert found.scale == pytest.approx(0.7, rel=0.1)
    assert found.correlation_time == correlation_time


def test_that_a_few_wild_frames_do_not_count():
    experiments = traces(Noise(scale=0.7))
    experiments[0].radius[0, 20:26] += torch.tensor([0.3, -0.3, 0.3, -0.3, 0.3, -0.3], dtype=torch.float64)
    assert noise_of_traces(experiments, correlation_time=0.0).scale == pytest.approx(0.7, rel=0.1)


def test_that_white_noise_taken_as_correlated_is_never_underestimated():
    """Fewer independent frames than assumed make false gaps; more only cost power."""
    experiments = traces(Noise(scale=0.7))
    assert noise_of_traces(experiments).scale > 0.7


def test_that_a_perfect_trace_is_not_believed():
    assert noise_of_traces(traces(Noise(scale=1e-6)), correlation_time=0.0).scale == LEAST


def test_that_traces_of_four_frames_are_refused():
    short = [e.until(0.06) for e in traces(Noise())]
    with pytest.raises(InputDataError, match="five frames"):
        noise_of_traces(short)
