"""Single frames for ArviZ: their predictions and likelihoods given the others, and the plots of
ArviZ on them.
"""

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from imr_torch.assimilate import Assimilation, Point, Posterior, SearchOptions, assimilate, weigh
from imr_torch.export import to_arviz
from imr_torch.export.frames import predict_frames
from imr_torch.observe import Experiment, ExperimentBatch, Noise
from imr_torch.random import generator
from tests import float64
from tests.linear import CORRELATED, NOISE, LinearSimulator, experiments, prior, tensor

OPTIONS = SearchOptions(raw_samples=24)


def sets(noise: Noise) -> tuple[ExperimentBatch, Tensor, Tensor]:
    """Three experiments of unequal length and repeats, and draws of the gel."""
    batch = experiments(3, noise=noise)
    source = generator(3)
    return (
        batch,
        float64.randn(5, 2, generator=source),
        float64.zeros(5, 3, 3),
    )


@pytest.mark.parametrize("noise", [NOISE, CORRELATED])
def test_that_the_likelihood_of_a_frame_is_that_of_the_normal_given_the_others(
    noise,
):
    batch, controls, nuisances = sets(noise)
    part = prior(("nhkv",))["nhkv"]
    _, found = predict_frames(part, batch, LinearSimulator(), controls, nuisances, seed=0)
    seen = Posterior(part, batch, LinearSimulator()).predict(Point(controls, nuisances))
    expected = []
    for e, shot in enumerate(batch.experiments):
        frames = len(shot.times)
        sd = noise.sd(seen[:, e, :frames], shot.times) / shot.repeats**0.5
        gap = (shot.times[:, None] - shot.times).abs()
        correlation = (
            torch.exp(-gap / noise.correlation_time)
            if noise.correlation_time
            else torch.eye(frames).double()
        )
        for draw in range(len(controls)):
            covariance = sd[draw, :, None] * correlation * sd[draw]
            whole = MultivariateNormal(seen[draw, e, :frames], covariance).log_prob(shot.mean)
            for i in range(frames):
                kept = [j for j in range(frames) if j != i]
                rest = MultivariateNormal(seen[draw, e, kept], covariance[kept][:, kept]).log_prob(
                    shot.mean[kept]
                )
                expected.append((e, i, draw, float(whole - rest)))
    where = {(e, i): n for n, (e, i) in enumerate(torch.nonzero(batch.mask).tolist())}
    for e, i, draw, value in expected:
        assert float(found[draw, where[e, i]]) == pytest.approx(value, abs=1e-8)


@pytest.mark.parametrize("noise", [NOISE, CORRELATED])
def test_that_predictive_draws_have_the_moments_of_that_normal(noise):
    batch, controls, nuisances = sets(noise)
    part = prior(("nhkv",))["nhkv"]
    many = 40_000
    drawn, _ = predict_frames(
        part,
        batch,
        LinearSimulator(),
        controls[:1].expand(many, -1),
        nuisances[:1].expand(many, -1, -1),
        seed=1,
    )
    _, likelihood = predict_frames(
        part, batch, LinearSimulator(), controls[:1], nuisances[:1], seed=1
    )
    middle = drawn.mean(0)
    sd = drawn.std(0)
    observed = batch.mean[batch.mask]
    again = -0.5 * ((observed - middle) / sd).square() - sd.log() - 0.9189385
    assert torch.allclose(again, likelihood[0], atol=0.05, rtol=0.05)


def fitted(stated: Noise, true: Noise, count: int = 6, frames: int = 40) -> Assimilation:
    """A fit to curves with the noise ``true`` that believes in the noise ``stated``."""
    source = torch.Generator().manual_seed(5)
    made = []
    times = float64.linspace(0.05, 3.0, frames)
    for e in range(count):
        design = tensor(300.0 + 100.0 * e, 0.2)
        clean = LinearSimulator()(
            prior(("nhkv",))["nhkv"].parameters(torch.zeros(2).double()), design, times
        ).radius
        made.append(
            Experiment(
                f"e{e}",
                (float(design[0]), 0.2),
                times,
                true.draw(clean, times, 1, generator=source),
            )
        )
    batch = ExperimentBatch(tuple(made), stated)
    fit = assimilate(prior(("nhkv",)), batch, LinearSimulator(), seed=1, options=OPTIONS)
    return weigh(fit, LinearSimulator(), seed=1, samples=1024)


@pytest.mark.parametrize(
    ("stated", "true", "right"),
    [
        (NOISE, NOISE, True),
        (CORRELATED, CORRELATED, True),
        (Noise(floor=0.025, slope=0.0, drift=0.0), NOISE, False),
        (
            NOISE,
            CORRELATED,
            True,
        ),  # each frame by itself has the right spread, which is what LOO-PIT tests
        (Noise(floor=0.1, slope=0.0, drift=0.0), NOISE, False),
    ],
)
def test_that_loo_pit_is_uniform_where_the_noise_is_right_and_only_there(stated, true, right):
    stats = pytest.importorskip("arviz_stats", reason="needs the extra arviz")
    scipy = pytest.importorskip("scipy.stats")
    tree = to_arviz(fitted(stated, true), seed=0, draws=1000, simulator=LinearSimulator())
    values = stats.loo_pit(tree["nhkv/frames"])["radius"].values
    found = scipy.kstest(values, "uniform").pvalue
    assert (found > 0.01) if right else (found < 1e-3), found


def test_that_the_tree_of_frames_has_what_arviz_asks_for():
    fit = weigh(
        assimilate(prior(("nhkv",)), experiments(2), LinearSimulator(), seed=1, options=OPTIONS),
        LinearSimulator(),
        seed=1,
    )
    pytest.importorskip("arviz_base", reason="needs the extra arviz")
    tree = to_arviz(fit, seed=0, draws=20, simulator=LinearSimulator())["nhkv/frames"]
    frames = int(fit.batch.mask.sum())
    assert tree["posterior_predictive"]["radius"].shape == (1, 20, frames)
    assert (
        tree["observed_data"]["radius"].values.tolist() == fit.batch.mean[fit.batch.mask].tolist()
    )
    assert tree["constant_data"]["experiment"].values.tolist() == ["e0"] * 9 + ["e1"] * 12
    assert "frames" not in to_arviz(fit, seed=0, draws=20)["nhkv"].children


def test_that_arvizs_plots_and_comparison_take_the_tree():
    plots = pytest.importorskip("arviz_plots", reason="needs the extra arviz")
    stats = pytest.importorskip("arviz_stats")
    pyplot = pytest.importorskip("matplotlib.pyplot")
    fit = assimilate(
        prior(("newtonian", "nhkv")), experiments(3), LinearSimulator(), seed=1, options=OPTIONS
    )
    tree = to_arviz(
        weigh(fit, LinearSimulator(), seed=1, samples=512),
        seed=0,
        draws=200,
        simulator=LinearSimulator(),
    )
    branch = tree["nhkv"]
    plots.plot_dist(branch, var_names=["G", "mu"], backend="matplotlib")
    plots.plot_pair(branch, var_names=["G", "mu"], backend="matplotlib")
    plots.plot_forest(branch, var_names=["G", "mu"], backend="matplotlib")
    plots.plot_ppc_dist(branch["frames"], backend="matplotlib")
    plots.plot_loo_pit(branch["frames"], backend="matplotlib")
    pyplot.close("all")
    table = stats.compare({name: tree[name] for name in ("newtonian", "nhkv")})
    assert table.index[0] == "nhkv"
