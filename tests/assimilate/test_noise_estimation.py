"""Fits that estimate the noise: its scale is found whatever the repeats, and a model that misses
the data pays for it.
"""

from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import (
    SearchOptions,
    assimilate_estimating_noise,
)
from imr_torch.float64 import linspace
from imr_torch.observe import Experiment, ExperimentBatch
from imr_torch.random import generator
from tests.linear import NHKV, NOISE, LinearSimulator, prior, tensor

OPTIONS = SearchOptions(raw_samples=24, starts=2)
TIMES = linspace(0.0, 2.0, 60)
DESIGNS = ((200.0, 0.2), (500.0, 0.25), (900.0, 0.15))


def filmed(scale: float, repeats: int, correlation_time: float = 0.0) -> ExperimentBatch:
    """Experiments on a gel of stiffness 5600 Pa, their noise a multiple of the law that the batch states."""
    source = generator(repeats)
    simulator = LinearSimulator()
    belief = NHKV.models[0]
    gel = belief.parameters(tensor(0.5, -0.3))
    noise = replace(NOISE, scale=scale, correlation_time=correlation_time)
    experiments = []
    for design in DESIGNS:
        truth = simulator(gel, tensor(*design), TIMES).radius
        experiments.append(
            Experiment(
                f"We {design[0]}",
                design,
                TIMES,
                noise.draw(truth, TIMES, repeats, generator=source),
            )
        )
    return ExperimentBatch(tuple(experiments), NOISE)


def fitted(batch: ExperimentBatch, rounds: int, models: tuple[str, ...] = ("nhkv",)):
    return assimilate_estimating_noise(
        prior(models), batch, LinearSimulator(), rounds=rounds, seed=0, options=OPTIONS
    )


@pytest.mark.parametrize("repeats", [1, 8])
def test_that_the_scale_is_found_and_intervals_widen_with_it(repeats):
    batch = filmed(3.0, repeats)
    stated = fitted(batch, 0)
    found = fitted(batch, 2)
    assert stated.batch.noise == NOISE
    level = (
        found.batch.of_frames.noise.sd(tensor(0.5), TIMES).mean()
        / NOISE.sd(tensor(0.5), TIMES).mean()
    )
    assert level == pytest.approx(3.0, rel=0.15)  # 180 residuals: 5 % by chance
    wider = (found["nhkv"].chol.diagonal() / stated["nhkv"].chol.diagonal()).mean()
    assert wider == pytest.approx(3.0, rel=0.2)


def test_that_noise_is_estimated_from_repeats_with_gaps_too():
    batch = filmed(1.0, 8)
    radius = batch.experiments[0].radius.clone()
    radius[0, 10:20] = torch.nan
    batch = ExperimentBatch(
        (replace(batch.experiments[0], radius=radius), *batch.experiments[1:]), NOISE
    )
    whole = fitted(filmed(1.0, 8), 2)
    gaps = fitted(batch, 2)
    assert gaps["nhkv"].certificate.converged
    assert gaps.batch.of_frames.noise.scale == pytest.approx(
        whole.batch.of_frames.noise.scale, rel=0.05
    )
    apart = (gaps["nhkv"].mean - whole["nhkv"].mean).abs()
    assert (
        apart < 0.5 * whole["nhkv"].chol.norm(dim=1)
    ).all()  # 10 frames of 1440 are missing


def test_that_a_model_that_misses_the_data_keeps_the_noise_of_the_camera_and_pays_in_its_intervals():
    batch = filmed(1.0, 8)
    wrong, right = (fitted(batch, 2, (model,)).batch for model in ("newtonian", "nhkv"))
    for found in (wrong, right):
        assert found.of_frames.noise.scale == pytest.approx(1.0, rel=0.15)
    assert wrong.noise.scale > 2.0 * right.noise.scale
    assert fitted(batch, 2, ("newtonian", "nhkv")).batch.noise.scale == pytest.approx(
        right.noise.scale, rel=1e-3
    )
