"""False minima: a frame next to a collapse sees the same radius on either side of it, and chains
must not stay on the wrong one.
"""

import math
from dataclasses import dataclass, field

import pytest
import torch

from imr_torch.assimilate import Point, Posterior, SearchOptions, starts
from imr_torch.float64 import arange, linspace, randn, zeros
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, ExperimentBatch, Noise
from imr_torch.random import generator
from tests.formula import FormulaSimulator
from tests.linear import MEANS, NHKV, SDS, fit_linear, tensor

TIMES = linspace(0.0, 1.8, 10)
NOISE = Noise(floor=0.003, slope=0.0, drift=0.0)
CASES = 24


class CuspedSimulator(FormulaSimulator):
    """A collapse as a cusp, at a time that G sets, and a rebound whose height mu sets."""

    def formula(self, parameters, designs, times):
        g, mu = (
            (parameters[:, PARAMETERS.index([name])] - MEANS[name]) / SDS[name]
            for name in ("G", "mu")
        )
        collapse = 1.0 + 0.2 * g
        rebound = torch.where(times > collapse, 0.8 + 0.1 * mu, 1.0)
        return 0.1 + 0.9 * rebound * ((times - collapse).abs() / collapse).pow(0.4)


def film(gel: torch.Tensor, errors: torch.Tensor | float = 0.0) -> ExperimentBatch:
    """A curve of a gel."""
    radius = CuspedSimulator()(gel, tensor(500.0, 0.2), TIMES).radius[None]
    shot = Experiment("cusp", (500.0, 0.2), TIMES, radius + errors)
    return ExperimentBatch((shot,), NOISE)


def wrong_minima() -> int:
    """Of 24 gels, each searched for from two draws of the prior, those that are missed by 5 standard deviations."""
    wrong = 0
    for seed in range(CASES):
        truth = randn(2, generator=generator(seed))
        noise = generator(100 + seed)
        gel = PARAMETERS.pack(
            {
                name: MEANS[name] + SDS[name] * float(v)
                for name, v in zip(("G", "mu"), truth, strict=True)
            }
        )
        batch = film(gel, NOISE.floor * randn(1, len(TIMES), generator=noise))
        options = SearchOptions(raw_samples=2, starts=2)
        fit = fit_linear(batch, CuspedSimulator(), seed=seed, options=options).fits[0]
        wrong += bool(
            ((fit.mean - truth).abs() > 5.0 * torch.linalg.norm(fit.chol, dim=1)).any()
        )
    return wrong


@pytest.mark.filterwarnings("ignore::imr_torch.errors.ConvergenceWarning")
def test_that_chains_pass_frames_next_to_a_collapse(monkeypatch):
    assert wrong_minima() <= 2
    monkeypatch.setattr(
        starts,
        "away_from_collapses",
        lambda times, radius: torch.ones_like(times, dtype=torch.bool),
    )
    assert wrong_minima() >= 6


def test_which_frames_are_next_to_a_collapse():
    # a collapse at frame 3, and one at the end of the record
    radius = tensor(1.0, 0.9, 0.8, 0.2, 0.5, 0.7, 0.6, 0.5, 0.3, 0.1)
    kept = starts.away_from_collapses(arange(10), radius)
    assert kept.tolist() == [
        True,
        True,
        False,
        False,
        False,
        True,
        True,
        True,
        False,
        False,
    ]
    for short in (tensor(1.0, 1.0, 1.0), tensor(1.0, 0.2, 0.9)):
        assert starts.away_from_collapses(arange(3), short).all()


@dataclass(frozen=True)
class CountingSimulator(CuspedSimulator):
    """The same, with a note of each call."""

    calls: list[int] = field(default_factory=list)

    def formula(self, parameters, designs, times):
        self.calls.append(len(parameters))
        return super().formula(parameters, designs, times)


@pytest.mark.parametrize("beside", [True, False])
def test_that_the_way_without_collapses_ends_where_it_cannot_come_near_a_known_fit(beside):
    """Frames that are left out only add to the cost; a fit far below that cannot be reached, one
    beside it can.
    """
    gel = PARAMETERS.pack({name: MEANS[name] + 0.5 * SDS[name] for name in ("G", "mu")})
    batch = film(gel)

    def search(rival: float) -> tuple[float, int]:
        simulator = CountingSimulator()
        options = SearchOptions(starts=2, drop_behind=6.0, rival=rival, mask_collapses=True)
        begin = [
            tensor((2.5, -2.0), (2.4, -2.0)) if beside else tensor((-2.5, 2.0), (2.5, -2.0))
        ]
        fit = fit_linear(batch, simulator, options=options, starts=begin, warn=False).fits[
            0
        ]
        return fit.cost, sum(simulator.calls)

    free, all_calls = search(math.inf)
    cost, calls = search(free + 3.0 if beside else free - 1000.0)
    if beside:
        assert cost == pytest.approx(free, abs=1e-6)
        assert calls <= all_calls
    else:
        assert cost > free - 1000.0
        assert calls < 0.25 * all_calls


def test_that_no_gel_costs_less_than_a_prediction_that_meets_every_frame():
    batch = film(PARAMETERS.pack(MEANS))
    posterior = Posterior(NHKV.models[0], batch, CuspedSimulator())
    gels = torch.cat((zeros(1, 2), randn(50, 2, generator=generator(1))))
    costs = -posterior.log_joint(Point(gels, posterior.mean_nuisances(len(gels))))
    assert costs[0] == pytest.approx(posterior.least_cost, abs=1e-9)
    assert costs[1:].amin() > posterior.least_cost
