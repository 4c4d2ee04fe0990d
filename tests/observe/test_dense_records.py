"""Dense and noiseless records: thinned, with a word, and fitted with noise that is no smaller than the
solver's error.
"""

import pytest

from imr_torch.float64 import linspace
from imr_torch.observe import TraceSet, find_landmarks, prepare
from imr_torch.random import generator
from imr_torch.units import Surroundings
from tests.filmed import characterize_quickly, film

GEL = {"G": 8310.0, "mu": 0.093}
SIZE = 270e-6


def record(frames: int, *, noise: float = 0.0, last: float = 3.0) -> TraceSet:
    times = linspace(0.0, last, frames)
    return TraceSet((film(GEL, SIZE, 0.2, times, generator(1), noise=noise, name="a"),))


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_that_a_dense_record_ends_in_a_right_answer(noise, few_deviations):
    result = characterize_quickly(record(4341, noise=noise))
    assert result.fit_test.explained
    document = result.to_dict()
    low, _, high = document["models"]["nhkv"]["intervals"]["G"]
    assert low < GEL["G"] < high
    assert high / low < 1.2
    assert document["noise_interval"][1] > 0.0002  # no less than the error of the solver
    assert "869 of the 4341 frames of 'a' are used" in document["cautions"][0]
    assert len(result.frames[0].fitted) == 869


@pytest.mark.parametrize(
    ("frames", "last", "kept"),
    [
        (900, 3.0, 900),
        (1500, 60.0, 1500),
        (2500, 30.0, 2500),
        (2500, 20.0, 1250),
        (9000, 3.0, 1000),
    ],
)
def test_that_only_dense_records_are_thinned_and_no_gap_is_wider_than_allowed(
    frames, last, kept
):
    whole = record(frames, last=last)
    prepared = prepare(whole, rest_radius=(0.2, 0.002))
    (trace,) = prepared.traces
    assert len(trace) == kept
    scale = float(Surroundings().time_scale(SIZE))
    assert kept == frames or trace.time_s.diff().max() / scale < 0.0201
    assert prepared.landmarks["a"] == find_landmarks(whole["a"])  # of all frames
    assert bool(prepared.cautions) is (kept < frames)
