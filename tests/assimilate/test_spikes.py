"""Frames that single errors of the camera have spoilt: left out where they are, no other one, under
independent and under correlated noise.
"""

import pytest
import torch
from torch.testing import assert_close

from imr_torch.assimilate.spikes import frames_left_out
from imr_torch.float64 import linspace, randn
from imr_torch.observe import Experiment, ExperimentBatch, Nuisance
from imr_torch.random import generator
from tests.linear import CORRELATED, NHKV, NOISE, LinearSimulator, fit_noise, tensor

PART = NHKV.models[0]
SIMULATOR = LinearSimulator()
TIMES = linspace(0.05, 2.5, 60)
SD = 0.05


def film(seed: int, bad: dict[int, float], law=NOISE, repeats: int = 1) -> ExperimentBatch:
    """One curve with errors, in standard deviations of the noise, added to some frames."""
    source = generator(seed)
    gel = randn(2, generator=source)
    clean = SIMULATOR(PART.to_si(gel), tensor(400.0, 0.2), TIMES).radius
    seen = law.draw(clean, TIMES, repeats, generator=source)
    for frame, size in bad.items():
        seen[0, frame] += size * SD
    nuisance = Nuisance(time_zero=0.02, rest_radius=0.02)
    return ExperimentBatch((Experiment("a", (400.0, 0.2), TIMES, seen, nuisance),), NOISE)


@pytest.mark.parametrize("law", [NOISE, CORRELATED])
def test_that_spoilt_frames_are_left_out_and_no_other(law, few_deviations):
    hits = 0
    false = 0
    for seed in range(6):
        bad = {7: 14.0, 31: -16.0, 50: 20.0}
        for errors, place in ((bad, seed), ({}, 100 + seed)):
            batch = film(place, errors, law)
            lost = frames_left_out(
                batch.curves, fit_noise(batch, rounds=2, seed=seed).batch.curves
            ).get("a", [])
            hits += len(set(lost) & set(errors))
            false += len(set(lost) - set(errors))
    assert hits >= 16  # of 18
    assert false <= 2  # of 702


def test_that_the_fit_is_that_of_the_curve_without_them():
    batch = film(3, {22: 30.0})
    kept = torch.arange(60) != 22
    good = ExperimentBatch((batch.curves[0].at(kept),), NOISE)
    found = fit_noise(batch, rounds=2)["nhkv"]
    expected = fit_noise(good, rounds=2)["nhkv"]
    assert_close(found.mean, expected.mean, rtol=0.0, atol=1e-2)
    assert_close(found.chol, expected.chol, rtol=1e-2, atol=1e-3)
    spoilt = fit_noise(batch, rounds=0)["nhkv"]
    assert (spoilt.mean - expected.mean).abs().max() > 0.05


def test_that_repeats_say_themselves_what_is_usual():
    batch = film(3, {22: 30.0}, repeats=4)
    assert len(fit_noise(batch, rounds=2).batch.curves[0].times) == 60
