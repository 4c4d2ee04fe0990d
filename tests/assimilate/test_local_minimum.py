"""Descents to a minimum: where Gauss-Newton crawls, under the solver steps of one point, and past
places where bubbles fail.
"""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from imr_torch.assimilate import Point, Posterior, SearchOptions
from imr_torch.assimilate.local_minimum import _FrozenCost, descend_from
from imr_torch.assimilate.multistart import ModelSearch
from imr_torch.float64 import linspace, zeros
from imr_torch.material import PARAMETERS, reference_case
from imr_torch.observe import (
    Experiment,
    ExperimentBatch,
    Noise,
    Nuisance,
)
from imr_torch.random import generator
from imr_torch.simulate import Simulator, Solution, TransportSimulator
from tests.linear import MEANS, NHKV, SDS, LinearSimulator, fit_linear, tensor

NOISE = Noise(floor=0.002, slope=0.0, drift=0.0)
TIMES = linspace(0.0, 3.0, 24)
TURN = 1.2
NEARLY_CENTRAL = 0.02
STARTS = tensor((0.5, 0.3), (-0.5, 2.2))


class Circle(LinearSimulator):
    """The control of ``mu`` leads the curve along a circle; data near its centre bend the cost as much as they slope it.

    With data at a share ``s`` of the circle's radius the curvature is ``s`` times Gauss and
    Newton's, so each of their steps goes only that share of the way.
    """

    def formula(self, parameters, designs, times):
        stiff, turn = (
            (parameters[:, PARAMETERS.index([n])] - MEANS[n]) / SDS[n] for n in ("G", "mu")
        )
        phase = 2.0 * math.pi * torch.arange(times.shape[-1]) / 12
        turning = 0.1 * torch.cos(phase - turn) + 0.02 * stiff * torch.cos(2 * phase)
        return 0.6 + 0.3 * times + turning


class Rough(Circle):
    """A solver whose steps, those of the leader, change every radius by as much as moves the minimum noticeably."""

    def __call__(self, parameters, designs, times):
        return self._rough(super().__call__(parameters, designs, times), parameters)

    def bundle(self, parameters, designs, times):
        smooth = super().__call__(parameters, designs, times)
        return self._rough(smooth, parameters[..., :1, :])

    def _rough(self, made: Solution, leader: Tensor) -> Solution:
        stiff = (leader[..., PARAMETERS.index(["G"])[0], None] - MEANS["G"]) / SDS["G"]
        steps = torch.sin(1e7 * stiff + torch.arange(made.radius.shape[-1]))
        return replace(made, radius=made.radius + 5e-6 * steps)


class FailsFarFromLeader(Circle):
    """Bubbles fail by the solver steps of a leader whose turn is more than .3 from theirs, not by their own."""

    def bundle(self, parameters, designs, times):
        made = self(parameters, designs, times)
        turn = parameters[..., PARAMETERS.index(["mu"])[0], None] / SDS["mu"]
        near = (turn - turn[..., :1, :]).abs() < 0.3
        return replace(made, radius=torch.where(near, made.radius, torch.nan))


def nearly_central(nuisance: Nuisance | None = None) -> ExperimentBatch:
    phase = 2.0 * math.pi * torch.arange(len(TIMES)) / 12
    radius = 0.6 + 0.3 * TIMES + NEARLY_CENTRAL * 0.1 * torch.cos(phase - TURN)
    return ExperimentBatch(
        (Experiment("e", (300.0, 0.2), TIMES, radius[None], nuisance or Nuisance()),), NOISE
    )


def fitted(simulator: Simulator, nuisance: Nuisance | None = None):
    batch = nearly_central(nuisance)
    return fit_linear(batch, simulator, starts=[STARTS], warn=False).fits[0]


@pytest.mark.parametrize(
    "nuisance", [None, Nuisance(time_zero=0.05)], ids=["certain", "uncertain"]
)
def test_that_a_fit_arrives_where_gauss_newton_alone_would_not(monkeypatch, nuisance):
    arrived = fitted(Circle(), nuisance)
    assert arrived.certificate.converged
    assert arrived.mean[1] == pytest.approx(TURN, abs=0.05)  # the prior pulls
    monkeypatch.setattr(_FrozenCost, "_update_curvature", lambda *_: None)
    alone = fitted(Circle(), nuisance)
    assert not alone.certificate.converged


def test_that_a_fit_arrives_where_bubbles_fail_by_the_steps_of_a_leader_far_away():
    found = fitted(FailsFarFromLeader())
    assert found.certificate.converged
    assert found.cost == pytest.approx(fitted(Circle()).cost, abs=1e-4)


def test_that_a_minimum_is_one_under_the_solver_steps_of_the_leader_and_under_no_others():
    posterior = Posterior(NHKV.models[0], nearly_central(), Rough())
    start = Point(STARTS[0], posterior.mean_nuisances())
    search = ModelSearch(posterior, [start], SearchOptions(), False, generator(0))
    search.approach_first()
    search.find_lowest()
    end = search.lowest
    assert end.gradient < search.options.gradient
    assert end.leader is not None
    same = posterior.neighbourhood(end.point, leader=end.leader).equations
    beside = Point(end.leader.gel + 1e-3, end.leader.nuisances)
    other = posterior.neighbourhood(end.point, leader=beside).equations
    assert same.whitened_gradient == pytest.approx(end.gradient)
    assert other.whitened_gradient > 3.0 * search.options.gradient


def barred() -> Posterior:
    """Of gels that fail from nearly half of the way to the minimum on."""
    simulator = Circle(limit={"mu": MEANS["mu"] + 0.8 * SDS["mu"]})
    return Posterior(NHKV.models[0], nearly_central(), simulator)


def test_that_a_point_where_bubbles_fail_is_not_taken():
    """The way to the minimum is barred at nearly half of it; the point ends on this side, lower
    than it began.
    """
    posterior = barred()
    begun = Point(STARTS[0], posterior.mean_nuisances())
    ended = descend_from(posterior, begun, begun, gradient=1e-3, iterations=30)
    assert ended.cost < -posterior.log_joint(begun)
    assert 0.5 < ended.point.gel[1] < 0.8


def test_that_a_search_ends_where_failing_bubbles_bar_every_way_down():
    posterior = barred()
    start = Point(STARTS[0], posterior.mean_nuisances())
    search = ModelSearch(
        posterior, [start], SearchOptions(iterations=200), False, generator(0)
    )
    search.find_lowest()
    assert search.lowest.iterations < search.options.iterations
    assert search.lowest.gradient > search.options.gradient


def test_that_a_search_begins_with_coarse_bubbles_and_ends_with_the_simulators_own():
    gel = reference_case("soft-pa").prior.models[0]
    fine = TransportSimulator()
    times = linspace(0.0, 2.5, 60)
    truth = fine(gel.to_si(zeros(2)), tensor(400.0, 0.2), times).radius
    batch = ExperimentBatch((Experiment("shot", (400.0, 0.2), times, truth[None]),))
    posterior = Posterior(gel, batch, fine)
    starts = [Point(tensor(v, v), posterior.mean_nuisances()) for v in (0.5, -0.5)]
    search = ModelSearch(posterior, starts, SearchOptions(), True, generator(0))
    before = -float(posterior.log_joint(starts[0]))
    first = search.approach_first()
    coarse = posterior.coarse.neighbourhood(search.starts[0]).equations.whitened_gradient
    assert first < before
    assert coarse < 30.0  # with the frames next to collapses
    search.find_lowest()
    end = search.lowest
    assert end.gradient < search.options.gradient
    assert end.cost == pytest.approx(-float(posterior.log_joint(end.point)), abs=0.5)
    assert end.cost < first


def test_that_a_fit_of_which_no_start_can_be_simulated_says_so():
    fit = fitted(Circle(fails=True))
    assert fit.cost == math.inf
    assert not fit.certificate.converged
    assert fit.certificate.failed_members == 1.0
