"""The long-run reference against closed forms, quadrature, and importance sampling on real collapses."""

import pytest
import torch

from imr_torch.assimilate import Assimilation, SearchOptions, assimilate, weigh
from imr_torch.assimilate.nuts import NutsDraws, nuts
from imr_torch.errors import ConvergenceError, InputDataError, UnsupportedError
from imr_torch.material import PARAMETERS, Belief, reference_case
from imr_torch.observe import ExperimentBatch, Nuisance, SimulatedLaboratory
from imr_torch.simulate import PolytropicSimulator
from tests.curved import CurvedSimulator, quadrature
from tests.linear import LinearSimulator, exact, experiments, prior, tensor

OPTIONS = SearchOptions(raw_samples=24)
BOTH = Nuisance(time_zero=0.2, rest_radius=0.3)


def fitted(batch: ExperimentBatch, simulator) -> Assimilation:
    return assimilate(prior(("nhkv",)), batch, simulator, seed=1, options=OPTIONS)


def test_that_draws_of_a_linear_model_have_the_exact_moments() -> None:
    """Means to 4 errors; energies mix over a few draws, so a variance counts a third of the draws."""
    pytest.importorskip("pyro", reason="needs the extra nuts")
    batch = experiments(2, nuisance=BOTH)
    fit = fitted(batch, LinearSimulator()).fits[0]
    before = torch.get_rng_state()
    draws = nuts(fit, batch, LinearSimulator(), seed=3)
    assert torch.equal(torch.get_rng_state(), before)
    truth = exact(fit.prior, batch)
    sds = truth.covariance.diagonal().sqrt()
    assert draws.controls.shape == (32, 50, 2)
    assert draws.converged
    assert draws.divergences == 0
    assert float(((draws.mean - truth.mean) / sds).abs().max()) < 4.0 / 1600**0.5
    assert (
        float((draws.covariance / truth.covariance - 1.0).abs().max())
        < 4.0 * (2.0 * 3.0 / 1600) ** 0.5
    )
    nuisances = draws.nuisances.flatten(0, 1)
    torch.testing.assert_close(nuisances.mean(0), truth.nuisances, rtol=0.0, atol=0.1)
    assert float(nuisances[..., 0].abs().max()) == 0.0  # Rmax is known


def test_that_draws_of_a_curved_posterior_agree_with_quadrature_where_the_gaussian_does_not() -> (
    None
):
    pytest.importorskip("pyro", reason="needs the extra nuts")
    simulator = CurvedSimulator(1.5)
    batch = experiments(1)
    fit = fitted(batch, simulator).fits[0]
    draws = nuts(fit, batch, simulator, seed=0, draws=150)
    truth = quadrature(fit, batch, simulator)
    assert draws.converged
    sds = truth.covariance.diagonal().sqrt()
    assert float(((draws.mean - truth.mean) / sds).abs().max()) < 0.1
    assert float(((fit.mean - truth.mean) / sds).abs().max()) > 0.2
    torch.testing.assert_close(draws.covariance, truth.covariance, rtol=0.25, atol=0.0)


def test_that_draws_through_the_polytropic_simulator_agree_with_importance_sampling() -> None:
    pytest.importorskip("pyro", reason="needs the extra nuts")
    case = reference_case("soft-pa")
    simulator = PolytropicSimulator()
    times = torch.linspace(0.0, 0.8, 9, dtype=torch.float64)
    laboratory = SimulatedLaboratory(
        simulator, PARAMETERS.pack(dict(case.truth)), repeats=1, times=times
    )
    batch = ExperimentBatch((laboratory.shoot(tensor(300.0, 0.25), seed=0),))
    belief = Belief((case.prior["nhkv"],), tensor(0.0))
    weighted = weigh(assimilate(belief, batch, simulator, seed=0), simulator, seed=0, samples=1024)
    sample = weighted.fits[0].sample
    draws = nuts(weighted.fits[0], batch, simulator, seed=0, draws=5, warmup=4, chains=40)
    sds = sample.covariance.diagonal().sqrt()
    assert float(((draws.mean - sample.mean) / sds).abs().max()) < 0.25
    torch.testing.assert_close(draws.covariance.diagonal().sqrt(), sds, rtol=0.3, atol=0.0)


def test_that_chains_that_disagree_or_count_for_little_have_not_converged() -> None:
    source = torch.Generator().manual_seed(0)
    controls = torch.randn(4, 200, 2, generator=source, dtype=torch.float64)
    still = torch.zeros(4, 200, 1, 3, dtype=torch.float64)
    cost = torch.zeros(4, 200, dtype=torch.float64)
    good = NutsDraws(controls, still, cost, 0)
    assert good.converged
    assert bool((good.effective_samples > 500.0).all())
    apart = NutsDraws(controls + 2.0 * torch.arange(4.0)[:, None, None], still, cost, 0)
    assert not apart.converged
    assert float(apart.r_hat.min()) > 1.5
    few = NutsDraws(controls[:, :10], still[:, :10], cost[:, :10], 0)
    assert not few.converged


def test_that_a_simulator_without_gradients_is_named() -> None:
    pytest.importorskip("pyro", reason="needs the extra nuts")

    class Detached(LinearSimulator):
        def __call__(self, *arguments):
            with torch.no_grad():
                return super().__call__(*arguments)

    batch = experiments(1)
    with pytest.raises(UnsupportedError, match="Detached gives no gradients"):
        nuts(fitted(batch, LinearSimulator()).fits[0], batch, Detached(), seed=0)


def test_that_a_fit_that_cannot_be_simulated_is_an_error() -> None:
    pytest.importorskip("pyro", reason="needs the extra nuts")
    batch = experiments(1)
    with pytest.raises(
        ConvergenceError, match="0 of 64 draws of the fit could be simulated; 32 are needed"
    ):
        nuts(fitted(batch, LinearSimulator()).fits[0], batch, LinearSimulator(fails=True), seed=0)


@pytest.mark.parametrize("wrong", [{"draws": 3}, {"chains": 1}, {"warmup": 0}])
def test_that_runs_too_short_to_judge_are_refused(wrong: dict[str, int]) -> None:
    batch = experiments(1)
    with pytest.raises(InputDataError, match="must be at least 4, chains"):
        nuts(fitted(batch, LinearSimulator()).fits[0], batch, LinearSimulator(), seed=0, **wrong)
