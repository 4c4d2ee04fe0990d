"""Priors from torch against torch's own densities, bounds that the physics sets, and a belief that can be saved."""

import math

import pytest
import torch
from torch import distributions as dist

from imr_torch.errors import InputDataError, UnsupportedError
from imr_torch.export import from_distributions, to_marginal
from imr_torch.material import Belief, LogNormal, Quantile, TruncatedNormal
from tests import float64


def t(*values: float) -> list[torch.Tensor]:
    return [float64.tensor(v) for v in values]


CASES = [
    dist.Normal(*t(2.0, 0.5)),
    dist.HalfNormal(*t(0.5)),
    dist.LogNormal(*t(8.0, 0.7)),
    dist.Uniform(*t(500.0, 2e4)),
    dist.Exponential(*t(2.0)),
    dist.Gamma(*t(2.0, 1e-3)),
    dist.InverseGamma(*t(3.0, 2.0)),
    dist.Weibull(*t(2.0, 1.5)),
    dist.Pareto(*t(1.0, 3.0)),
    dist.Beta(*t(2.0, 5.0)),
    dist.Chi2(*t(3.0)),
    dist.FisherSnedecor(*t(4.0, 9.0)),
    dist.StudentT(*t(5.0, 1.0, 0.2)),
    dist.Laplace(*t(1.0, 0.3)),
    dist.Gumbel(*t(1.0, 0.3)),
    dist.Cauchy(*t(1.0, 0.3)),
    dist.HalfCauchy(*t(0.3)),
]


@pytest.mark.parametrize("distribution", CASES, ids=lambda d: type(d).__name__)
def test_that_a_marginal_has_the_density_of_its_distribution(
    distribution,
):
    """``log p(theta) = log phi(z) - log |d theta/d z|``, out to five standard deviations."""
    marginal = to_marginal(distribution)
    z = float64.linspace(-5.0, 5.0, 41)
    value = marginal.to_physical(z)
    density = -0.5 * z.square() - 0.5 * math.log(2.0 * math.pi) - marginal.log_slope(z)
    torch.testing.assert_close(density, distribution.log_prob(value), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("distribution", CASES, ids=lambda d: type(d).__name__)
def test_that_the_median_is_at_rest(distribution):
    middle = to_marginal(distribution).to_physical(float64.zeros(1))
    draws = distribution.expand((20_000,)).sample()
    assert float((draws < middle).double().mean()) == pytest.approx(0.5, abs=0.015)


def test_that_maps_of_the_library_are_used_where_they_exist():
    assert to_marginal(dist.Normal(*t(1.0, 2.0))) == TruncatedNormal(1.0, 2.0)
    assert to_marginal(dist.LogNormal(*t(0.0, 1.0))) == LogNormal(1.0, math.e)
    assert to_marginal(
        dist.Independent(dist.Normal(*[x[None] for x in t(1.0, 2.0)]), 1)
    ) == TruncatedNormal(1.0, 2.0)


def test_that_a_belief_is_made_saved_and_read_back(tmp_path):
    belief = from_distributions(
        {
            "nhkv": {"G": dist.Gamma(*t(2.0, 1e-3)), "mu": dist.Uniform(*t(0.01, 0.5))},
            "newtonian": {"mu": LogNormal(0.1, 3.0)},
        },
        probabilities={"nhkv": 3.0, "newtonian": 1.0},
    )
    assert belief.probabilities == {"nhkv": pytest.approx(0.75), "newtonian": pytest.approx(0.25)}
    assert belief["nhkv"].marginals[0] == Quantile("gamma", {"a": 2.0, "scale": 1000.0})
    torch.testing.assert_close(
        belief["nhkv"].means,
        float64.tensor([2000.0, 0.255]),
        rtol=1e-3,
        atol=0.0,
    )
    belief.save(tmp_path / "prior.json")
    assert Belief.load(tmp_path / "prior.json").to_dict() == belief.to_dict()


@pytest.mark.parametrize(
    ("prior", "error", "message"),
    [
        (
            dist.Normal(*t(5000.0, 2000.0)),
            InputDataError,
            r"'G' gives a probability of 0.0062 to values outside \[0, 1e\+07\] Pa",
        ),
        (
            dist.Cauchy(*t(1e6, 1e6)),
            InputDataError,
            r"which are impossible; use one with that support",
        ),
        (
            dist.Normal(torch.zeros(2), torch.ones(2)),
            InputDataError,
            r"over one number; got a Normal of shape \(2,\)",
        ),
        (
            dist.VonMises(*t(0.0, 1.0)),
            UnsupportedError,
            r"No map from a standard normal to VonMises is known; known are Normal",
        ),
    ],
)
def test_that_a_prior_that_cannot_be_used_is_named(prior, error, message):
    with pytest.raises(error, match=message):
        from_distributions({"nhkv": {"G": prior, "mu": LogNormal(0.1, 2.0)}})


def test_that_a_tail_of_a_millionth_outside_the_bounds_is_let_pass():
    belief = from_distributions(
        {"nhkv": {"G": dist.Normal(*t(5000.0, 900.0)), "mu": LogNormal(0.1, 2.0)}}
    )
    assert belief["nhkv"].marginals[0] == TruncatedNormal(5000.0, 900.0)
