"""The profile likelihood against a posterior that is nearly Gaussian, and where the data leave one side open."""

import pytest
import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.assimilate import Assimilation, SearchOptions, assimilate, profile
from imr_torch.errors import InputDataError
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, SimulatedLaboratory

SIMULATOR = PolytropicSimulator()


@pytest.fixture(scope="module")
def fits() -> Assimilation:
    laboratory = SimulatedLaboratory(SIMULATOR, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=1)
    batch = ExperimentBatch((laboratory.shoot(torch.tensor([400.0, 0.22]).double(), seed=1),))
    options = SearchOptions(raw_samples=16, starts=2)
    return assimilate(wide_prior(["nhkv", "gen_qkv"]), batch, SIMULATOR, seed=0, options=options)


def test_that_the_limits_are_those_of_the_posterior_where_the_prior_is_wide(fits: Assimilation) -> None:
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


def test_that_an_unknown_parameter_is_refused(fits: Assimilation) -> None:
    with pytest.raises(InputDataError, match="alpha"):
        profile(fits["nhkv"], fits.batch, SIMULATOR, names=("alpha",))
