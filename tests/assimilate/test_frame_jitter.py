"""Jitter of frame times: its likelihood is that of a Gaussian; it is found with its size, and not
claimed where there is none.
"""

import math
from dataclasses import replace

import pytest
import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.assimilate import (
    ModelFit,
    SearchOptions,
    assimilate,
    find_frame_jitter,
    frame_jitter,
)
from imr_torch.assimilate.bad_frames import joint_gaussian
from imr_torch.assimilate.frame_jitter import SCALE
from imr_torch.assimilate.posterior import Posterior
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, Noise, SimulatedLaboratory, predict
from imr_torch.random import generator

SIMULATOR = PolytropicSimulator()
PRIOR = wide_prior(["nhkv"])
OPTIONS = SearchOptions(raw_samples=16, starts=2)
GEL = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})


def shot(jitter: float, seed: int) -> ExperimentBatch:
    """Two curves whose frames are off by that many frame intervals."""
    laboratory = SimulatedLaboratory(SIMULATOR, GEL, repeats=1, noise=Noise(scale=0.3))
    designs = torch.tensor([[400.0, 0.22], [250.0, 0.2]], dtype=torch.float64)
    experiments = []
    for number, design in enumerate(designs):
        one = laboratory.shoot(design, seed=100 * seed + number)
        source = generator(7 * seed + number)
        late = (
            jitter
            * one.times.diff().median()
            * torch.randn(len(one.times), generator=source, dtype=torch.float64)
        )
        here = ExperimentBatch((one,))
        at = (one.times + late).clamp_min(0.0)[None]
        order = at[0].argsort()
        moved = predict(SIMULATOR, GEL[None], here, times=at[:, order])[0, 0][order.argsort()]
        still = predict(SIMULATOR, GEL[None], here)[0, 0]
        experiments.append(
            replace(one, label=f"shot {number}", radius=one.radius + (moved - still))
        )
    return ExperimentBatch(tuple(experiments), Noise(scale=0.3))


def fitted(batch: ExperimentBatch) -> ModelFit:
    return assimilate(PRIOR, batch, SIMULATOR, seed=0, options=OPTIONS)["nhkv"]


def test_that_the_likelihood_is_that_of_the_joint_gaussian() -> None:
    batch = shot(0.1, 0)
    fit = fitted(batch)
    near = Posterior(fit.prior, batch, SIMULATOR).neighbourhood(fit.point)
    whole = joint_gaussian(near)
    by_time = 1.0 + torch.rand(len(whole.pull), generator=generator(3), dtype=torch.float64)
    covariance = torch.linalg.inv(whole.precision)
    seen = torch.linalg.solve(whole.precision, whole.pull)
    free = len(seen) - 2
    interval = 0.04

    def density(ratio: float) -> float:
        """Log density of the frames, the size of all noise integrated out, but for a constant."""
        wide = covariance + (ratio * torch.diag(by_time)).square()
        square = float(seen @ torch.linalg.solve(wide, seen))
        return -0.5 * float(torch.linalg.slogdet(wide).logabsdet) - 0.5 * free * math.log(square)

    ratios = interval * torch.logspace(-4.0, 0.0, 241, dtype=torch.float64)
    squares = [
        float(seen @ torch.linalg.solve(covariance + (r * torch.diag(by_time)).square(), seen))
        for r in ratios
    ]
    sd = ratios * (torch.tensor(squares, dtype=torch.float64) / free).sqrt()
    likelihood = torch.tensor(
        [density(float(r)) - density(0.0) for r in ratios], dtype=torch.float64
    )
    scale = SCALE * interval
    prior = 2.0 / (scale * math.sqrt(2.0 * math.pi)) * torch.exp(-0.5 * (sd / scale).square())
    middles = 0.5 * (sd[1:] + sd[:-1])
    cells = torch.cat((torch.zeros(1, dtype=torch.float64), middles, sd[-1:])).diff()
    expected = float(torch.logsumexp(likelihood + (prior * cells).log(), 0))
    inner = by_time[:, None] * whole.precision * by_time
    found = frame_jitter._posterior(
        inner, by_time * whole.pull, float(whole.pull @ seen), free, interval
    )
    assert found[1] == pytest.approx(expected, abs=1e-6)


def test_that_jitter_is_found_with_its_size() -> None:
    """A tenth of a frame interval in eight sets: always found, and within its 90 % interval in at
    least five.
    """
    inside = 0
    for seed in range(200, 208):
        batch = shot(0.1, seed)
        found = find_frame_jitter(fitted(batch), batch, SIMULATOR)
        assert found.found
        low, _, high = (value / found.frame_interval for value in found.sd)
        inside += low < 0.1 < high
    assert inside >= 5
    assert found.with_jitter is not None
    assert found.to_dict()["found"] is True
    assert "Frame times jitter by" in str(found)


def test_that_jitter_is_not_claimed_where_there_is_none() -> None:
    for seed in range(20, 28):
        batch = shot(0.0, seed)
        found = find_frame_jitter(fitted(batch), batch, SIMULATOR)
        assert not found.found
        assert found.with_jitter is None


def test_that_too_many_frames_are_said() -> None:
    one = shot(0.0, 0).experiments[0]
    times = torch.linspace(0.0, 3.0, 2001, dtype=torch.float64)
    batch = ExperimentBatch(
        (replace(one, times=times, radius=torch.ones(1, 2001, dtype=torch.float64)),)
    )
    assert "2001 frames" in str(find_frame_jitter(fitted(shot(0.0, 0)), batch, SIMULATOR))


@pytest.mark.parametrize("likeliest", [3.0, math.nan])
def test_that_jitter_by_which_frames_would_change_places_is_not_tested(
    monkeypatch, likeliest: float
) -> None:
    batch = shot(0.0, 0)
    monkeypatch.setattr(
        frame_jitter,
        "_posterior",
        lambda *given: ((0.0, likeliest * given[-1], 4.0 * given[-1]), 0.0),
    )
    found = find_frame_jitter(fitted(batch), batch, SIMULATOR)
    assert found.sd is None
    assert "no jitter: the model misses the curves" in found.reason
