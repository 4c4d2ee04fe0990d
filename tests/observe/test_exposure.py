"""A known exposure: predictions are averaged over it, by the effect that a diagnosis would name, at
its stated value.
"""

import json

import pytest
import torch
from torch.testing import assert_close

from imr_torch import PolytropicSimulator, load_traces
from imr_torch.campaign import Journal
from imr_torch.float64 import arange, linspace, ones, randn, tensor
from imr_torch.material import PARAMETERS
from imr_torch.observe import (
    Experiment,
    ExperimentBatch,
    RadiusTrace,
    TraceSet,
    predict,
    prepare,
)
from imr_torch.random import generator
from imr_torch.reading.traces import Given
from imr_torch.units import Surroundings
from tests.filmed import characterize_quickly
from tests.refusals import refused

SIMULATOR = PolytropicSimulator()
SIZE = 221e-6
OUTER = Surroundings()
SCALE = float(OUTER.time_scale(SIZE))
TIMES = linspace(0.05, 2.2, 44)
GEL = {"G": 8310.0, "mu": 0.093}


def film(exposure: float) -> ExperimentBatch:
    return ExperimentBatch(
        (Experiment("a", (200.0, 0.2), TIMES, ones(1, len(TIMES)), exposure=exposure),)
    )


def seen(exposure: float, **effect: float) -> torch.Tensor:
    """The gel as it is filmed, perhaps with an effect."""
    return predict(SIMULATOR, PARAMETERS.pack(GEL | effect), film(exposure))


def blurred(exposure: float) -> torch.Tensor:
    """Mean radius over each exposure by a fine sum, apart from the code under test."""
    offsets = (arange(201) + 0.5) / 201 - 0.5
    every = (TIMES[:, None] + exposure * offsets).flatten()
    rising, order = every.sort()
    radius = torch.empty_like(every)
    radius[order] = SIMULATOR(PARAMETERS.pack(GEL), tensor([200.0, 0.2]), rising).radius
    return radius.reshape(len(TIMES), -1).mean(1)


def test_that_a_known_exposure_averages_as_the_effect_of_that_value_does():
    known = seen(0.04)
    effect = seen(0.0, exposure_blur=0.04)
    assert torch.equal(known, effect)
    assert_close(known[0], blurred(0.04), rtol=0.0, atol=4e-3)  # eight nodes in a collapse
    sharp = seen(0.0)
    assert (known - sharp).abs().max() > 0.02


def test_that_an_exposure_too_short_to_tell_from_none_is_none():
    """A search may go far into the tail of the prior, where the nodes of an average are one number."""
    tiny = seen(0.0, exposure_blur=1e-17)
    assert torch.equal(tiny, seen(0.0))
    short = seen(0.0, exposure_blur=1e-5)
    assert_close(short, tiny, rtol=0.0, atol=1e-5)


def test_that_each_experiment_has_its_own_exposure():
    first = film(0.02).experiments[0]
    second = film(0.06).experiments[0]
    both = predict(SIMULATOR, PARAMETERS.pack(GEL), ExperimentBatch((first, second)))
    for row, exposure in zip(both, (0.02, 0.06), strict=True):
        assert torch.equal(row, seen(exposure)[0])


def traces(exposure_s: float | None, radius: torch.Tensor) -> TraceSet:
    given = Given(
        max_radius_m=SIZE, max_radius_sd_m=1e-8, time_of_max_s=0.0, exposure_s=exposure_s
    )
    return TraceSet((RadiusTrace("a", TIMES * SCALE, SIZE * radius, "memory", given),))


def test_that_a_stated_exposure_brings_the_fit_to_the_truth():
    exposure = 0.045
    found = {}
    noise = 0.001 * randn(len(TIMES), generator=generator(0))
    radius = blurred(exposure) + noise
    for stated in (None, exposure * SCALE):
        result = characterize_quickly(traces(stated, radius), check=False)
        found[stated] = result.assimilation.rmse("nhkv")
    assert found[exposure * SCALE] < 0.0013
    assert found[None] > 1.5 * found[exposure * SCALE]


def test_that_the_json_beside_a_file_states_the_exposure(tmp_path):
    rows = "".join(
        f"{t * SCALE},{SIZE * r}\n"
        for t, r in zip(TIMES.tolist(), blurred(0.04).tolist(), strict=True)
    )
    (tmp_path / "gel.csv").write_text("time_s,radius_m\n" + rows)
    for exposure, message in (
        (0.04 * SCALE, None),
        (1.0, "exposure_s is 1e.06 us, and frames are .* us apart"),
    ):
        (tmp_path / "gel.json").write_text(
            json.dumps({"exposure_s": exposure, "Rmax_m": SIZE})
        )
        loaded = load_traces(tmp_path / "gel.csv")
        if message:
            with refused(message):
                prepare(loaded, OUTER, rest_radius=(0.2, 0.01))
            continue
        prepared = prepare(loaded, OUTER, rest_radius=(0.2, 0.01))
        assert prepared.experiments[0].exposure == pytest.approx(0.04, rel=1e-3)
        assert "averaged over exposures of t* = 0.04" in prepared.report()


def test_that_an_exposure_survives_windows_and_journals(tmp_path):
    experiment = film(0.04).experiments[0]
    assert experiment.until(1.0).exposure == 0.04
    journal = Journal(tmp_path)
    assert (
        journal.restore_curves(journal.store_curves(experiment, "experiment_001")).exposure
        == 0.04
    )
    with refused(r"has an exposure of 0\.7 Rmax/U_c"):
        film(0.7)
