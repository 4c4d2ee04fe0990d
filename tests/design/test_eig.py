"""The information gain against closed forms: a linear camera of Gaussian parameters, where
everything is known exactly.
"""

import math
from dataclasses import fields, is_dataclass, replace

import pytest
import torch
from torch.distributions import MultivariateNormal

from benchmarks.nested import NestedMonteCarlo, PriorContrastive
from imr_torch.design import (
    ExpectedInformationGain,
    Laplace,
    expected_information_gain,
)
from imr_torch.errors import InputDataError, ShapeError
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
    normal,
    plan,
    sensitivity,
)

CORRELATED = Noise(slope=0.0, drift=0.0, floor=SIGMA, correlation_time=0.5)
COARSE = Noise(slope=0.0, drift=0.0, floor=1.0)
BOTH = Nuisance(time_zero=0.1, rest_radius=0.3)
EVERY = (
    Laplace,
    NestedMonteCarlo,
    PriorContrastive,
)


def name(value):
    return type(value).__name__ if is_dataclass(value) else None


def sized(kind, **sizes):
    """An estimator with those of some sizes that it has."""
    return kind(
        **{key: value for key, value in sizes.items() if key in {f.name for f in fields(kind)}}
    )


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
    bent = Belief(
        (wide.with_cloud(cloud(controls, precision)),), torch.zeros(1, dtype=torch.float64)
    )
    fat = Belief((wide,), torch.zeros(1, dtype=torch.float64))
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


def test_laplace_is_not_bounded_by_the_number_of_draws():
    precise = plan(repeats=10**8)
    found = gain(ONE, DESIGNS[:1], precise, Laplace(draws=6))
    assert found.value == pytest.approx(exact(ONE, DESIGNS[:1], precise), rel=1e-6)
    assert found.value > 5 * math.log(6)


@pytest.mark.parametrize(
    "estimator",
    [
        NestedMonteCarlo(draws=600, inner=1200),
        PriorContrastive(draws=600, inner=1200),
    ],
    ids=name,
)
@pytest.mark.parametrize("belief", [ONE, TWO], ids=["one model", "two models"])
def test_sampling_estimators_meet_the_closed_form_within_their_error_where_the_gain_is_small(
    estimator, belief
):
    how = plan(noise=replace(COARSE, floor=0.5 if belief is ONE else 0.3))
    found = gain(belief, DESIGNS[:1], how, estimator, seed=3)
    truth = exact(belief, DESIGNS[:1], how) + model_information(belief, how)
    assert truth > 0.2
    assert abs(found.value - truth) < 4.0 * found.variance**0.5 + 0.02
    assert found.variance**0.5 < 0.1


def model_information(belief, how, count=40000):
    """``I(y; m)`` by plain Monte Carlo with the exact Gaussian evidences; its error is below .004."""
    if len(belief.models) == 1:
        return 0.0
    noise = covariance(DESIGNS[:1], how)
    laws = []
    for part in belief.models:
        J = sensitivity(part, DESIGNS[:1])
        laws.append(MultivariateNormal(torch.zeros(7).double(), J @ J.mT + noise))
    torch.manual_seed(0)
    weights = belief.log_probabilities
    value = 0.0
    for i, law in enumerate(laws):
        y = law.sample((count,))
        logs = torch.stack([other.log_prob(y) for other in laws])
        value += float(
            weights[i].exp() * (logs[i] - torch.logsumexp(logs + weights[:, None], 0)).mean()
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


@pytest.mark.parametrize("repeats", [1, 10**4])
def test_that_the_gain_is_between_nested_monte_carlo_and_prior_contrastive(repeats):
    how = plan(repeats=repeats)
    truth = exact(ONE, DESIGNS[:1], how)
    found = {}
    for kind, sign in ((PriorContrastive, 1.0), (NestedMonteCarlo, -1.0)):
        gains = [gain(ONE, DESIGNS[:1], how, kind(draws=40, inner=200), seed=s) for s in range(12)]
        values = torch.tensor([g.value for g in gains], dtype=torch.float64)
        assert float(sign * (values.mean() - truth)) < 3.0 * float(values.std()) / 12**0.5
        found[kind] = values
    if repeats > 1:
        assert float(found[PriorContrastive].max()) <= math.log(200) + 1e-9
        assert float(found[NestedMonteCarlo].min()) > math.log(200)


@pytest.mark.parametrize(
    ("estimator", "floor"),
    [
        (Laplace(draws=16), SIGMA),
        (NestedMonteCarlo(draws=400, inner=40), 0.5),
        (PriorContrastive(draws=400, inner=40), 0.5),
    ],
    ids=name,
)
def test_the_stated_variance_is_the_scatter_over_seeds(estimator, floor):
    how = plan(noise=replace(COARSE, floor=floor))
    found = [gain(TWO, DESIGNS[:1], how, estimator, seed=s) for s in range(60)]
    values = torch.tensor([f.value for f in found], dtype=torch.float64)
    z = (values - values.mean()) / torch.tensor(
        [f.variance for f in found], dtype=torch.float64
    ).sqrt()
    assert 0.7 < float(z.std()) < 1.4


def test_the_variance_counts_the_inner_samples_that_all_data_share():
    how = plan(noise=replace(COARSE, floor=0.5))
    few = gain(ONE, DESIGNS[:1], how, NestedMonteCarlo(draws=2000, inner=20))
    many = gain(ONE, DESIGNS[:1], how, NestedMonteCarlo(draws=2000, inner=2000))
    assert few.variance > 5.0 * many.variance


@pytest.mark.parametrize("kind", EVERY)
def test_failed_bubbles_are_counted_and_too_many_make_the_estimate_void(kind):
    estimator = sized(kind, draws=64, inner=8)
    some = gain(ONE, DESIGNS[:1], plan(), estimator, camera=LinearCamera(limit=0.3))
    assert 32 < some.counted < 64
    assert not some.failed
    assert math.isfinite(some.value)
    most = gain(ONE, DESIGNS[:1], plan(), estimator, camera=LinearCamera(limit=-0.2))
    assert most.counted < 32
    assert most.failed
    assert math.isnan(most.value)


@pytest.mark.parametrize("kind", EVERY)
def test_a_belief_none_of_whose_gels_can_be_simulated_gives_a_failed_evaluation(kind):
    for belief in (ONE, TWO):
        none = gain(
            belief,
            DESIGNS[:1],
            plan(),
            sized(kind, draws=4, inner=4),
            camera=LinearCamera(limit=-100.0),
        )
        assert none.counted == 0
        assert math.isnan(none.value)


def test_two_bubbles_together_tell_less_than_the_sum_and_more_than_each():
    estimator = Laplace(draws=40)
    both = gain(ONE, DESIGNS, plan(), estimator).value
    each = [gain(ONE, d[None], plan(), estimator).value for d in DESIGNS]
    assert max(each) < both < sum(each)


@pytest.mark.parametrize("kind", [Laplace, NestedMonteCarlo])
def test_the_gain_does_not_depend_on_the_units_of_the_parameters(kind):
    units = (1e4, 3.0, 0.01)
    scaled = Belief.prior(
        {"gen_qkv": {"G": normal(3e3), "mu": normal(0.6), "alpha": normal(0.005)}}
    )
    estimator = sized(kind, draws=30, inner=32)
    first = gain(ONE, DESIGNS[:1], plan(), estimator)
    second = gain(scaled, DESIGNS[:1], plan(), estimator, camera=LinearCamera(units=units))
    assert second.value == pytest.approx(first.value, rel=1e-6)
    assert second.variance == pytest.approx(first.variance, rel=1e-4, abs=1e-12)


def test_a_model_of_negligible_probability_costs_nothing():
    sure = Belief(TWO.models, torch.tensor([-30.0, 0.0], dtype=torch.float64))
    found = gain(sure, DESIGNS[:1], plan(), Laplace(draws=6))
    assert found.drawn == 6
    assert found.value == pytest.approx(
        exact(Belief(TWO.models[1:], torch.zeros(1).double()), DESIGNS[:1], plan())
    )


def test_a_shorter_window_tells_less():
    belief = reference_case("soft-pa").prior
    design = torch.tensor([[400.0, 0.2]], dtype=torch.float64)
    values = []
    for collapses in (1, 2, None):
        how = replace(
            plan(),
            times=torch.linspace(0.0, 4.0, 41, dtype=torch.float64),
            noise=Noise(),
            collapses=collapses,
        )
        values.append(
            gain(belief, design, how, Laplace(draws=8), camera=PolytropicSimulator()).value
        )
    assert values[0] < values[1] < values[2]


def test_laplace_and_bounds_agree_on_bubbles():
    belief = reference_case("stiff-pa").prior
    design = torch.tensor([[900.0, 0.28]], dtype=torch.float64)
    how = replace(plan(), times=torch.linspace(0.0, 2.4, 31, dtype=torch.float64), noise=Noise())
    bubbles = PolytropicSimulator(stepping=Stepping(0.25))
    found = {
        name(estimator): gain(belief, design, how, estimator, camera=bubbles)
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


@pytest.mark.parametrize("kind", [Laplace, NestedMonteCarlo])
def test_the_estimate_is_a_function_of_its_seed(kind):
    acquisition = ExpectedInformationGain(
        reference_case("soft-pa").prior,
        PolytropicSimulator(stepping=Stepping(0.25)),
        sized(kind, draws=4, inner=4, refinements=1),
        plan=plan(),
        seed=3,
    )
    design = torch.tensor([[400.0, 0.2]], dtype=torch.float64)
    first = acquisition.estimate(design)
    torch.manual_seed(99)
    assert acquisition.estimate(design) == first
    assert acquisition.estimate(design, seed=4) != first
    assert acquisition.estimate(design) == first


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Laplace(draws=1),
            "Laplace.draws is 1; at least 2 are needed for an error estimate",
        ),
        (lambda: Laplace(rivals=1), "Laplace.rivals is 1; at least 2"),
        (lambda: Laplace(refinements=-1), "Laplace.refinements is -1; expected 0 or more"),
        (lambda: NestedMonteCarlo(inner=0), "NestedMonteCarlo.inner is 0; at least 2"),
        (lambda: PriorContrastive(draws=0), "PriorContrastive.draws is 0; at least 2"),
    ],
)
def test_impossible_estimators_are_refused(make, message):
    with pytest.raises(InputDataError, match=message):
        make()


def test_a_design_without_its_dimension_of_bubbles_is_refused():
    with pytest.raises(ShapeError, match=r"designs has shape \(2,\); expected q x 2"):
        gain(ONE, DESIGNS[0], plan(), Laplace())
