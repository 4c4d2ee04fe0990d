"""The information gain as BoTorch's users know acquisitions: batches, joint gains, pending designs,
optimisers, targets.
"""

import math
from dataclasses import dataclass

import pytest
import torch
from botorch.optim import optimize_acqf
from botorch.utils.sampling import manual_seed

from imr_torch.design import (
    ExpectedInformationGain,
    InformationEstimator,
    InformationGain,
    Laplace,
    search_design,
)
from imr_torch.errors import UnsupportedError
from imr_torch.float64 import tensor
from tests.design.linear_camera import (
    DESIGNS,
    ONE,
    TWO,
    LinearCamera,
    acquisition,
    exact,
    plan,
)
from tests.refusals import refused

THIRD = tensor([[150.0, 0.16]])
NO_GRAD = {"with_grad": False, "maxiter": 5}
ENTROPY = -(0.7 * math.log(0.7) + 0.3 * math.log(0.3))
EVERY = [Laplace(draws=6, rivals=6), Laplace(draws=6, rivals=6, refinements=0)]


@pytest.mark.parametrize("shape", [(1,), (3,), (2, 3), (0,)])
@pytest.mark.parametrize("q", [1, 2])
def test_that_every_batch_shape_is_kept(shape, q):
    gain = acquisition()
    X = DESIGNS[:q].expand(*shape, q, 2)
    assert gain(X).shape == shape
    assert torch.allclose(gain(X), tensor(gain.estimate(DESIGNS[:q]).value))


def test_that_pending_designs_count_in_the_joint_gain_and_none_restores_the_gain_alone():
    gain = acquisition()
    alone = gain(THIRD[None])
    gain.set_X_pending(DESIGNS)
    assert gain(THIRD[None]) == pytest.approx(
        exact(ONE, torch.cat((THIRD, DESIGNS)), plan()), rel=1e-7
    )
    assert gain(THIRD[None]) > alone + 0.5
    assert gain.estimate(DESIGNS[:0]).value == pytest.approx(
        exact(ONE, DESIGNS, plan()), rel=1e-7
    )
    gain.set_X_pending(None)
    assert torch.equal(gain(THIRD[None]), alone)


def test_that_asking_for_gradients_says_what_to_use_instead():
    gain = acquisition()
    with refused(r'options=\{"with_grad": False\}, or use search_design', UnsupportedError):
        optimize_acqf(gain, gain.space.bounds, q=1, num_restarts=1, raw_samples=2)
    with torch.no_grad():
        assert torch.isfinite(gain(DESIGNS[None].clone().requires_grad_(True))).all()


def test_that_optimize_acqf_finds_at_least_the_better_of_two_designs():
    gain = acquisition()
    with manual_seed(0):
        best, value = optimize_acqf(
            gain, gain.space.bounds, q=1, num_restarts=1, raw_samples=16, options=NO_GRAD
        )
    assert best.shape == (1, 2)
    assert value >= gain(DESIGNS[:, None]).max() - 0.05


def test_that_sequential_greedy_takes_each_design_with_those_before_it_pending():
    gain = acquisition(X_pending=THIRD)
    with manual_seed(0):
        best, values = optimize_acqf(
            gain,
            gain.space.bounds,
            q=2,
            num_restarts=1,
            raw_samples=8,
            options=NO_GRAD,
            sequential=True,
        )
    assert best.shape == (2, 2)
    assert torch.equal(gain.X_pending, THIRD)
    joint = exact(ONE, torch.cat((best, THIRD)), plan())
    assert values[-1] == pytest.approx(joint, rel=1e-7)
    assert joint > exact(ONE, torch.cat((best[:1], THIRD)), plan())


@pytest.mark.parametrize("estimator", EVERY, ids=lambda e: f"{e.refinements} refinements")
def test_that_the_gain_about_the_model_is_never_above_the_entropy_of_the_models(estimator):
    """By value, by batch, by pending designs and in every evaluation of a search with common draws."""
    gain = acquisition(TWO, estimator, target="model")
    values = [
        gain(DESIGNS[:, None]),
        gain(DESIGNS[None]),
        acquisition(TWO, estimator, target="model", X_pending=THIRD)(DESIGNS[:, None]),
    ]
    search = search_design(gain, seed=1, evaluations=4, initial=3)
    values.append(torch.tensor([g.value for g in search.gains]))
    assert torch.cat([v.flatten().double() for v in values]).max() <= ENTROPY + 1e-9
    assert all(
        g.parameters == 0.0 and g.variance == g.of_target("model").variance
        for g in search.gains
    )


@pytest.mark.parametrize("estimator", EVERY, ids=lambda e: f"{e.refinements} refinements")
def test_that_the_targets_are_the_parts_of_the_whole(estimator):
    parts = {
        target: acquisition(TWO, estimator, target=target).estimate(DESIGNS[:1])
        for target in ("parameters", "model", "both")
    }
    assert parts["parameters"].value + parts["model"].value == pytest.approx(
        parts["both"].value, rel=1e-12
    )
    assert parts["parameters"].variance == pytest.approx(
        parts["both"].of_target("parameters").variance
    )
    for gain in parts.values():
        influence = gain.influence.sum(1)
        assert influence.square().sum() == pytest.approx(gain.variance, rel=1e-9)


def test_that_an_unknown_target_is_refused():
    with refused("target is 'models'; expected one of parameters, model, both"):
        acquisition(target="models")


@dataclass(frozen=True)
class LogWeber(InformationEstimator):
    """An estimator from outside the package: a gain that is known."""

    scale: float = 1.0

    def __call__(self, shot, generator):
        value = (
            self.scale * float(-((shot.designs[:, 0].log() - math.log(500.0)) ** 2).sum())
            + 3.0
        )
        return InformationGain(value, 0.0, variance=1e-6, counted=2, drawn=2)


def test_that_an_estimator_from_outside_the_package_works_wherever_others_do():
    gain = ExpectedInformationGain(ONE, LinearCamera(), LogWeber(2.0))
    assert gain(tensor([[[500.0, 0.2]]])) == pytest.approx(3.0)
    best = search_design(gain, seed=0, evaluations=12, initial=6).recommendation
    assert best.design[0] == pytest.approx(500.0, rel=0.15)
    assert best.mean == pytest.approx(3.0, abs=0.05)
