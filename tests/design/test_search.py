"""The search for one or several designs: greedy over pending ones, common draws, and the errors it
states.
"""

import pytest
import torch

from imr_torch.design import (
    DesignSpace,
    ExpectedInformationGain,
    Laplace,
    search_design,
    separate_errors,
)
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import rand, tensor
from imr_torch.observe import Noise
from imr_torch.random import generator
from imr_torch.results import document_report, header
from imr_torch.units import Surroundings
from tests.design.linear_camera import (
    DESIGNS,
    ONE,
    TWO,
    LinearCamera,
    acquisition,
    exact,
    plan,
)
from tests.design.test_optimizer import PartlyFailing
from tests.refusals import refused

QUICK = {"evaluations": 5, "initial": 4}
NOISY = plan(noise=Noise(slope=0.0, drift=0.0, floor=0.2))


def test_that_a_search_leaves_the_acquisition_as_it_was():
    gain = acquisition(TWO, seed=7, X_pending=DESIGNS[:1])
    before = gain(DESIGNS[:, None])
    search_design(gain, seed=1, q=2, **QUICK)
    assert gain.seed == 7
    assert torch.equal(gain.X_pending, DESIGNS[:1])
    assert torch.equal(gain(DESIGNS[:, None]), before)


def test_that_several_designs_are_found_one_beside_the_other():
    search = search_design(acquisition(), seed=0, q=3, evaluations=10, initial=6)
    assert search.chosen.shape == (3, 2)
    assert len(search.increments) == 3
    joint = exact(ONE, search.chosen, plan())
    assert search.joint == pytest.approx(joint, abs=0.2)
    assert search.increments[0] > search.increments[1] > search.increments[2] > 0.0
    space = DesignSpace().bounds
    source = generator(0)
    others = space[0] + (space[1] - space[0]) * rand(40, 3, 2, generator=source)
    assert joint > max(exact(ONE, three, plan()) for three in others) - 0.1


def test_that_the_best_design_of_a_small_space_is_said_to_lie_at_its_end():
    space = DesignSpace((300.0, 330.0), (0.2, 0.21))
    found = search_design(acquisition(space=space), seed=0, evaluations=10, initial=6)
    document = found.to_dict(Surroundings(), points=2) | {"eig": 1.0, "eig_sd": 0.1}
    weber = float(found.recommendation.design[0])
    low, high = (exact(ONE, tensor([[w, 0.2]]), plan()) for w in space.weber)
    assert weber == pytest.approx(330.0 if high > low else 300.0, abs=0.3)
    assert (
        f"We is the {'largest' if high > low else 'smallest'} of 300 to 330"
        in document_report(header("design") | document)
    )
    assert not space.name_edges(tensor([315.0, 0.205]))


def test_that_pending_designs_are_subtracted_from_what_a_search_reports():
    search = search_design(
        acquisition(X_pending=DESIGNS), seed=0, evaluations=10, initial=6
    )
    both = torch.cat((search.chosen, DESIGNS))
    added = exact(ONE, both, plan()) - exact(ONE, DESIGNS, plan())
    assert search.recommendation.mean == pytest.approx(added, abs=0.15)


def test_that_pending_designs_that_cannot_be_simulated_end_the_search_with_a_reason():
    gain = ExpectedInformationGain(
        ONE, PartlyFailing(), Laplace(draws=4), plan=plan(), X_pending=DESIGNS[1:]
    )
    with refused(
        "0 of 4 draws could be simulated at the pending designs", ConvergenceError
    ):
        search_design(gain, seed=0, **QUICK)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"q": 0}, "q is 0; expected at least 1"),
        ({"batch": 0}, "batch is 0; expected at least 1"),
        (
            {"evaluations": 3, "initial": 4},
            "evaluations is 3, fewer than the 4 initial designs",
        ),
    ],
)
def test_that_an_impossible_search_is_refused(options, message):
    with refused(message):
        search_design(acquisition(), seed=0, **options)


def estimates(estimator, designs, seeds):
    gain = ExpectedInformationGain(TWO, LinearCamera(), estimator, plan=NOISY)
    return [[gain.estimate(X, seed=s) for X in designs.split(1)] for s in range(seeds)]


def test_that_the_variance_of_a_difference_from_common_draws_is_the_scatter_over_seeds():
    near = tensor([[300.0, 0.2], [330.0, 0.2]])
    found = estimates(Laplace(draws=16, rivals=8), near, 40)
    differences = tensor([a.value - b.value for a, b in found])
    stated = torch.stack([separate_errors(pair).own.sum() for pair in found])
    assert 0.75 < differences.std() / stated.mean().sqrt() < 1.35
    independent = tensor([a.variance + b.variance for a, b in found])
    assert stated.mean() < 0.3 * independent.mean()


def test_that_the_error_of_the_mean_over_designs_is_the_common_part():
    designs = tensor([[300.0, 0.2], [330.0, 0.2], [360.0, 0.2]])
    found = estimates(Laplace(draws=16, rivals=16), designs, 36)
    means = tensor([[g.value for g in row] for row in found]).mean(1)
    stated = tensor([separate_errors(row).common for row in found])
    assert 0.75 < means.std() / stated.mean().sqrt() < 1.35


def test_that_a_recommendation_has_the_common_error_and_its_surrogate_has_not():
    gain = ExpectedInformationGain(
        TWO, LinearCamera(), Laplace(draws=16, rivals=8), plan=NOISY
    )
    search = search_design(gain, seed=0, evaluations=6, initial=5)
    errors = separate_errors(search.gains)
    assert torch.allclose(search.optimizer.train_Yvar[:, 0], errors.own.clamp_min(1e-8))
    assert search.recommendation.sd >= errors.common**0.5
    assert errors.own.mean() < 0.5 * errors.common
