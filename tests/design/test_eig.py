"""The information gain against closed forms: a linear camera of Gaussian parameters, where
everything is known exactly.
"""

import math
from dataclasses import replace

import pytest
import torch
from torch.distributions import MultivariateNormal

from benchmarks.nested import NestedMonteCarlo, PriorContrastive
from imr_torch.design import (
    ExpectedInformationGain,
    Laplace,
    expected_information_gain,
)
from imr_torch.errors import ShapeError
from imr_torch.float64 import linspace, tensor, zeros
from imr_torch.material import Belief, reference_case
from imr_torch.observe import Noise, Nuisance
from imr_torch.simulate import PolytropicSimulator, Stepping
from tests.clouds import cloud
from tests.design.linear_camera import (
    DESIGNS,
    ONE,
    SIGMA,
    TWO,
    LinearCamera,
    correlated,
    covariance,
    exact,
    plan,
    sensitivity,
)
from tests.refusals import refusals, refused

CORRELATED = Noise(slope=0.0, drift=0.0, floor=SIGMA, correlation_time=0.5)
COARSE = Noise(slope=0.0, drift=0.0, floor=1.0)
BOTH = Nuisance(time_zero=0.1, rest_radius=0.3)


def gain(belief, designs, how, estimator, *, camera=None, seed=0):
    return expected_information_gain(
        belief, designs, camera or LinearCamera(), how, estimator=estimator, seed=seed
    )


@pytest.mark.parametrize("draws", [6, 100])
def test_that_a_belief_that_bends_gains_as_its_cloud_and_not_as_its_gaussian(draws):
    """The draws of a narrow belief inside a Gaussian five times as wide: the gain is that of the
    narrow one.
    """
    part = correlated().models[0]
    how = plan(repeats=10)
    estimator = Laplace(draws=draws)
    narrow = correlated()
    controls = part.controls(32, seed=0)
    precision = torch.cholesky_inverse(part.chol).expand(32, -1, -1)
    wide = replace(part, chol=5.0 * part.chol)
    bent = Belief((wide.with_cloud(cloud(controls, precision)),), zeros(1))
    fat = Belief((wide,), zeros(1))
    found = gain(bent, DESIGNS[:1], how, estimator)
    assert found.value == pytest.approx(exact(narrow, DESIGNS[:1], how), rel=1e-7)
    assert gain(fat, DESIGNS[:1], how, estimator).value > found.value + 2.0


@pytest.mark.parametrize("q", [1, 2])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"repeats": 100},
        {"noise": CORRELATED},
        {"nuisance": BOTH},
        {"nuisance": BOTH, "noise": CORRELATED, "repeats": 10},
    ],
    ids=["one curve", "100 repeats", "correlated", "nuisances", "all three"],
)
def test_laplace_is_exact_for_a_linear_gaussian_model(q, changes):
    estimator = Laplace(draws=6)
    how = plan(**changes)
    for belief in (ONE, correlated()):
        found = gain(belief, DESIGNS[:q], how, estimator)
        assert found.value == pytest.approx(exact(belief, DESIGNS[:q], how), rel=1e-7)
        assert found.model == pytest.approx(0.0, abs=1e-12)
        assert found.variance < 1e-12
        assert found.counted == found.drawn == 6


def model_information(belief, how, count=40000):
    """``I(y; m)`` by plain Monte Carlo with the exact Gaussian evidences; its error is below .004."""
    if len(belief.models) == 1:
        return 0.0
    noise = covariance(DESIGNS[:1], how)
    laws = []
    for part in belief.models:
        J = sensitivity(part, DESIGNS[:1])
        laws.append(MultivariateNormal(zeros(7), J @ J.mT + noise))
    torch.manual_seed(0)
    weights = belief.log_probabilities
    value = 0.0
    for i, law in enumerate(laws):
        y = law.sample((count,))
        logs = torch.stack([other.log_prob(y) for other in laws])
        value += float(
            weights[i].exp()
            * (logs[i] - torch.logsumexp(logs + weights[:, None], 0)).mean()
        )
    return value


def test_the_gain_splits_into_parameters_and_model():
    how = plan(noise=replace(COARSE, floor=0.1))
    found = gain(TWO, DESIGNS[:1], how, Laplace(draws=400, rivals=400), seed=1)
    error = found.variance**0.5 + 0.004
    assert abs(found.parameters - exact(TWO, DESIGNS[:1], how)) < 4.0 * error
    assert abs(found.model - model_information(TWO, how)) < 4.0 * error
    assert found.model > 5.0 * error
    assert found.value == found.parameters + found.model


def test_the_stated_variance_is_the_scatter_over_seeds():
    how = plan(noise=replace(COARSE, floor=SIGMA))
    found = [gain(TWO, DESIGNS[:1], how, Laplace(draws=16), seed=s) for s in range(60)]
    values = tensor([f.value for f in found])
    z = (values - values.mean()) / tensor([f.variance for f in found]).sqrt()
    assert 0.7 < z.std() < 1.4


def test_failed_bubbles_are_counted_and_too_many_make_the_estimate_void():
    estimator = Laplace(draws=64)
    some = gain(ONE, DESIGNS[:1], plan(), estimator, camera=LinearCamera(limit=0.3))
    assert 32 < some.counted < 64
    assert not some.failed
    assert math.isfinite(some.value)
    most = gain(ONE, DESIGNS[:1], plan(), estimator, camera=LinearCamera(limit=-0.2))
    assert most.counted < 32
    assert most.failed
    assert math.isnan(most.value)


def test_a_model_of_negligible_probability_costs_nothing():
    sure = Belief(TWO.models, tensor([-30.0, 0.0]))
    found = gain(sure, DESIGNS[:1], plan(), Laplace(draws=6))
    assert found.drawn == 6
    assert found.value == pytest.approx(
        exact(Belief(TWO.models[1:], zeros(1)), DESIGNS[:1], plan())
    )


def test_a_shorter_window_tells_less():
    belief = reference_case("soft-pa").prior
    design = tensor([[400.0, 0.2]])
    values = []
    for collapses in (1, 2, None):
        how = replace(
            plan(),
            times=linspace(0.0, 4.0, 41),
            noise=Noise(),
            collapses=collapses,
        )
        values.append(
            gain(belief, design, how, Laplace(draws=8), camera=PolytropicSimulator()).value
        )
    assert values[0] < values[1] < values[2]


def test_laplace_and_bounds_agree_on_bubbles():
    belief = reference_case("stiff-pa").prior
    design = tensor([[900.0, 0.28]])
    how = replace(plan(), times=linspace(0.0, 2.4, 31), noise=Noise())
    bubbles = PolytropicSimulator(stepping=Stepping(0.25))
    found = {
        type(estimator).__name__: gain(belief, design, how, estimator, camera=bubbles)
        for estimator in (
            Laplace(draws=32, rivals=32),
            PriorContrastive(draws=32, inner=200),
            NestedMonteCarlo(draws=32, inner=200),
        )
    }
    error = found["Laplace"].variance ** 0.5
    assert (
        found["PriorContrastive"].value - error
        < found["Laplace"].value
        < found["NestedMonteCarlo"].value + error
    )


def test_the_estimate_is_a_function_of_its_seed():
    acquisition = ExpectedInformationGain(
        reference_case("soft-pa").prior,
        PolytropicSimulator(stepping=Stepping(0.25)),
        Laplace(draws=4, refinements=1),
        plan=plan(),
        seed=3,
    )
    design = tensor([[400.0, 0.2]])
    first = acquisition.estimate(design)
    torch.manual_seed(99)
    assert acquisition.estimate(design) == first
    assert acquisition.estimate(design, seed=4) != first
    assert acquisition.estimate(design) == first


test_impossible_estimators_are_refused = refusals(
    (lambda: Laplace(draws=1), "Laplace.draws is 1; expected at least 2"),
    (lambda: Laplace(rivals=1), "Laplace.rivals is 1; expected at least 2"),
    (lambda: Laplace(refinements=-1), "Laplace.refinements is -1; expected at least 0"),
)


def test_a_design_without_its_dimension_of_bubbles_is_refused():
    with refused(r"designs has shape \(2,\); expected q x 2", ShapeError):
        gain(ONE, DESIGNS[0], plan(), Laplace())
