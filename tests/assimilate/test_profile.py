"""The profile likelihood against a posterior that is nearly Gaussian, and where the data leave one side open."""

from dataclasses import replace

import pytest
import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.assimilate import Assimilation, SearchOptions, assimilate, profile
from imr_torch.errors import InputDataError
from imr_torch.material import PARAMETERS, Belief
from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
from tests import linear
from tests.linear import tensor

SIMULATOR = PolytropicSimulator()


@pytest.fixture(scope="module")
def fits() -> Assimilation:
    laboratory = SimulatedLaboratory(
        SIMULATOR, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=1
    )
    batch = ExperimentBatch((laboratory.shoot(torch.tensor([400.0, 0.22]).double(), seed=1),))
    options = SearchOptions(raw_samples=16, starts=2)
    return assimilate(wide_prior(["nhkv", "gen_qkv"]), batch, SIMULATOR, seed=0, options=options)


def test_that_the_limits_are_those_of_the_posterior_where_the_prior_is_wide(
    fits: Assimilation,
) -> None:
    found = profile(fits["nhkv"], fits.batch, SIMULATOR)
    limits = torch.tensor([own.limits for own in found]).double().T
    wanted = fits["nhkv"].posterior.quantile([0.025, 0.975])
    width = wanted[1] - wanted[0]
    assert ((limits - wanted).abs() < 0.03 * width).all()
    assert all(all(own.converged) for own in found)
    assert [own.bounded for own in found] == ["on both sides"] * 2


def test_that_a_side_that_the_data_leave_open_has_no_limit(fits: Assimilation) -> None:
    (alpha,) = profile(fits["gen_qkv"], fits.batch, SIMULATOR, names=("alpha",))
    assert alpha.bounded == "from above"
    assert alpha.limits[0] is None
    assert min(alpha.fall) == 0.0
    assert list(alpha.values) == sorted(alpha.values)


def test_that_a_profile_under_a_correlated_prior_is_that_of_the_closed_form() -> None:
    """A linear model: over the other parameter the cost is least on a line, and the held one's own
    prior is taken out.
    """
    chol = tensor(1.0, 0.0, 0.95, (1.0 - 0.95**2) ** 0.5).reshape(2, 2) * 1.5
    part = replace(linear.prior(("nhkv",)).models[0], chol=chol)
    belief = Belief((part,), torch.zeros(1, dtype=torch.float64))
    batch = linear.experiments(1)
    fit = assimilate(
        belief,
        batch,
        linear.LinearSimulator(),
        seed=0,
        options=SearchOptions(raw_samples=8, starts=2),
    ).fits[0]
    (found,) = profile(fit, batch, linear.LinearSimulator(), names=("G",))
    truth = linear.exact(part, batch)
    mean = part.unwhitened(truth.mean)
    covariance = chol @ truth.covariance @ chol.mT
    controls = part.marginals[0].to_control(torch.tensor(found.values, dtype=torch.float64))
    cost = 0.5 * (controls - mean[0]).square() / covariance[0, 0]
    own = 0.5 * (controls - part.mean[0]).square() / (chol @ chol.mT)[0, 0]
    expected = cost - own
    torch.testing.assert_close(
        torch.tensor(found.fall), (expected - expected.min()).float(), atol=2e-3, rtol=1e-3
    )


def test_that_an_unknown_parameter_is_refused(fits: Assimilation) -> None:
    with pytest.raises(InputDataError, match="alpha"):
        profile(fits["nhkv"], fits.batch, SIMULATOR, names=("alpha",))
