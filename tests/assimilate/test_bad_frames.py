"""Bad frames: named where they are, rarely where there are none, under independent and under
correlated noise.
"""

from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import SearchOptions, assimilate_estimating_noise, find_bad_frames
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Nuisance
from tests.linear import CORRELATED, NOISE, LinearSimulator, prior, tensor

PRIOR = prior(("nhkv",))
PART = PRIOR.models[0]
SIMULATOR = LinearSimulator()
OPTIONS = SearchOptions(raw_samples=8, starts=2)
FRAMES = 60
TIMES = torch.linspace(0.05, 2.5, FRAMES, dtype=torch.float64)
SD = 0.05


def film(seed: int, bad: dict[int, float], law=NOISE) -> ExperimentBatch:
    """One curve with errors, in standard deviations of the noise, added to some frames."""
    source = torch.Generator().manual_seed(seed)
    gel = torch.randn(2, generator=source, dtype=torch.float64)
    clean = SIMULATOR(PART.to_si(gel), tensor(400.0, 0.2), TIMES).radius
    seen = law.draw(clean, TIMES, 1, generator=source)
    for frame, size in bad.items():
        seen[0, frame] += size * SD
    nuisance = Nuisance(time_zero=0.02, rest_radius=0.02)
    return ExperimentBatch((Experiment("a", (400.0, 0.2), TIMES, seen, nuisance),), NOISE)


def found(batch: ExperimentBatch, seed: int = 0):
    fits = assimilate_estimating_noise(
        PRIOR, batch, SIMULATOR, rounds=2, seed=seed, options=OPTIONS, warn=False
    )
    return find_bad_frames(fits["nhkv"], fits.batch, SIMULATOR), fits


@pytest.mark.parametrize("law", [NOISE, CORRELATED])
def test_that_bad_frames_are_named_and_hardly_any_other(law) -> None:
    hits = 0
    false = 0
    clean = 0
    for seed in range(10):
        bad = {7: 8.0, 31: -12.0, 50: 10.0}
        named = {x.frame for x in found(film(seed, bad, law), seed)[0].frames}
        hits = hits + len(named & set(bad))
        false = false + len(named - set(bad))
        clean += len(found(film(100 + seed, {}, law), seed)[0].frames)
    assert hits >= 27  # of 30
    assert false <= 2  # of 570
    assert clean <= 2  # of 600


def gaussian(batch: ExperimentBatch, kept: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Exact posterior mean and covariance of the whitened gel from some of the frames, by dense algebra."""
    shot = batch.experiments[0]
    slopes = torch.stack(
        [m.to_physical(tensor(1.0)) - m.to_physical(tensor(0.0)) for m in PART.marginals]
    )
    columns = (
        SIMULATOR.columns(FRAMES, tensor(shot.design[0])[0])[:, PARAMETERS.index(PART.names)]
        * slopes[:, 0]
        @ PART.chol
    )
    clock = torch.full(
        (FRAMES, 1), SIMULATOR.time_slope * shot.nuisance.time_zero, dtype=torch.float64
    )
    rest = torch.full(
        (FRAMES, 1),
        SIMULATOR.rest_slope * shot.design[1] * shot.nuisance.rest_radius,
        dtype=torch.float64,
    )
    rows = torch.cat((columns, clock, rest), 1)[kept]
    mean = SIMULATOR(PART.parameters(PART.mean), tensor(*shot.design), shot.times).radius
    noise = (batch.noise.scale * batch.noise.floor) ** 2 * torch.eye(len(rows), dtype=torch.float64)
    gain = rows.mT @ torch.linalg.inv(rows @ rows.mT + noise)
    covariance = torch.eye(rows.shape[1], dtype=torch.float64) - gain @ rows
    return (gain @ (shot.radius[0] - mean)[kept])[:2], covariance[:2, :2]


def test_that_the_answer_without_bad_frames_is_that_of_a_fit_without_them() -> None:
    batch = film(3, {22: 14.0})
    batch = replace(batch, noise=replace(NOISE, scale=1.5))
    fits = assimilate_estimating_noise(
        PRIOR, batch, SIMULATOR, rounds=0, seed=0, options=OPTIONS, warn=False
    )
    result = find_bad_frames(fits["nhkv"], batch, SIMULATOR)
    assert [x.frame for x in result.frames] == [22]
    assert result.without is not None
    every = torch.ones(FRAMES, dtype=torch.bool)
    (mean, covariance), (moved, wider) = (
        gaussian(fits.batch, x) for x in (every, torch.arange(FRAMES) != 22)
    )
    before = fits["nhkv"].posterior
    torch.testing.assert_close(before.mean, PART.unwhitened(mean), rtol=0.0, atol=1e-3)
    torch.testing.assert_close(
        result.without.mean - before.mean, PART.chol @ (moved - mean), rtol=0.0, atol=1e-3
    )
    expected = (PART.chol @ torch.linalg.cholesky(wider)).norm(dim=1)
    torch.testing.assert_close(result.without.chol.norm(dim=1), expected, rtol=1e-3, atol=0.0)
    assert float(((moved - mean).abs() / covariance.diagonal().sqrt()).max()) > 0.05


def test_that_too_many_frames_are_not_tested() -> None:
    batch = film(0, {})
    fits = assimilate_estimating_noise(
        PRIOR, batch, SIMULATOR, rounds=0, seed=0, options=OPTIONS, warn=False
    )
    many = torch.linspace(0.0, 2.5, 3001, dtype=torch.float64)
    shot = Experiment("b", (400.0, 0.2), many, torch.full((1, 3001), 0.5, dtype=torch.float64))
    result = find_bad_frames(fits["nhkv"], ExperimentBatch((shot,), NOISE), SIMULATOR)
    assert result.frames == ()
    assert "3001 frames" in result.lines()[0]
    assert replace(result, reason="").lines() == ["No single frame looks bad."]
