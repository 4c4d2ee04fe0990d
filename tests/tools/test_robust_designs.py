"""The gain under model error against the closed form of a linear camera."""

import pytest
import torch

from benchmarks.model_error import RobustLaplace
from imr_torch.design import Laplace, expected_information_gain
from imr_torch.material import Belief, library
from tests.design.linear_camera import (
    DESIGNS,
    LinearCamera,
    correlated,
    covariance,
    linear_gaussian_gain,
    normal,
    plan,
    sensitivity,
)

BASE = Belief.prior({"nhkv": {"G": normal(0.3), "mu": normal(0.2)}})
SEEN = "strain_stiffening"  # of the parameter alpha, which the camera sees


def find_gain(estimator, designs=DESIGNS, belief=BASE):
    return expected_information_gain(
        belief, designs, LinearCamera(), plan(), estimator=estimator, seed=3
    )


def exact_gain(designs, *, lacking):
    """The gain beside an effect that changes all shots alike, averaged over its amplitude."""
    noise = covariance(designs, plan())
    seen = sensitivity(BASE.models[0], designs)
    if not lacking:
        return float(linear_gaussian_gain(seen, noise))
    column = LinearCamera().columns(designs[:, 0])[..., 2].flatten()
    prior = library([SEEN])[0].priors["alpha"]
    levels = (torch.arange(400).double() + 0.5) / 400
    amplitudes = prior.to_physical(torch.special.ndtri(levels))
    gains = [
        linear_gaussian_gain(seen, noise + a**2 * column[:, None] * column) for a in amplitudes
    ]
    return float(torch.stack(gains).mean())


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize(("known", "unknown"), [(1.0, 0.0), (0.0, 1.0)])
def test_that_a_lacking_effect_costs_what_the_closed_form_says(count, known, unknown):
    designs = DESIGNS[:count]
    estimator = RobustLaplace(1000, effects=(SEEN,), known=known, unknown=unknown)
    found = find_gain(estimator, designs)
    expected = exact_gain(designs, lacking=True)
    assert expected < exact_gain(designs, lacking=False) - 0.05
    assert found.parameters == pytest.approx(expected, abs=4.0 * found.variance**0.5)
    assert found.variance**0.5 < 0.02


@pytest.mark.parametrize("belief", [BASE, correlated()])
def test_that_without_effects_the_gain_is_the_ordinary_one(belief):
    assert find_gain(RobustLaplace(8, effects=()), belief=belief) == find_gain(
        Laplace(8), belief=belief
    )
