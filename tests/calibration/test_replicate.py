"""Calibration both ways: right inferences are found calibrated, the user's own among them, and
wrong ones are found out.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from imr_torch.assimilate import En4DVarOptions, SearchOptions
from imr_torch.calibration import Arrangement, calibrate, coverage, uniformity
from imr_torch.design import Plan
from imr_torch.errors import ConvergenceError, ShapeError
from imr_torch.float64 import linspace, randn, zeros
from imr_torch.material import Belief, reference_case
from imr_torch.observe import ExperimentBatch, Nuisance
from imr_torch.random import generator
from imr_torch.simulate import PolytropicSimulator
from tests.linear import NHKV, NOISE, LinearSimulator, exact, prior
from tests.refusals import refused

PLAN = Plan(times=linspace(0.0, 2.0, 13), repeats=16, noise=NOISE, collapses=None)
OPTIONS = SearchOptions(raw_samples=8, starts=2)
LINEAR = Arrangement(
    prior(("nhkv", "gen_qkv")), ((400.0, 0.2),), PLAN, samples=64, options=OPTIONS
)

ONE = replace(LINEAR, prior=NHKV)  # where model probabilities are not asked for


def run(count, *, learn=None, plan=PLAN, simulator=None, arrangement=LINEAR):
    changed = replace(arrangement, learn=learn, plan=plan)
    return list(calibrate(changed, simulator or LinearSimulator(), range(count), seed=3))


def pooled(replicates, kind, name):
    return [getattr(r, kind)[name] for r in replicates if name in r.gaussian]


@pytest.fixture(scope="module")
def default():
    return run(40)  # as many as find each wrong inference below


@pytest.mark.parametrize("kind", ["gaussian", "reported", "weighted"])
def test_that_the_default_is_calibrated(default, kind):
    assert all(r.failure is None and r.converged for r in default)
    for name in ("G", "mu"):
        places = pooled(default, kind, name)
        assert len(places) == 40
        assert uniformity(places).p > 0.01
        assert coverage(places, 0.9).fits
    assert uniformity(pooled(default, kind, "alpha")).p > 0.01


def test_that_model_probabilities_are_reliable(default):
    stated = [r.probabilities["nhkv"] for r in default]
    assert 7.0 < sum(stated) < 33.0
    chance = np.array(stated)
    right = np.array([r.model == "nhkv" for r in default])
    # Spiegelhalter, Stat. Med. 5 (1986), eq. 10
    gap = ((right - chance) * (1.0 - 2.0 * chance)).sum()
    variance = ((1.0 - 2.0 * chance) ** 2 * chance * (1.0 - chance)).sum()
    assert abs(gap) < 2.58 * math.sqrt(variance)


def halved(experiments):
    return ExperimentBatch(experiments, replace(NOISE, scale=0.5))


def enlarged(experiments):
    """A scale that is off by two per cent."""
    return ExperimentBatch(
        tuple(replace(e, radius=1.02 * e.radius) for e in experiments), NOISE
    )


def tempered(experiments):
    """As arXiv 2409.00011 weighs data: one mean curve each, its misfit divided by its frames."""
    noise = replace(NOISE, scale=NOISE.scale * len(experiments[0].times) ** 0.5)
    means = (replace(e, radius=e.radius.mean(0, keepdim=True)) for e in experiments)
    return ExperimentBatch(tuple(means), noise)


@pytest.mark.parametrize("learn", [halved, tempered, enlarged])
def test_that_a_wrong_inference_is_found_out(learn):
    found = run(40, learn=learn, arrangement=ONE)
    for kind in ("gaussian", "reported", "weighted"):
        assert min(uniformity(pooled(found, kind, name)).p for name in ("G", "mu")) < 1e-3


POSTERIORS = {}  # exact ones by model and data, which draws of every width share


def exactly(part, batch):
    key = part.model, *(shot.radius.numpy().tobytes() for shot in batch.experiments)
    if key not in POSTERIORS:
        POSTERIORS[key] = exact(part, batch)
    return POSTERIORS[key]


def drawn_exactly(width=1.0):
    """Draws of the exact posterior, or of one that is wider or narrower than it."""

    def infer(batch, model, seed):
        part = LINEAR.prior[model]
        truth = exactly(part, batch)
        chol = width * torch.linalg.cholesky(truth.covariance)
        noise = randn(200, len(truth.mean), generator=generator(seed))
        return part.physical(part.unwhitened(truth.mean + noise @ chol.mT))

    return infer


@pytest.mark.parametrize(("width", "right"), [(1.0, True), (0.6, False), (1.7, False)])
def test_that_a_function_from_data_to_draws_is_judged(width, right):
    """Several designs, noise that is correlated in time, nuisances, and 200 gels."""
    noise = replace(NOISE, correlation_time=0.3)
    plan = replace(PLAN, nuisance=Nuisance(time_zero=0.1, rest_radius=0.2), noise=noise)
    several = replace(
        LINEAR, designs=((400.0, 0.2), (700.0, 0.15), (250.0, 0.25)), plan=plan
    )
    found = list(
        calibrate(
            several, LinearSimulator(), range(200), seed=5, infer=drawn_exactly(width)
        )
    )
    assert {len(r.reported) for r in found} == {2, 3}
    for name in ("G", "mu"):
        test = uniformity([r.reported[name] for r in found])
        assert (test.p > 0.01) is right
        assert (test.spread > 1.0) is (width < 1.0) or right


def test_that_draws_of_a_wrong_shape_are_an_error_that_says_which_is_right():
    with refused(r"infer returned draws of shape \(7,\) .* in the order G, mu", ShapeError):
        list(
            calibrate(
                LINEAR, LinearSimulator(), range(2), seed=0, infer=lambda *_: torch.zeros(7)
            )
        )


def test_that_ensemble_4dvar_is_calibrated():
    found = run(40, arrangement=replace(ONE, options=En4DVarOptions()))
    for name in ("G", "mu"):
        assert uniformity([r.gaussian[name] for r in found]).p > 0.01


def test_that_nuisances_are_drawn_and_marginalised():
    plan = replace(PLAN, nuisance=Nuisance(time_zero=0.1, rest_radius=0.2))
    found = run(24, plan=plan, arrangement=ONE)
    for name in ("G", "mu"):
        assert uniformity(pooled(found, "weighted", name)).p > 0.01


def test_that_a_replicate_depends_on_its_number_alone():
    few = {r.number: r for r in calibrate(LINEAR, LinearSimulator(), [5, 2], seed=3)}
    many = {r.number: r for r in run(6)}
    for number in (2, 5):
        assert few[number].model == many[number].model
        assert few[number].weighted == pytest.approx(many[number].weighted, abs=1e-6)
    other = next(iter(calibrate(LINEAR, LinearSimulator(), [5], seed=4)))
    assert other.weighted != pytest.approx(many[5].weighted, abs=1e-3)


def test_that_gels_that_cannot_be_simulated_are_drawn_again():
    most = float(NHKV.models[0].means[0])
    found = run(8, simulator=LinearSimulator(limit={"G": most}), arrangement=ONE)
    assert sum(r.redrawn for r in found) > 3
    with refused("None of 50 gels", ConvergenceError):
        run(1, simulator=LinearSimulator(fails=True))


def test_that_bubbles_serve():
    plan = Plan(times=linspace(0.0, 2.2, 45), repeats=20)
    part = reference_case("soft-pa").prior["nhkv"]
    soft = replace(
        LINEAR,
        prior=Belief((part,), zeros(1)),
        options=SearchOptions(raw_samples=8, starts=2),
    )
    found = run(2, arrangement=soft, plan=plan, simulator=PolytropicSimulator())
    for replicate in found:
        places = (
            *replicate.gaussian.values(),
            *replicate.weighted.values(),
        )
        assert all(0.0 <= place <= 1.0 for place in places)
        assert replicate.probabilities == {"nhkv": 1.0}
