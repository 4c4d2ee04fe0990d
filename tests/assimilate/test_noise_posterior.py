"""The noise as part of the posterior: closed forms, quadrature by brute force, coverage, and the ends of its range."""

import math
from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import (
    Assimilation,
    NoisePrior,
    Posterior,
    SearchOptions,
    assimilate,
    assimilate_estimating_noise,
    noise_edges,
    weigh,
)
from imr_torch.assimilate.misfit_noise import misfit_law
from imr_torch.assimilate.noise_law import marginal, most_probable_law
from imr_torch.errors import InputDataError
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance
from imr_torch.select import cross_validate
from tests.drifting import Slow, drifting
from tests.linear import CORRELATED, NOISE, LinearSimulator, exact, experiments, prior, tensor

PRIOR = prior(("nhkv",))
PART = PRIOR.models[0]
SIMULATOR = LinearSimulator()
OPTIONS = SearchOptions(raw_samples=8, starts=2)
UNCERTAIN = Nuisance(time_zero=0.05, rest_radius=0.05)
LAWS = NoisePrior(NOISE)


def fitted(batch: ExperimentBatch) -> Assimilation:
    return assimilate(PRIOR, batch, SIMULATOR, seed=0, options=OPTIONS)


def by_brute_force(batch: ExperimentBatch) -> dict[str, torch.Tensor]:
    """Exact evidences on a fine grid of scales and all correlation times of the prior, and exact posteriors, by dense algebra."""
    low, high = LAWS.correlation_times
    count = round(4 * math.log2(high / low)) + 1
    times = [0.0, *torch.logspace(math.log10(low), math.log10(high), count, dtype=torch.float64).tolist()]
    shares = [LAWS.independent] + [(1.0 - LAWS.independent) / count] * count
    log_scales = torch.linspace(math.log(0.4), math.log(4.0), 30, dtype=torch.float64)
    step = float(log_scales[1] - log_scales[0])
    rows, means, covariances = [], [], []
    for tau, share in zip(times, shares, strict=True):
        for log_scale in log_scales.tolist():
            law = replace(NOISE, scale=math.exp(log_scale), correlation_time=tau)
            found = exact(PART, replace(batch, noise=law))
            rows.append(found.log_evidence + math.log(share * step / math.log(LAWS.scales)))
            means.append(found.mean)
            covariances.append(found.covariance)
    values, mean = torch.tensor(rows, dtype=torch.float64), torch.stack(means)
    weights = torch.softmax(values, 0)
    whole = weights @ mean
    apart = mean - whole
    covariance = torch.einsum("m,mij->ij", weights, torch.stack(covariances) + apart[:, :, None] * apart[:, None])
    return {"evidence": torch.logsumexp(values, 0), "mean": whole, "covariance": covariance}


@pytest.mark.parametrize("nuisance", [Nuisance(), UNCERTAIN])
@pytest.mark.parametrize("law", [CORRELATED, replace(NOISE, scale=1.7)])
def test_that_the_marginal_likelihood_is_the_exact_evidence_of_a_linear_model(nuisance: Nuisance, law: Noise) -> None:
    batch = experiments(3, nuisance=nuisance, noise=CORRELATED)
    near = Posterior(PART, batch, SIMULATOR).neighbourhood(fitted(batch)["nhkv"].point)
    assert marginal(near, law) == pytest.approx(exact(PART, replace(batch, noise=law)).log_evidence, abs=1e-6)


@pytest.mark.parametrize("nuisance", [Nuisance(), UNCERTAIN])
def test_that_evidence_and_moments_over_the_noise_are_those_of_brute_force_quadrature(nuisance: Nuisance) -> None:
    batch = experiments(2, nuisance=nuisance, noise=CORRELATED)
    expected = by_brute_force(batch)
    fit = weigh(fitted(batch), SIMULATOR, seed=0, samples=1024, noise=LAWS)["nhkv"]
    sample = fit.sample
    assert sample is not None
    assert sample.reliable
    assert sample.log_evidence == pytest.approx(float(expected["evidence"]), abs=4.0 * sample.log_evidence_error + 0.01)
    assert bool(((sample.mean - expected["mean"]).abs() < 4.0 * sample.mean_error + 1e-3).all())
    sds = expected["covariance"].diagonal().sqrt()
    assert bool(((sample.covariance.diagonal().sqrt() - sds).abs() < 4.0 * sample.sd_error + 0.01 * sds).all())
    assert bool(
        (fit.posterior.chol.norm(dim=1) / (PART.chol @ torch.linalg.cholesky(expected["covariance"])).norm(dim=1) - 1)
        .abs()
        .max()
        < 0.1
    )


def test_that_a_known_law_is_weighted_as_before() -> None:
    batch = experiments(2, noise=CORRELATED)
    sample = weigh(fitted(batch), SIMULATOR, seed=0)["nhkv"].sample
    assert sample is not None
    assert (sample.noise, sample.noise_intervals, sample.noise_laws(3)) == (None, None, None)
    assert sample.log_evidence == pytest.approx(exact(PART, batch).log_evidence, abs=4.0 * sample.log_evidence_error)


def film(seed: int, tau: float, frames: int = 14) -> tuple[ExperimentBatch, torch.Tensor]:
    """One curve of few frames of a gel of the prior; its law states the right scale and no correlation."""
    source = torch.Generator().manual_seed(seed)
    gel = torch.randn(2, generator=source, dtype=torch.float64)
    times = torch.linspace(0.05, 2.5, frames, dtype=torch.float64)
    clean = SIMULATOR(PART.to_si(gel), tensor(400.0, 0.2), times).radius
    seen = replace(NOISE, correlation_time=tau).draw(clean, times, 1, generator=source)
    return ExperimentBatch((Experiment("a", (400.0, 0.2), times, seen),), NOISE), gel


def test_that_intervals_over_the_noise_cover_where_plugged_in_ones_are_too_narrow() -> None:
    """Forty gels whose noise is drawn from its prior; both kinds of intervals by the same fits."""
    inside: dict[str, list[bool]] = {"plugged": [], "integrated": []}
    wider = []
    for seed in range(40):
        source = torch.Generator().manual_seed(seed)
        tau = 0.0 if float(torch.rand(1, generator=source)) < 0.25 else 0.01 * 320.0 ** float(torch.rand(1, generator=source))
        batch, gel = film(1000 + seed, tau)
        fits = assimilate_estimating_noise(PRIOR, batch, SIMULATOR, rounds=1, seed=seed, options=OPTIONS, warn=False)
        sds = []
        for kind, noise in (("plugged", None), ("integrated", LAWS)):
            belief = weigh(fits, SIMULATOR, seed=seed, samples=128, noise=noise)["nhkv"].posterior
            sd = belief.chol.norm(dim=1)
            inside[kind] += ((PART.unwhitened(gel) - belief.mean).abs() < 1.645 * sd).tolist()
            sds.append(sd)
        wider.append(sds[1] / sds[0])
    share = {kind: sum(found) / len(found) for kind, found in inside.items()}
    assert 0.80 <= share["integrated"] <= 0.99  # 80 intervals: .9 +- .034 by chance
    assert share["plugged"] <= share["integrated"]
    assert float(torch.stack(wider).median()) > 1.02


@pytest.mark.parametrize("tau", [0.0, 1.5])
def test_that_the_most_probable_law_finds_long_correlations_that_a_fit_partly_absorbs(tau: float) -> None:
    """Twelve curves of sixty frames under one gel."""
    shots = [film(seed, tau, frames=60)[0].experiments[0] for seed in range(12)]
    zero = SIMULATOR(PART.to_si(tensor(0.0, 0.0)), tensor(400.0, 0.2), shots[0].times).radius
    source = torch.Generator().manual_seed(3)
    noise = replace(NOISE, correlation_time=tau)
    shots = [
        replace(shot, label=str(i), radius=noise.draw(zero, shot.times, 1, generator=source)) for i, shot in enumerate(shots)
    ]
    batch = ExperimentBatch(tuple(shots), NOISE)
    near = Posterior(PART, batch, SIMULATOR).neighbourhood(fitted(batch)["nhkv"].point)
    law = most_probable_law([near], LAWS)
    assert law.scale == pytest.approx(1.0, rel=0.3 if tau else 0.06)
    assert law.correlation_time <= 0.02 if tau == 0.0 else 0.8 < law.correlation_time < 2.8


def test_that_held_out_curves_are_scored_over_the_noise() -> None:
    batch = experiments(3, noise=CORRELATED)
    weighted = weigh(fitted(batch), SIMULATOR, seed=0, samples=1024, noise=LAWS)
    score = cross_validate(weighted, SIMULATOR, seed=0, folds=[[1]], options=OPTIONS)[0]
    rest = ExperimentBatch((batch.experiments[0], batch.experiments[2]), batch.noise)
    expected = float(by_brute_force(batch)["evidence"] - by_brute_force(rest)["evidence"])
    assert score.value == pytest.approx(expected, abs=4.0 * score.error + 0.05)


def test_that_an_estimate_at_an_end_of_its_range_is_said_and_others_are_not() -> None:
    inner = Noise(floor=0.003, correlation_time=0.4)
    assert noise_edges(inner, NoisePrior()) == ()
    (edge,) = noise_edges(replace(inner, correlation_time=3.2), NoisePrior())
    assert edge.parameter == "correlation_time"
    assert "run diagnose" in str(edge)
    wide = {"correlation_time": [0.1, 0.5, 3.2]}
    assert [e.parameter for e in noise_edges(inner, NoisePrior(), wide)] == ["correlation_time"]
    for floor in (0.002, 0.2):
        (edge,) = noise_edges(replace(inner, floor=floor), NoisePrior())
        assert (edge.parameter, edge.remedy) == ("floor", "")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"correlation_times": (0.5, 0.1)}, "NoisePrior.correlation_times is .* expected 0 < smallest < largest"),
        ({"independent": 1.0}, "NoisePrior.independent is 1.0; expected a probability between 0 and 1"),
        ({"largest_floor": 1.0}, "NoisePrior.largest_floor is 1.0; expected a finite ratio above 1"),
        ({"scales": math.inf}, "NoisePrior.scales is inf; expected a finite ratio above 1"),
    ],
)
def test_that_an_impossible_prior_is_refused(change: dict[str, float], text: str) -> None:
    with pytest.raises(InputDataError, match=text):
        NoisePrior(**change)


def test_that_the_law_of_a_misfit_fits_by_independent_frames_and_states_intervals_that_hold() -> None:
    """Intervals of independent frames are far too narrow for residuals that drift, and widened ones hold."""
    inside: dict[str, list[bool]] = {"independent": [], "widened": []}
    for seed in range(60):
        batch, gel = drifting(seed)
        fit = assimilate(PRIOR, batch, Slow(), seed=0, options=OPTIONS)["nhkv"]
        law = misfit_law([near := Posterior(PART, batch, Slow()).neighbourhood(fit.point)], LAWS)
        alike = most_probable_law([near], LAWS, independent=True)
        assert law == replace(alike, scale=law.widened * alike.scale, widened=law.widened)
        for kind, scale in (("independent", law.scale / law.widened), ("widened", law.scale)):
            found = exact(PART, replace(batch, noise=replace(law, scale=scale)), Slow())
            inside[kind] += ((gel - found.mean).abs() < 1.645 * found.covariance.diagonal().sqrt()).tolist()
    covered = {kind: sum(rows) / len(rows) for kind, rows in inside.items()}
    assert covered["independent"] < 0.75
    assert 0.8 < covered["widened"] < 0.97


def test_that_the_noise_of_a_model_that_misses_the_curves_is_that_of_a_misfit_and_else_that_of_the_camera() -> None:
    batch, _ = drifting(7)

    def noise(explained: bool) -> Noise:
        options = {"rounds": 1, "seed": 0, "options": OPTIONS, "warn": False}
        return assimilate_estimating_noise(PRIOR, batch, Slow(), explains=lambda *_: explained, **options).batch.noise

    missed, held = noise(False), noise(True)
    assert (missed.correlation_time, held.widened) == (0.0, 1.0)
    assert missed.widened > 1.5
    assert held.correlation_time > 0.1
    assert "times as large" in str(missed)
    assert "times as large" not in str(held)
