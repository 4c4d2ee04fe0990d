"""Curvature that Gauss-Newton leaves out:

what a step tells of it, steps that use it, and what they save where a model misses.
"""

from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import (
    Assimilation,
    Neighbourhood,
    Posterior,
    SearchOptions,
    assimilate,
    chains,
)
from imr_torch.assimilate.curvature import damped_step, updated
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, Nuisance, SimulatedLaboratory
from imr_torch.random import generator
from imr_torch.simulate import PolytropicSimulator, Simulator
from tests.linear import LinearSimulator, experiments, prior

LINEAR = Nuisance(time_zero=0.2, rest_radius=0.3)
ALL = Nuisance(max_radius=0.01, time_zero=0.02, rest_radius=0.05)

Ends = list[tuple[Neighbourhood, NormalEquations]]


def _filmed() -> ExperimentBatch:
    """Two designs, filmed in a gel that loses gas and relaxes, neither of which the models here have."""
    gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093, "gas_loss": 0.5, "tau": 1e-5})
    laboratory = SimulatedLaboratory(PolytropicSimulator(), gel, repeats=20)
    shots = [
        laboratory.shoot(torch.tensor(d, dtype=torch.float64), seed=1)
        for d in ((400.0, 0.22), (900.0, 0.14))
    ]
    return ExperimentBatch(tuple(replace(shot, nuisance=ALL) for shot in shots))


def _ends(simulator: Simulator, batch: ExperimentBatch) -> Ends:
    """Neighbourhoods and equations at both ends of a step of each of two chains, by the solver steps of where it began."""
    posterior = Posterior(prior(("nhkv",)).models[0], batch, simulator)
    draws = generator(0)
    sds = (batch.nuisance_sds > 0.0).double()
    gel, step = (
        0.1 * torch.randn(2, 2, posterior.size, generator=draws, dtype=torch.float64)
    ).unbind()
    shifts, moved = (
        0.1 * torch.randn(2, *posterior.still(2).shape, generator=draws, dtype=torch.float64) * sds
    ).unbind()
    begin = Point(gel, shifts)
    end = Point(gel + step, shifts + moved)
    near = [posterior.neighbourhood(point, leader=begin) for point in (begin, end)]
    return [(n, n.equations) for n in near]


def _joint(gel: torch.Tensor, nuisances: torch.Tensor) -> torch.Tensor:
    return torch.cat((gel, nuisances.flatten(1)), 1)


def test_that_along_the_step_it_is_what_old_sensitivities_miss_of_the_gradient() -> None:
    ends = _ends(PolytropicSimulator(), _filmed())
    (old, _), (new, after) = ends
    size = old.point.gel.shape[1] + old.point.nuisances[0].numel()
    found = updated(torch.zeros(2, size, size, dtype=torch.float64), *ends)
    by_old = new.posterior.equations(new.point, new.centre, *old.slopes)
    missed = _joint(
        after.gel_gradient - by_old.gel_gradient, after.nuisance_gradient - by_old.nuisance_gradient
    )
    step = _joint(new.point.gel - old.point.gel, new.point.nuisances - old.point.nuisances)
    assert float(missed.abs().max()) > 1.0
    torch.testing.assert_close((found @ step[..., None])[..., 0], missed)
    torch.testing.assert_close(found, found.mT)


def test_that_a_linear_model_has_none() -> None:
    ends = _ends(LinearSimulator(), experiments(3, nuisance=LINEAR))
    size = ends[0][0].point.gel.shape[1] + ends[0][0].point.nuisances[0].numel()
    found = updated(torch.zeros(2, size, size, dtype=torch.float64), *ends)
    hessian = ends[0][1].gel_hessian.diagonal(dim1=-2, dim2=-1).amax()
    assert float(found.abs().max()) < 1e-5 * float(hessian)


def test_that_steps_solve_the_sum_of_both_and_fall_back_where_it_is_uphill() -> None:
    _, (_, equations) = _ends(PolytropicSimulator(), _filmed())
    still = torch.zeros(2, dtype=torch.float64)
    size = 2 + equations.nuisance_gradient[0].numel()
    eye = torch.eye(size, dtype=torch.float64).expand(2, -1, -1)
    plain = equations.step(still)
    for curvature in (
        0.0 * eye,
        1e-12 * eye,
        -1e12 * eye,
    ):  # none, next to none, and one that bends downwards
        for step, expected in zip(damped_step(equations, curvature, still), plain, strict=True):
            torch.testing.assert_close(step, expected)
    far = 1e12  # so large that the arrow does not matter
    step = _joint(*damped_step(equations, far * eye, still))
    torch.testing.assert_close(
        -far * step,
        _joint(equations.gel_gradient, equations.nuisance_gradient),
        rtol=1e-3,
        atol=1e-3,
    )


def _missed(monkeypatch: pytest.MonkeyPatch, most: int) -> Assimilation:
    """Fits of a model without the effect in the data, with curvature of so many joint coordinates at most."""
    monkeypatch.setattr(chains, "MOST", most)
    far = torch.tensor([[1.0, -1.0], [-1.0, 1.0]], dtype=torch.float64)
    options = SearchOptions(starts=2, basin_rounds=0, polish=False)
    return assimilate(
        prior(("nhkv",)),
        _filmed(),
        PolytropicSimulator(),
        seed=0,
        options=options,
        starts=[far],
        warn=False,
    )


def test_that_a_fit_of_a_model_that_misses_the_data_takes_fewer_iterations_to_the_same_minimum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (without,), (found,) = _missed(monkeypatch, 0).fits, _missed(monkeypatch, 200).fits
    assert without.certificate.converged
    assert found.certificate.converged
    assert found.cost == pytest.approx(without.cost, abs=0.01)
    assert found.certificate.iterations < without.certificate.iterations
