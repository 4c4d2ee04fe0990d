"""The gain about the model where experiments tell little and rival models are far from their draws, against brute force."""

import functools

import pytest

from benchmarks.nested import NestedMonteCarlo, PriorContrastive
from imr_torch.design import (
    Laplace,
    Plan,
    expected_information_gain,
)
from imr_torch.float64 import tensor
from imr_torch.material import reference_case
from imr_torch.simulate import PolytropicSimulator

PRIOR = reference_case("stiff-pa").prior
DESIGNS = ((150.0, 0.15), (900.0, 0.28))
TOLERANCE = 0.05


def gain(design, estimator, seed):
    X = tensor([design])
    return expected_information_gain(
        PRIOR, X, PolytropicSimulator(), Plan(repeats=1), estimator=estimator, seed=seed
    )


@functools.cache
def brute(design):
    """Nested Monte Carlo of the part about the model: lower and upper bound in practice, and a
    standard error.
    """
    low, high = (
        gain(design, kind(draws=200, inner=2500), 1)
        for kind in (NestedMonteCarlo, PriorContrastive)
    )
    return low.model, high.model, high.of_target("model").variance ** 0.5


@pytest.mark.parametrize("design", DESIGNS)
@pytest.mark.parametrize(
    ("estimator", "seeds"),
    [
        (Laplace(draws=32, rivals=32), 5),
        (Laplace(draws=32), 12),
    ],
    ids=["Laplace, all data", "Laplace, a quarter of the data"],
)
def test_that_the_gain_about_the_model_is_that_of_brute_nested_monte_carlo(
    design, estimator, seeds
):
    low, high, error = brute(design)
    found = [gain(design, estimator, seed) for seed in range(2, 2 + seeds)]
    value = sum(g.model for g in found) / seeds
    spread = (
        error**2 + sum(g.of_target("model").variance for g in found) / seeds**2
    ) ** 0.5
    assert low - TOLERANCE - 2.0 * spread < value < high + TOLERANCE + 2.0 * spread


def test_that_evidence_linearised_at_a_draw_of_the_rival_is_too_low_and_refinement_mends_it():
    at_draw, refined = (
        sum(
            gain(DESIGNS[0], Laplace(draws=16, rivals=16, refinements=n), seed).model
            for seed in range(8)
        )
        / 8
        for n in (0, 3)
    )
    assert at_draw > refined + TOLERANCE
