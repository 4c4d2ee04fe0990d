"""The posterior of one model: its density, its slopes and its normal equations, against closed
forms and other differences.
"""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from imr_torch.assimilate import Point, Posterior
from imr_torch.float64 import randn
from imr_torch.observe import ExperimentBatch, Nuisance
from imr_torch.random import generator
from imr_torch.simulate import PolytropicSimulator, TransportSimulator
from tests.curved import CurvedSimulator, quadrature
from tests.linear import (
    BOTH,
    CORRELATED,
    MEANS,
    NHKV,
    NOISE,
    SDS,
    LinearSimulator,
    exact,
    experiments,
    fit_linear,
    tensor,
)

ALL = Nuisance(max_radius=0.01, time_zero=0.02, rest_radius=0.05)


def linear(batch: ExperimentBatch, **how) -> Posterior:
    return Posterior(NHKV.models[0], batch, LinearSimulator(**how))


def points(posterior: Posterior, count: int) -> Point:
    source = generator(0)
    gel = 0.3 * randn(count, posterior.size, generator=source)
    nuisances = randn(*posterior.mean_nuisances(count).shape, generator=source)
    return Point(gel, nuisances * (posterior.batch.nuisance_sds > 0.0))


def test_that_a_newton_step_from_anywhere_ends_at_the_exact_posterior_of_a_linear_simulator():
    posterior = linear(experiments(3, nuisance=BOTH, noise=CORRELATED))
    truth = exact(posterior.prior, posterior.batch)
    point = points(posterior, 4)
    equations = posterior.neighbourhood(point).equations
    gel, nuisances = equations.step
    assert_close(point.gel + gel, truth.mean.expand(4, -1), rtol=0.0, atol=1e-6)
    assert_close(
        point.nuisances + nuisances, truth.nuisances.expand(4, -1, -1), rtol=0.0, atol=1e-6
    )
    covariance = equations.posterior_chol @ equations.posterior_chol.mT
    assert_close(covariance, truth.covariance.expand(4, -1, -1), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    "simulator",
    [PolytropicSimulator(), TransportSimulator()],
    ids=["polytropic", "transport"],
)
def test_that_the_gradient_is_that_of_the_log_joint(simulator):
    """Against wide central differences, each with the solver steps of the point, along random directions."""
    batch = experiments(2, nuisance=ALL)
    batch = ExperimentBatch(
        tuple(replace(e, radius=e.radius.clamp(0.1, 0.9)) for e in batch.experiments), NOISE
    )
    posterior = replace(linear(batch), simulator=simulator)
    point = points(posterior, 1)[0]
    equations = posterior.neighbourhood(point).equations
    source = generator(1)
    for _ in range(3):
        way = Point(
            *(randn(x.shape, generator=source) for x in (point.gel, point.nuisances))
        )
        expected = (equations.gel_gradient * way.gel).sum() + (
            equations.nuisance_gradient * way.nuisances
        ).sum()
        lengths = 1e-4 * tensor(0.0, 1.0, -1.0)
        line = Point(
            point.gel + lengths[:, None] * way.gel,
            point.nuisances + lengths[:, None, None] * way.nuisances,
        )
        cost = -posterior.log_joint(line, posterior.predict(line, bundled=True))
        assert (cost[1] - cost[2]) / 2e-4 == pytest.approx(
            float(expected), rel=1e-3, abs=1e-3
        )


def test_that_a_neighbour_that_fails_tells_nothing_and_the_others_do():
    """A simulator that fails just above the point in G: the slope in mu stays."""
    batch = experiments(3, nuisance=BOTH)
    point = Point(tensor(0.0, 0.0), linear(batch).mean_nuisances())
    whole = linear(batch).neighbourhood(point).slopes
    limited = linear(batch, limit={"G": MEANS["G"] + 1e-9 * SDS["G"]}).neighbourhood(point)
    assert limited.prediction[1][batch.mask].isnan().all()
    assert limited.slopes[0][..., 0].abs().max() == 0.0
    assert_close(limited.slopes[0][..., 1], whole[0][..., 1], rtol=1e-6, atol=1e-9)
    assert_close(limited.slopes[1], whole[1], rtol=1e-6, atol=1e-9)
    assert torch.isfinite(limited.equations.gel_hessian).all()


def test_that_where_the_bubble_itself_fails_the_log_joint_is_minus_infinity():
    posterior = linear(experiments(2), fails=True)
    assert (
        posterior.log_joint(Point(tensor(0.0, 0.0), posterior.mean_nuisances()))
        == -torch.inf
    )


def test_that_the_log_joint_can_be_sampled_by_hamiltonian_monte_carlo():
    """As docs/howto/other_tools.md does it: a banana, of which the Gaussian about the fit is a fifth
    of a standard deviation off.
    """
    infer = pytest.importorskip("pyro.infer", reason="needs the extra nuts")
    simulator = CurvedSimulator(1.5)
    batch = experiments(1)
    fit = fit_linear(batch, simulator).fits[0]
    posterior = Posterior(fit.prior, batch, simulator)
    middle = posterior.coordinates_of(fit.point)
    chol = fit.joint_chol(posterior.uncertain)

    def cost(point: dict[str, Tensor]) -> Tensor:
        return -posterior.log_joint(posterior.point_at(middle + point["u"] @ chol.mT)).sum()

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        start = 0.5 * randn(32, len(middle))
        kernel = infer.NUTS(potential_fn=cost, adapt_mass_matrix=False, max_tree_depth=4)
        run = infer.MCMC(
            kernel, 40, warmup_steps=20, initial_params={"u": start}, disable_progbar=True
        )
        run.run()
    gels = posterior.point_at(middle + run.get_samples()["u"] @ chol.mT).gel.flatten(0, 1)
    truth = quadrature(fit, batch, simulator)
    sds = truth.covariance.diagonal().sqrt()
    assert ((gels.mean(0) - truth.mean) / sds).abs().max() < 0.15
    assert ((fit.mean - truth.mean) / sds).abs().max() > 0.2


def test_that_a_neighbourhood_of_some_experiments_is_that_of_all_without_the_others():
    posterior = linear(experiments(3, nuisance=BOTH))
    point = points(posterior, 1)[0]
    rows = torch.tensor([0, 2])
    part = posterior.neighbourhood(point).of_experiments(rows)
    alone = posterior.of_experiments(rows)
    assert_close(part.slopes, alone.neighbourhood(part.point).slopes)
    assert_close(part.log_joint, alone.log_joint(Point(point.gel, point.nuisances[rows])))
