"""The way down where Gauss-Newton crawls:

to the minimum that is known, for gel and nuisances, and only where it is needed.
"""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from imr_torch.assimilate import Point, Posterior, SearchOptions, assimilate, map_fit, polish
from imr_torch.assimilate.chains import Chains
from imr_torch.assimilate.descent import iterate
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance
from imr_torch.simulate import Solution
from tests.linear import MEANS, SDS, LinearSimulator, experiments, prior, tensor

NOISE = Noise(floor=0.002, slope=0.0, drift=0.0)
TIMES = torch.linspace(0.0, 3.0, 24, dtype=torch.float64)
TURN = 1.2
NEARLY_CENTRAL = 0.02
STARTS = tensor((0.5, 0.3), (-0.5, 2.2))


class Circle(LinearSimulator):
    """The control of ``mu`` leads the curve along a circle; data near its centre bend the cost as much as they slope it.

    With data at a share ``s`` of the circle's radius the curvature is ``s`` times Gauss and
    Newton's, so each of their steps goes only that share of the way.
    """

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        made = super().__call__(parameters, designs, times)
        stiff, turn = (
            (parameters[..., PARAMETERS.index([n])[0], None] - MEANS[n]) / SDS[n]
            for n in ("G", "mu")
        )
        phase = 2.0 * math.pi * torch.arange(times.shape[-1]) / 12
        radius = (
            0.6 + 0.3 * times + 0.1 * torch.cos(phase - turn) + 0.02 * stiff * torch.cos(2 * phase)
        )
        return replace(made, radius=torch.where(made.radius.isfinite(), radius, torch.nan))

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        return self(parameters, designs, times)


class Rough(Circle):
    """A solver whose steps, those of the leader, change every radius by as much as moves the minimum noticeably."""

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        return self._rough(super().__call__(parameters, designs, times), parameters)

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        return self._rough(super().__call__(parameters, designs, times), parameters[..., :1, :])

    def _rough(self, made: Solution, leader: Tensor) -> Solution:
        stiff = (leader[..., PARAMETERS.index(["G"])[0], None] - MEANS["G"]) / SDS["G"]
        steps = torch.sin(1e7 * stiff + torch.arange(made.radius.shape[-1]))
        return replace(made, radius=made.radius + 5e-6 * steps)


class FailsAlone(Circle):
    """Bubbles fail beyond a turn of .8 by steps of their own, not by those of a leader before it."""

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        made = self(parameters, designs, times)
        turn = (parameters[..., :1, PARAMETERS.index(["mu"])[0], None] - MEANS["mu"]) / SDS["mu"]
        return replace(made, radius=torch.where(turn < 0.8, made.radius, torch.nan))


def nearly_central(nuisance: Nuisance | None = None) -> ExperimentBatch:
    phase = 2.0 * math.pi * torch.arange(len(TIMES)) / 12
    radius = 0.6 + 0.3 * TIMES + NEARLY_CENTRAL * 0.1 * torch.cos(phase - TURN)
    return ExperimentBatch(
        (Experiment("e", (300.0, 0.2), TIMES, radius[None], nuisance or Nuisance()),), NOISE
    )


def fitted(batch: ExperimentBatch):
    belief = prior(("nhkv",))
    return assimilate(
        belief,
        batch,
        Circle(),
        seed=1,
        options=SearchOptions(raw_samples=24),
        starts=[STARTS],
        warn=False,
    ).fits[0]


@pytest.mark.parametrize("nuisance", [None, Nuisance(time_zero=0.05)], ids=["certain", "uncertain"])
def test_that_a_crawling_fit_arrives_and_would_not_alone(
    monkeypatch, nuisance: Nuisance | None
) -> None:
    batch = nearly_central(nuisance)
    arrived = fitted(batch)
    assert arrived.certificate.converged
    assert float(arrived.mean[1]) == pytest.approx(TURN, abs=0.05)  # the prior pulls
    monkeypatch.setattr(map_fit, "polish_slow", lambda searches, _: (searches, None))
    alone = fitted(batch)
    assert not alone.certificate.converged
    assert alone.cost > arrived.cost + 1.0


def test_that_a_minimum_is_one_under_the_solver_steps_of_the_leader_and_under_no_others() -> None:
    """Behind its leader a polished chain is at rest;

    behind another one, however near, it would not be.
    """
    posterior = Posterior(prior(("nhkv",)).models[0], nearly_central(), Rough())
    options = SearchOptions()
    begun = Chains.at(posterior, Point(STARTS, posterior.still(2)), masking=False)
    (polished,), any_slow = polish.polish_slow([iterate(begun, options)], options)
    assert any_slow
    led = iterate(polished, options)
    assert bool(led.finished.all())
    assert float(led.gradient.max()) < options.gradient
    beside = Point(polished.leader.gel + 1e-3, polished.leader.nuisances)
    other = iterate(polished.put(torch.arange(2), leader=beside, around=None), options)
    assert float(other.gradient.min()) > 3.0 * options.gradient


def test_that_a_fit_that_arrives_by_itself_is_left_alone(monkeypatch) -> None:
    monkeypatch.setattr(polish, "polish", lambda *_: pytest.fail("polished"))
    found = assimilate(
        prior(), experiments(3), LinearSimulator(), seed=1, options=SearchOptions(raw_samples=24)
    )
    assert found.converged


def test_that_a_point_where_bubbles_fail_is_not_taken() -> None:
    """The way to the minimum is barred at nearly half of it;

    the point ends on this side, lower than it began.
    """
    batch = nearly_central()
    barred = Circle(limit={"mu": MEANS["mu"] + 0.8 * SDS["mu"]})
    posterior = Posterior(prior(("nhkv",)).models[0], batch, barred)
    begun = Point(STARTS[0], posterior.still())
    ended = polish.polish(posterior, begun, 1e-3).point
    costs = [-float(posterior.log_joint(point)) for point in (begun, ended)]
    assert costs[1] < costs[0] < math.inf
    assert 0.5 < float(ended.gel[1]) < 0.8


def test_that_no_point_is_left_for_one_whose_own_bubbles_fail() -> None:
    posterior = Posterior(prior(("nhkv",)).models[0], nearly_central(), FailsAlone())
    begun = Point(tensor(0.0, 0.77), posterior.still())
    ended, _, left = polish._descended(posterior, begun, 50)
    assert 0.77 < float(ended.gel[1]) < 0.8
    assert 50 - polish._DESCENT < left < 50  # the steps met the bound
    assert bool(torch.isfinite(posterior.neighbourhood(ended, leader=ended).log_joint))


def test_that_no_more_points_are_simulated_than_allowed_and_the_lowest_is_kept(monkeypatch) -> None:
    monkeypatch.setattr(polish, "_POINTS", 12)
    posterior = Posterior(prior(("nhkv",)).models[0], nearly_central(), Circle())
    begun = Point(STARTS[0], posterior.still())
    simulated: list[float] = []
    monkeypatch.setattr(Posterior, "neighbourhood", _counting(Posterior.neighbourhood, simulated))
    ended = polish.polish(posterior, begun, 1e-3)
    assert not ended.arrived
    assert len(simulated) <= 12 + polish._ROUNDS  # and each round's leader
    assert -float(posterior.log_joint(ended.point)) == pytest.approx(min(simulated), abs=1e-9)


def _counting(neighbourhood, costs: list[float]):
    def counted(self, *arguments, **options):
        near = neighbourhood(self, *arguments, **options)
        costs.append(-float(near.log_joint))
        return near

    return counted


@pytest.mark.parametrize(("points", "polished"), [(12, 1), (140, 2)])
def test_that_the_second_chain_is_left_where_the_first_did_not_arrive(
    monkeypatch, points: int, polished: int
) -> None:
    monkeypatch.setattr(polish, "_POINTS", points)
    ends = []
    real = polish.polish
    monkeypatch.setattr(polish, "polish", lambda *given: ends.append(real(*given)) or ends[-1])
    posterior = Posterior(prior(("nhkv",)).models[0], nearly_central(), Circle())
    options = SearchOptions()
    begun = iterate(Chains.at(posterior, Point(STARTS, posterior.still(2)), masking=False), options)
    (chains,), any_slow = polish.polish_slow([begun], options)
    assert any_slow
    assert len(ends) == polished
    assert ends[0].arrived == (polished == 2)
    assert int((chains.point.gel != begun.point.gel).any(1).sum()) == polished
