"""On a GPU bubbles are what they are on a processor. Skipped where there is none."""

import pytest
import torch

from imr_torch import PolytropicSimulator, TransportSimulator
from imr_torch.float64 import linspace
from imr_torch.material import PARAMETERS
from imr_torch.simulate.simulator import Status
from tests.simulate.bubble import draw_bubbles

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.filterwarnings("ignore::imr_torch.errors.EngineWarning"),
]

TIMES = linspace(0.0, 3.0, 61)
SIMULATORS = [PolytropicSimulator(threads=1), TransportSimulator(threads=1)]


@pytest.mark.parametrize("simulator", SIMULATORS, ids=lambda each: type(each).__name__)
def test_bubbles_agree_with_a_processor(simulator):
    parameters, designs = draw_bubbles(24, 0)
    here = simulator(parameters, designs, TIMES)
    there = simulator(parameters.cuda(), designs.cuda(), TIMES.cuda())
    assert there.radius.is_cuda
    assert there.status.cpu().tolist() == here.status.tolist() == [int(Status.DONE)] * 24
    torch.testing.assert_close(there.radius.cpu(), here.radius, rtol=0.0, atol=1e-8)


def test_a_failed_bubble_is_a_status():
    parameters, designs = draw_bubbles(3, 0)
    parameters[1, PARAMETERS.index(["mu"])] = torch.nan
    found = PolytropicSimulator()(parameters.cuda(), designs.cuda(), TIMES.cuda())
    assert (found.status == int(Status.DONE)).tolist() == [True, False, True]
