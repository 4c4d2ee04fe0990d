"""The noise as part of the posterior: closed forms, sums over laws by dense algebra, coverage, and
intervals beside misfits.
"""

import math
from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import (
    Assimilation,
    NoiseNodes,
    Posterior,
    SearchOptions,
    assimilate,
    noise_nodes,
    weigh,
)
from imr_torch.float64 import linspace, randn, zeros
from imr_torch.observe import CollapseTime, Experiment, ExperimentBatch, NoiseLaws, Nuisance
from imr_torch.random import generator
from tests.curved import mean_error, sd_error
from tests.drifting import SLOW, assert_that_only_widened_hold, drifting, hold
from tests.linear import (
    CORRELATED,
    NHKV,
    NOISE,
    LinearSimulator,
    exact,
    experiments,
    fit_noise,
    tensor,
)
from tests.refusals import refused

PRIOR = NHKV
PART = PRIOR.models[0]
SIMULATOR = LinearSimulator()
OPTIONS = SearchOptions(raw_samples=8, starts=2)
UNCERTAIN = Nuisance(time_zero=0.05, rest_radius=0.05)
KNOWN = NoiseLaws(
    (CORRELATED, replace(NOISE, scale=1.7)), tensor(0.6, 0.4), tensor(0.2, 0.3)
)


def fitted(batch: ExperimentBatch) -> Assimilation:
    return assimilate(PRIOR, batch, SIMULATOR, seed=0, options=OPTIONS)


def nodes_of(batch: ExperimentBatch) -> NoiseNodes:
    return NoiseNodes.about_fit(
        KNOWN, Posterior(PART, batch, SIMULATOR).neighbourhood(fitted(batch)["nhkv"].point)
    )


def by_brute_force(batch: ExperimentBatch, nodes: NoiseNodes) -> dict[str, torch.Tensor]:
    """Exact evidence and posterior over all laws of the nodes, by dense algebra."""
    found = [
        exact(PART, replace(batch, noise=nodes.law_at(number)))
        for number in range(len(nodes))
    ]
    values = (
        torch.tensor([one.log_evidence for one in found], dtype=torch.float64)
        + nodes.log_prior.flatten()
    )
    mean = torch.stack([one.mean for one in found])
    covariances = torch.stack([one.covariance for one in found])
    weights = torch.softmax(values, 0)
    whole = weights @ mean
    apart = mean - whole
    covariance = torch.einsum(
        "m,mij->ij", weights, covariances + apart[:, :, None] * apart[:, None]
    )
    return {
        "evidence": torch.logsumexp(values, 0),
        "mean": whole,
        "covariance": covariance,
        "weights": weights,
    }


@pytest.mark.parametrize("nuisance", [Nuisance(), UNCERTAIN])
def test_that_evidence_and_moments_over_the_noise_are_those_of_brute_force_sums(nuisance):
    batch = experiments(2, nuisance=nuisance, noise=CORRELATED)
    nodes = nodes_of(batch)
    expected = by_brute_force(batch, nodes)
    fit = weigh(fitted(batch), SIMULATOR, seed=0, samples=1024, noise=nodes)["nhkv"]
    sample = fit.sample
    assert sample.reliable
    assert sample.log_evidence == pytest.approx(
        float(expected["evidence"]), abs=4.0 * sample.log_evidence_error + 0.01
    )
    assert ((sample.mean - expected["mean"]).abs() < 4.0 * mean_error(sample) + 1e-3).all()
    sds = expected["covariance"].diagonal().sqrt()
    assert (
        (sample.covariance.diagonal().sqrt() - sds).abs()
        < 4.0 * sd_error(sample) + 0.01 * sds
    ).all()
    whole = (PART.chol @ torch.linalg.cholesky(expected["covariance"])).norm(dim=1)
    assert (fit.posterior.chol.norm(dim=1) / whole - 1.0).abs().max() < 0.1


def film(seed: int, frames: int = 14) -> tuple[ExperimentBatch, torch.Tensor]:
    """One curve of few frames of a gel of the prior, of a noise between half and twice the law that is stated."""
    source = generator(seed)
    gel = randn(2, generator=source)
    times = linspace(0.05, 2.5, frames)
    clean = SIMULATOR(PART.to_si(gel), tensor(400.0, 0.2), times).radius
    scale = 2.0 ** float(2.0 * torch.rand((), generator=source) - 1.0)
    seen = replace(NOISE, scale=scale).draw(clean, times, 1, generator=source)
    return ExperimentBatch((Experiment("a", (400.0, 0.2), times, seen),), NOISE), gel


def test_that_intervals_over_the_noise_cover_where_plugged_in_ones_are_narrower(
    few_deviations,
):
    inside: dict[str, list[bool]] = {"plugged": [], "integrated": []}
    wider = []
    for seed in range(40):
        batch, gel = film(1000 + seed)
        fits = fit_noise(batch, seed=seed)
        sds = []
        for kind, noise in (
            ("plugged", None),
            ("integrated", noise_nodes(fits, SIMULATOR)),
        ):
            belief = weigh(fits, SIMULATOR, seed=seed, samples=128, noise=noise)[
                "nhkv"
            ].posterior
            sd = belief.chol.norm(dim=1)
            inside[kind] += (
                (PART.unwhitened(gel) - belief.mean).abs() < 1.645 * sd
            ).tolist()
            sds.append(sd)
        wider.append(sds[1] / sds[0])
    share = {kind: sum(found) / len(found) for kind, found in inside.items()}
    assert 0.82 <= share["integrated"] <= 0.98  # 80 intervals: .9 +- .034 by chance
    assert share["plugged"] <= share["integrated"]
    assert torch.stack(wider).median() > 1.01


def test_that_intervals_beside_residuals_that_drift_hold_and_those_of_independent_frames_do_not(
    few_deviations,
):
    inside: dict[str, list[bool]] = {"independent": [], "widened": []}
    for seed in range(25):
        batch, gel = drifting(seed)
        fits = fit_noise(batch, SLOW, seed=seed)
        law = fits.batch.noise
        assert (law.correlation_time, law.widened > 1.5) == (0.0, True)
        for kind, one in (("independent", law.of_frames), ("widened", law)):
            inside[kind] += hold(replace(fits.batch, noise=one, noise_laws=None), gel)
    assert_that_only_widened_hold(inside)


def independent(seed: int, repeats: int = 1) -> ExperimentBatch:
    """Two curves of the model that is fitted, of independent frames."""
    source = generator(seed)
    times = linspace(0.05, 2.5, 40)
    clean = SLOW(PART.to_si(zeros(2)), tensor(400.0, 0.2), times).radius
    rows = [NOISE.draw(clean, times, repeats, generator=source) for _ in range(2)]
    return ExperimentBatch(
        tuple(Experiment(f"{k}", (400.0, 0.2), times, row) for k, row in enumerate(rows)),
        NOISE,
    )


@pytest.mark.parametrize("repeats", [1, 6])
def test_that_intervals_stay_as_they_are_where_frames_are_independent(
    repeats, few_deviations
):
    """But for one in twenty, by chance."""
    factors = []
    for seed in range(16):
        batch = independent(seed, repeats)
        fits = fit_noise(batch, SLOW, seed=seed)
        factors.append(fits.batch.noise.widened)
    assert sorted(factors)[8] < 1.05
    assert sum(factor > 1.3 for factor in factors) <= 2


def test_that_repeats_tell_a_misfit_from_noise():
    """Every repeat has the same deviation from the model: no noise, so the law stays, and intervals
    widen.
    """
    batch = independent(0, 6)
    bent = 0.3 * torch.sin(3.0 * batch.experiments[0].times)
    moved = replace(
        batch,
        experiments=tuple(replace(e, radius=e.radius + bent) for e in batch.experiments),
    )
    fits = fit_noise(moved, SLOW, rounds=2)
    level = float(
        fits.batch.of_frames.noise.sd(tensor(0.5), tensor(1.0))
        / NOISE.sd(tensor(0.5), tensor(1.0))
    )
    assert level == pytest.approx(1.0, rel=0.15)
    assert fits.batch.noise.widened > 2.0
    assert fits.batch.noise.of_frames.sd(tensor(0.5), tensor(1.0)) > 2.0 * NOISE.sd(
        tensor(0.5), tensor(1.0)
    )
    assert math.isfinite(
        float(
            weigh(fits, SLOW, seed=0, noise=noise_nodes(fits, SLOW))["nhkv"].posterior.sds[
                0
            ]
        )
    )


def test_that_laws_of_frames_are_refused_beside_collapse_times():
    """A collapse time has an error of its own, which no law of the camera's noise is."""
    batch = experiments(1, noise=CORRELATED)
    nodes = nodes_of(batch)
    time = CollapseTime("time", (400.0, 0.2), 0.9, 0.01)
    both = replace(
        fitted(batch), batch=replace(batch, experiments=(*batch.experiments, time))
    )
    with refused("error of their own; leave noise out"):
        weigh(both, SIMULATOR, seed=0, noise=nodes)
