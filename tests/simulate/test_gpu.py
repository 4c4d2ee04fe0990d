"""On a GPU bubbles are what they are on a processor. Skipped where there is none."""

import pytest
import torch

from imr_torch import PolytropicSimulator, TransportSimulator
from imr_torch.float64 import linspace, rand, tensor
from imr_torch.material import PARAMETERS, reference_case
from imr_torch.simulate.simulator import Status

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.filterwarnings("ignore::imr_torch.errors.EngineWarning"),
]

TIMES = linspace(0.0, 3.0, 61)
SIMULATORS = [PolytropicSimulator(threads=1), TransportSimulator(threads=1)]


def bubbles(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Parameters and designs of ``count`` bubbles, drawn from the prior of a reference case."""
    parameters = reference_case("stiff-pa").prior.sample(count, seed=0).parameters
    unit = rand(count, 2, generator=torch.Generator().manual_seed(1))
    low, high = tensor([[100.0, 0.14], [1000.0, 0.30]])
    return parameters, low + (high - low) * unit


@pytest.mark.parametrize("simulator", SIMULATORS, ids=lambda each: type(each).__name__)
def test_bubbles_agree_with_a_processor(simulator):
    parameters, designs = bubbles(24)
    here = simulator(parameters, designs, TIMES)
    there = simulator(parameters.cuda(), designs.cuda(), TIMES.cuda())
    assert there.radius.is_cuda
    assert there.status.cpu().tolist() == here.status.tolist() == [int(Status.DONE)] * 24
    torch.testing.assert_close(there.radius.cpu(), here.radius, rtol=0.0, atol=1e-8)


def test_a_failed_bubble_is_a_status():
    parameters, designs = bubbles(3)
    parameters[1, PARAMETERS.index(["mu"])] = torch.nan
    found = PolytropicSimulator()(parameters.cuda(), designs.cuda(), TIMES.cuda())
    assert (found.status == int(Status.DONE)).tolist() == [True, False, True]
