"""Evidence against its closed form for a linear simulator, its stated error against the scatter over seeds."""

import math
from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from imr_torch.assimilate import Assimilation, ModelFit, Verdict, weigh
from imr_torch.assimilate.importance import are_reliable
from imr_torch.float64 import eye, randn, zeros
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import generator
from imr_torch.select import Evidence, evidences, log_evidence, probability_errors, update
from tests.linear import (
    BATCHES,
    BOTH,
    MEANS,
    MODELS,
    NHKV,
    NOISE,
    SDS,
    LinearSimulator,
    exact,
    experiments,
    fit_linear,
    prior,
    tensor,
)
from tests.refusals import refused
from tests.tables import for_each


def fitted(batch: ExperimentBatch, belief: Belief | None = None) -> Assimilation:
    return fit_linear(batch, belief=belief or prior())


def weighted(
    fit: ModelFit,
    batch: ExperimentBatch,
    simulator: LinearSimulator | None = None,
    **options,
) -> Evidence:
    """Evidence of one fit from its own draws."""
    belief = Belief((fit.prior,), tensor(0.0))
    return log_evidence(
        weigh(
            Assimilation(belief, batch, (fit,)), simulator or LinearSimulator(), **options
        ).fits[0]
    )


def is_trusted(evidence: Evidence) -> bool:
    return are_reliable(evidence.pareto_k, evidence.effective_samples, evidence.samples)


def found(
    assimilation: Assimilation, *, seed: int, samples: int = 256
) -> tuple[Evidence, ...]:
    return evidences(weigh(assimilation, LinearSimulator(), seed=seed, samples=samples))


@pytest.fixture(scope="module")
def simple():
    batch = experiments(3, nuisance=BOTH)
    belief = NHKV
    return batch, fitted(batch, belief).fits[0], exact(belief.models[0], batch).log_evidence


@pytest.mark.parametrize(
    "correlated", [False, True], ids=["standard prior", "correlated prior"]
)
@for_each("batch", BATCHES)
def test_that_the_evidence_is_within_four_errors_of_its_closed_form(batch, correlated):
    belief = prior(correlated=correlated)
    for part, evidence in zip(
        belief.models, found(fitted(batch, belief), seed=3, samples=1024), strict=True
    ):
        assert evidence.model == part.model
        assert evidence.error < 0.03
        assert evidence.value == pytest.approx(
            exact(part, batch).log_evidence, abs=4.0 * evidence.error
        )
        assert is_trusted(evidence)
        assert (evidence.samples, evidence.failed) == (1024, 0)


@pytest.mark.parametrize("samples", [64, 512])
def test_that_the_stated_error_is_the_scatter_over_seeds(simple, samples):
    batch, fit, truth = simple
    runs = [weighted(fit, batch, seed=seed, samples=samples) for seed in range(60)]
    values = tensor(*[r.value for r in runs])
    errors = tensor(*[r.error for r in runs])
    scatter = float((values - truth).square().mean().sqrt())
    assert scatter == pytest.approx(float(errors.square().mean().sqrt()), rel=0.3)
    assert abs(values.mean() - truth) < 4.0 * scatter / 60.0**0.5 + errors.mean() ** 2


@pytest.mark.parametrize("nuisance", [None, BOTH], ids=["known designs", "nuisances"])
def test_that_evidence_and_odds_multiply_exactly_once_over_designs_seen_in_turn(nuisance):
    """``p(y_1 ...

    y_n | m) = prod_i p(y_i | y_1 ... y_i-1, m)``: each posterior is the next prior, and nothing
    counts twice.
    """
    belief = prior(("newtonian", "nhkv", "gen_qkv"))
    batch = experiments(4, nuisance=nuisance)
    running = belief
    totals = zeros(3)
    variances = zeros(3)
    for number, experiment in enumerate(batch.experiments):
        step = weigh(
            fitted(ExperimentBatch((experiment,), NOISE), running),
            LinearSimulator(),
            seed=number,
            samples=1024,
        )
        after = evidences(step)
        totals += tensor(*[e.value for e in after])
        variances += tensor(*[e.error**2 for e in after])
        running = update(step, after)
    joint = tensor(*[exact(part, batch).log_evidence for part in belief.models])
    assert ((totals - joint).abs() < 4.0 * variances.sqrt()).all()
    assert variances.sqrt().max() < 0.03
    odds = running.log_probabilities - running.log_probabilities[1]
    expected = (belief.log_probabilities + joint) - (belief.log_probabilities + joint)[1]
    assert_close(odds, expected, rtol=0.0, atol=0.2)
    whole = exact(belief.models[1], batch)
    chained = running["nhkv"]
    # with uncertain designs, what the draws correct keeps the chance in the nuisances that each of
    # them integrates over
    chance, chance_of_squares = (1e-5, 1e-5) if nuisance is None else (0.03, 0.1)
    moved = torch.linalg.solve_triangular(
        torch.linalg.cholesky(whole.covariance),
        (chained.mean - whole.mean)[:, None],
        upper=False,
    )
    scaled = torch.linalg.solve_triangular(
        torch.linalg.cholesky(whole.covariance), chained.chol, upper=False
    )
    assert moved.abs().max() < chance
    assert_close(scaled @ scaled.mT, eye(2), rtol=0.0, atol=chance_of_squares)


def test_that_samples_that_fail_count_as_impossible_data(simple):
    """A simulator that fails above the posterior mean of G halves the integral."""
    batch, fit, truth = simple
    limit = MEANS["G"] + SDS["G"] * float(fit.mean[0])
    evidence = weighted(
        fit, batch, LinearSimulator(limit={"G": limit}), seed=2, samples=4096, rounds=1
    )
    assert evidence.failed == pytest.approx(2048, abs=130)
    assert evidence.value == pytest.approx(truth - math.log(2.0), abs=4.0 * evidence.error)


def test_that_a_fit_without_weighted_draws_has_no_evidence(simple):
    with refused(
        r"The fit of 'nhkv' has no weighted draws; pass its assimilation through `weigh`"
    ):
        log_evidence(simple[1])


@pytest.mark.parametrize("odds", [(1.0, 1.0, 1.0), (0.98, 0.01, 0.01), (0.0, 0.5, 0.5)])
def test_that_probabilities_follow_bayes_rule_over_models(odds):
    batch = experiments(1)
    belief = Belief(prior().models, tensor(*odds).log())
    assimilation = fitted(batch, belief)
    evidence = found(assimilation, seed=1, samples=4096)
    after = update(assimilation, evidence)
    logs = belief.log_probabilities + tensor(
        *[exact(part, batch).log_evidence for part in belief.models]
    )
    expected = torch.softmax(logs, dim=0)
    error = max(e.error for e in evidence)
    assert_close(after.log_probabilities.exp(), expected, rtol=0.0, atol=4.0 * error)
    for fit, part in zip(assimilation.fits, after.models, strict=True):
        assert torch.equal(part.mean, fit.posterior.mean)
        assert part.marginals == fit.prior.marginals
    assert belief.probabilities == Belief(prior().models, tensor(*odds).log()).probabilities


def made(model: str) -> Evidence:
    return Evidence(model, 0.0, 0.1, 100.0, 256, 0, 0.3)


@pytest.mark.parametrize(
    "models", [("nhkv", "newtonian", "gen_qkv"), ("newtonian", "nhkv"), ()]
)
def test_that_evidence_of_other_models_is_refused(models):
    with refused(
        r"Evidence of .* does not match the belief over \['newtonian', 'nhkv', 'gen_qkv'\]"
    ):
        update(fitted(experiments(1)), [made(model) for model in models])


def test_that_the_error_of_a_probability_is_the_scatter_that_the_evidence_errors_make():
    belief = prior()
    evidence = [
        Evidence(m, v, e, 200.0, 256, 0, 0.1)
        for m, v, e in zip(MODELS, (0.3, 0.0, -1.0), (0.05, 0.08, 0.02), strict=True)
    ]
    noise = randn(200_000, 3, generator=generator(0))
    logs = tensor(*[e.value for e in evidence]) + noise * tensor(
        *[e.error for e in evidence]
    )
    scatter = torch.softmax(belief.log_probabilities + logs, dim=1).std(0)
    errors = probability_errors(belief, evidence)
    assert_close(tensor(*errors.values()), scatter, rtol=0.02, atol=0.0)
    assert tuple(errors) == MODELS


def test_that_the_error_of_a_refused_model_holds_what_its_draws_may_lack():
    sample = SimpleNamespace(
        log_evidence=0.0,
        log_evidence_error=0.1,
        doubtful_error=0.3,
        surprise=0.4,
        effective_samples=64.0,
        failed=0,
        pareto_k=0.54,
    )
    sized = type("Sample", (SimpleNamespace,), {"__len__": lambda self: 256})(
        **vars(sample)
    )
    fit = SimpleNamespace(model="nhkv", sample=sized, verdict=Verdict.REPAIRED)
    assert log_evidence(fit).error == 0.1
    fit.verdict = Verdict.REFUSED
    assert log_evidence(fit).error == pytest.approx(0.5)
    sized.surprise = float("nan")
    assert log_evidence(fit).error > 50.0
