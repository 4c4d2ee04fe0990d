"""Valleys of the nuisances: the deepest is found at a fixed gel, and a search ends there whichever it began in."""

from dataclasses import dataclass, field, replace

import pytest
import torch
from torch import Tensor

from imr_torch.assimilate import EnsembleOptions, assimilate, race
from imr_torch.assimilate.valleys import deeper_nuisances
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Nuisance, predict
from imr_torch.simulate import Conditions, Solution
from tests.linear import MEANS, NOISE, LinearSimulator, experiments, prior

PERIOD = 0.3  # 1.5 prior standard deviations of time zero


@dataclass(frozen=True)
class WavySimulator:
    """The linear simulator with a damped wave on it, so that time zero has a valley in each period."""

    conditions: Conditions = field(default_factory=Conditions)

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        linear = LinearSimulator()(parameters, designs, times)
        wave = 0.3 * torch.exp(-linear.times) * torch.cos(2.0 * torch.pi * linear.times / PERIOD)
        return replace(linear, radius=linear.radius + wave)

    def bundle(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        return self(parameters, designs, times)


TRUTH = torch.tensor([[0.0, 0.4, 0.2], [0.0, -0.7, -0.5], [0.0, 0.1, 0.6]], dtype=torch.float64)


def shot(nuisance: Nuisance) -> ExperimentBatch:
    """Curves with errors of their own, of a gel at the prior's mean."""
    plan, source = experiments(3, nuisance=nuisance), torch.Generator().manual_seed(4)
    gel = PARAMETERS.pack({name: torch.tensor(MEANS[name], dtype=torch.float64) for name in ("G", "mu")})
    clean = predict(WavySimulator(), gel, plan, TRUTH * plan.nuisance_sds)
    made = []
    for e, curve in zip(plan.experiments, clean, strict=True):
        radius = NOISE.draw(curve[: len(e.times)], e.times, 2, generator=source)
        made.append(Experiment(e.label, e.design, e.times, radius, nuisance))
    return ExperimentBatch(tuple(made), NOISE)


BOTH = Nuisance(time_zero=0.2, rest_radius=0.3)


def off(periods: list[float]) -> Tensor:
    """The true nuisances with clocks off by periods."""
    wrong = TRUTH.clone()
    wrong[:, 1] += torch.tensor(periods, dtype=torch.float64) * PERIOD / 0.2
    return wrong


def test_that_the_deepest_valley_of_each_experiment_is_found_and_a_right_one_kept() -> None:
    batch, gel = shot(BOTH), prior(("nhkv",)).models[0]
    parameters = gel.parameters(gel.mean)[None].expand(2, -1)
    places = torch.stack((off([0.0, 0.0, 0.0]), off([1.0, 0.0, -1.0])))
    found = deeper_nuisances(parameters, places, batch, WavySimulator())
    torch.testing.assert_close(found[:, :, 1], TRUTH[:, 1].expand(2, -1), rtol=0.0, atol=0.3)
    assert not torch.equal(found[1, ::2], places[1, ::2])
    assert torch.equal(deeper_nuisances(parameters, found, batch, WavySimulator()), found)


def test_that_nothing_is_simulated_where_clocks_are_sure() -> None:
    batch = shot(Nuisance(rest_radius=0.3))
    places = torch.zeros(1, 3, 3, dtype=torch.float64)
    assert deeper_nuisances(torch.zeros(1, len(PARAMETERS)), places, batch, lambda *_: pytest.fail("simulated")) is places


def test_that_what_cannot_be_simulated_is_no_valley() -> None:
    batch, gel = shot(BOTH), prior(("nhkv",)).models[0]
    places = off([1.0, 0.0, 0.0])[None]
    parameters = gel.parameters(gel.mean)[None]
    assert torch.equal(deeper_nuisances(parameters, places, batch, LinearSimulator(fails=True)), places)


def test_that_a_search_ends_in_the_deepest_valley_wherever_it_began(monkeypatch: pytest.MonkeyPatch) -> None:
    batch, belief, options = shot(BOTH), prior(("newtonian", "nhkv")), EnsembleOptions(starts=2)
    starts = [torch.stack((torch.zeros(k), torch.full((k,), 0.1))).double() for k in (1, 2)]

    def fit(periods: list[float]):
        nuisances = [off(periods)] * 2
        return assimilate(
            belief, batch, WavySimulator(), seed=0, options=options, starts=starts, nuisances=nuisances, warn=False
        )

    right, mended = fit([0.0, 0.0, 0.0]), fit([1.0, 0.0, -1.0])
    monkeypatch.setattr(race.Race, "descend", lambda _: False)
    wrong = fit([1.0, 0.0, -1.0])
    assert right.converged
    assert mended.converged
    assert wrong.converged  # its starts agree: that certificate says nothing of other valleys
    assert wrong["nhkv"].cost > right["nhkv"].cost + 5.0
    assert mended["nhkv"].cost == pytest.approx(right["nhkv"].cost, abs=1e-4)
    torch.testing.assert_close(mended["nhkv"].mean, right["nhkv"].mean, rtol=0.0, atol=1e-2)
    assert wrong["newtonian"].cost > wrong["nhkv"].cost + 200.0
    assert mended["newtonian"].cost == wrong["newtonian"].cost  # so far behind that nobody looks
