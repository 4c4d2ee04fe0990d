"""The optimal measure in hindsight, of bubbles that are linear in the gel."""

from dataclasses import replace

import pytest
import torch

from benchmarks.campaigns import hindsight_measure
from imr_torch.campaign import Campaign, CampaignSettings
from imr_torch.design import MeasureOptions, optimal_measure
from imr_torch.float64 import linspace, tensor
from imr_torch.observe import SimulatedLaboratory
from tests.design.test_measure import PLAN as SHORT
from tests.design.test_measure import SPACE, WIDE, Line

PLAN = replace(SHORT, times=linspace(0.0, 1.0, 6))
OPTIONS = MeasureOptions(draws=3, grid=(21, 2), scatter=(0.0, 0.0))


def tell_shots(folder, webers):
    settings = CampaignSettings(plan=PLAN, space=SPACE)
    campaign = Campaign(folder, WIDE, Line(), settings=settings)
    truth = WIDE.sample(1, seed=1).parameters[0]
    laboratory = SimulatedLaboratory(Line(), truth, PLAN.noise, 1, PLAN.times)
    for number, weber in enumerate(webers):
        design = tensor([weber, 0.2])
        campaign.tell(laboratory.shoot(design, seed=number))
    return campaign


def test_that_designs_are_judged_as_those_of_a_gel_that_was_not_known_before(tmp_path):
    campaign = tell_shots(tmp_path, (100.0, 1000.0, 100.0, 1000.0))
    found = hindsight_measure(campaign, OPTIONS)
    before = optimal_measure(WIDE, Line(), shots=4, plan=PLAN, space=SPACE, options=OPTIONS)
    ends, middle = torch.tensor([[100.0, 0.2], [1000.0, 0.2]]), torch.tensor([[300.0, 0.2]])
    assert found.shots == 4
    assert found.efficiency(ends.double()) == pytest.approx(1.0, abs=0.01)
    # a linear camera tells the same of every gel, so hindsight changes nothing
    assert found.efficiency(middle.double()) == pytest.approx(
        before.efficiency(middle.double()), rel=1e-6
    )
    assert found.efficiency(middle.double()) < 0.1
