"""Sensitivities carried along a step:

exact where the model is linear, exact along the step where it is not.
"""

from dataclasses import replace

import pytest
import torch

from imr_torch import reference_case
from imr_torch.assimilate import (
    Assimilation,
    Neighbourhood,
    Point,
    Posterior,
    SearchOptions,
    assimilate,
    descent,
)
from imr_torch.assimilate.secant import carried
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, Nuisance, SimulatedLaboratory
from imr_torch.random import generator
from imr_torch.simulate import PolytropicSimulator, Simulator
from tests.linear import LinearSimulator, experiments, prior

LINEAR = Nuisance(time_zero=0.2, rest_radius=0.3)
ALL = Nuisance(max_radius=0.01, time_zero=0.02, rest_radius=0.05)


def _step(simulator: Simulator, nuisance: Nuisance) -> tuple[Neighbourhood, Neighbourhood, Point]:
    """The neighbourhoods of two chains, those carried along a step of each, and the steps."""
    posterior = Posterior(prior(("nhkv",)).models[0], experiments(3, nuisance=nuisance), simulator)
    draws = generator(0)
    sds = (posterior.batch.nuisance_sds > 0.0).double()
    gel, step = (
        0.1 * torch.randn(2, 2, posterior.size, generator=draws, dtype=torch.float64)
    ).unbind()
    shifts, moved = (
        0.1 * torch.randn(2, *posterior.still(2).shape, generator=draws, dtype=torch.float64) * sds
    ).unbind()
    point = Point(gel, shifts)
    end = Point(gel + step, shifts + moved)
    near = posterior.neighbourhood(point)
    return near, carried(near, near.equations, end, posterior.predict(end)), Point(step, moved)


def test_that_sensitivities_of_a_linear_model_are_carried_unchanged() -> None:
    near, after, _ = _step(LinearSimulator(), LINEAR)
    for before, now in zip(near.slopes, after.slopes, strict=True):
        torch.testing.assert_close(now, before, atol=1e-6, rtol=1e-6)  # rounding of differences


def test_that_carried_sensitivities_give_the_change_along_the_step_that_was_seen() -> None:
    near, after, step = _step(PolytropicSimulator(), ALL)
    by_gel, by_nuisance = after.slopes
    change = (by_gel @ step.gel[:, None, :, None] + by_nuisance @ step.nuisances[..., None])[..., 0]
    torch.testing.assert_close(change, after.centre - near.centre, atol=1e-8, rtol=1e-6)
    assert float((near.slopes[0] - by_gel).abs().max()) > 1e-3  # the model is not linear


def test_that_sensitivities_in_directions_without_a_step_are_carried_unchanged() -> None:
    """A direction whose product with the step, by the Gauss-Newton Hessian, is zero learns nothing from it."""
    near, after, step = _step(PolytropicSimulator(), ALL)
    dual = (near.equations.gel_hessian @ step.gel[..., None])[..., 0]
    across = torch.stack((-dual[:, 1], dual[:, 0]), 1)
    before, now = ((n.slopes[0] @ across[:, None, :, None])[..., 0] for n in (near, after))
    torch.testing.assert_close(now, before, atol=1e-6, rtol=1e-6)


def _found(monkeypatch: pytest.MonkeyPatch, further: int) -> Assimilation:
    """Two models from far starts, on five repeats of two bubbles of one of them."""
    monkeypatch.setattr(descent, "_FURTHER", further)
    case = reference_case("soft-pa")
    simulator = PolytropicSimulator()
    laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    shots = [
        laboratory.shoot(torch.tensor(d, dtype=torch.float64), seed=1)
        for d in ((400.0, 0.22), (700.0, 0.16))
    ]
    batch = ExperimentBatch(tuple(replace(shot, nuisance=ALL) for shot in shots))
    far = torch.tensor([[1.5, -1.5, 0.5], [-1.5, 1.5, -0.5]], dtype=torch.float64)
    options = SearchOptions(starts=2, basin_rounds=0, polish=False)
    return assimilate(
        case.prior, batch, simulator, seed=0, options=options, starts=[far[:, :2], far], warn=False
    )


def test_that_further_steps_lead_to_the_same_minima_in_fewer_iterations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for single, several in zip(
        _found(monkeypatch, 0).fits, _found(monkeypatch, 3).fits, strict=True
    ):
        assert single.certificate.converged
        assert several.certificate.converged
        assert several.cost == pytest.approx(single.cost, abs=1e-4)
        assert several.certificate.iterations < single.certificate.iterations
