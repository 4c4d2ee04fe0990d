"""Designs one after the other against closed forms of classical regression; and the optimum that benchmarks hold campaigns to."""

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from benchmarks.campaigns import find_optimum, judge_designs
from imr_torch.campaign import Campaign, CampaignSettings
from imr_torch.design import DesignSpace, ListedDesigns, Plan, choose_sequence
from imr_torch.float64 import full, linspace, tensor
from imr_torch.material import PARAMETERS, Belief, TruncatedNormal
from imr_torch.observe import Noise, SimulatedLaboratory
from tests.formula import FormulaSimulator

SPACE = DesignSpace((100.0, 1000.0), (0.15, 0.3))
CENTRE = math.sqrt(1e5)


@dataclass(frozen=True)
class Line(FormulaSimulator):
    """``R = .5 + G + mu x`` in every frame, with ``x`` from -1 to 1 over log We; ``G`` above a limit
    fails.
    """

    limit: float = math.inf

    def formula(self, parameters, designs, times):
        g, mu = parameters[:, PARAMETERS.index(["G", "mu"])].mT
        at = (designs[:, 0] / CENTRE).log() / math.log(1000.0 / CENTRE)
        return (0.5 + g + mu * at)[:, None].expand_as(times)

    def bad(self, parameters: Tensor) -> Tensor:
        return parameters[:, PARAMETERS.index(["G"])[0]] > self.limit


WIDE = Belief.prior(
    {"nhkv": {"G": TruncatedNormal(1.0, 0.1), "mu": TruncatedNormal(1.0, 0.1)}}
)
PLAN = Plan(
    times=linspace(0.0, 1.0, 6),
    noise=Noise(floor=1e-4, slope=0.0, drift=0.0),
    collapses=None,
)


def choose(count, *, space=SPACE, camera=None):
    options = {"plan": PLAN, "space": space, "draws": 3, "grid": (21, 2)}
    return choose_sequence(WIDE, camera or Line(), count, **options)[:, 0].round().tolist()


def test_that_a_line_is_shot_at_its_ends_in_turn():
    found = choose(6)
    assert sorted(found[:2]) == sorted(found[2:4]) == sorted(found[4:]) == [100.0, 1000.0]


def test_that_bubbles_that_fail_tell_nothing():
    # all tell as much: the first
    assert choose(2, camera=Line(limit=-9.0)) == [
        100.0,
        100.0,
    ]


def test_that_information_counts_per_cost():
    rows = ((100.0, 0.2, 1.0), (300.0, 0.2, 1.0), (1000.0, 0.2, 1.0))
    assert sorted(choose(2, space=ListedDesigns(rows=rows))) == [100.0, 1000.0]
    dear = (*rows[:2], (1000.0, 0.2, 9.0))
    assert sorted(choose(2, space=ListedDesigns(rows=dear))) == [100.0, 300.0]


@pytest.mark.parametrize(
    ("degree", "best"),
    [(1, {-1.0: 1 / 2, 1.0: 1 / 2}), (2, {-1.0: 1 / 3, 0.0: 1 / 3, 1.0: 1 / 3})],
)
def test_that_the_optimum_of_benchmarks_is_that_of_the_textbook_and_its_bound_holds(
    degree, best
):
    at = linspace(-1.0, 1.0, 41)
    regressors = torch.stack([at**power for power in range(degree + 1)], 1)

    def evaluate(shares: Tensor) -> Tensor:
        return torch.logdet(regressors.mT * shares @ regressors) / (degree + 1)

    expected = torch.zeros(41).double()
    for x, share in best.items():
        expected[torch.isclose(at, tensor(x))] = share
    value, bound = find_optimum(evaluate, full((41,), 1.0 / 41.0))
    assert value == pytest.approx(float(evaluate(expected)), abs=1e-5)
    assert 0.0 <= bound < 1e-3


def test_that_designs_are_judged_as_those_of_a_gel_that_was_not_known_before(tmp_path):
    settings = CampaignSettings(plan=PLAN, space=SPACE)
    campaign = Campaign(tmp_path, WIDE, Line(), settings=settings)
    truth = WIDE.sample(1, seed=1).parameters[0]
    laboratory = SimulatedLaboratory(Line(), truth, PLAN.noise, 1, PLAN.times)
    shot = tensor([[100.0, 0.2], [1000.0, 0.2], [100.0, 0.2], [1000.0, 0.2], [1000.0, 0.2]])
    for number, design in enumerate(shot[:4]):
        campaign.tell(laboratory.shoot(design, seed=number))
    sets = torch.stack((shot[:4], tensor([300.0, 0.2]).expand(4, 2), shot[[0, 1, 3, 4]]))
    (ends, middle, lopsided), bound = judge_designs(
        campaign, sets, grid=(21, 2), draws=3, scatter=(0.0, 0.0)
    )
    assert bound < 1e-3
    assert ends == pytest.approx(1.0, abs=0.01)
    assert middle < 0.1
    assert lopsided == pytest.approx(0.75**0.5, abs=0.01)  # shares of 1/4 and 3/4
