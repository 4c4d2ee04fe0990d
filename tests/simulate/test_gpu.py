"""On a GPU bubbles are what they are on a processor. Skipped where there is none."""

import warnings

import pytest
import torch

from imr_torch import PolytropicSimulator, TransportSimulator
from imr_torch.errors import EngineWarning
from imr_torch.material import PARAMETERS, reference_case
from imr_torch.simulate import engines, sensitivities
from imr_torch.simulate.simulator import Simulator, Status, members_together

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.filterwarnings("ignore::imr_torch.errors.EngineWarning"),
]

TIMES = torch.linspace(0.0, 3.0, 61, dtype=torch.float64)
SIMULATORS = [PolytropicSimulator(threads=1), TransportSimulator(threads=1)]


def bubbles(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Parameters and designs of ``count`` bubbles, drawn from the prior of a reference case."""
    parameters = reference_case("stiff-pa").prior.sample(count, seed=0).parameters
    unit = torch.rand(count, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    low, high = torch.tensor([[100.0, 0.14], [1000.0, 0.30]], dtype=torch.float64)
    return parameters, low + (high - low) * unit


@pytest.mark.parametrize("simulator", SIMULATORS, ids=lambda each: type(each).__name__)
def test_bubbles_agree_with_a_processor(simulator: Simulator) -> None:
    parameters, designs = bubbles(24)
    here = simulator(parameters, designs, TIMES)
    there = simulator(parameters.cuda(), designs.cuda(), TIMES.cuda())
    assert there.radius.is_cuda
    assert there.status.cpu().tolist() == here.status.tolist() == [int(Status.DONE)] * 24
    torch.testing.assert_close(there.radius.cpu(), here.radius, rtol=0.0, atol=1e-8)


def test_large_batches_are_not_cut() -> None:
    values = torch.zeros(1, dtype=torch.float64)
    assert members_together(values, 1000, 150_000) == 1000
    assert members_together(values.cuda(), 1000, 150_000) == max(
        1000, torch.cuda.mem_get_info()[0] // 300_000
    )


def test_a_failed_bubble_is_a_status() -> None:
    parameters, designs = bubbles(3)
    parameters[1, PARAMETERS.index(["mu"])] = torch.nan
    found = PolytropicSimulator()(parameters.cuda(), designs.cuda(), TIMES.cuda())
    assert (found.status == int(Status.DONE)).tolist() == [True, False, True]


def test_autograd_through_the_polytropic_solve() -> None:
    gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})
    design = torch.tensor([300.0, 0.2], dtype=torch.float64)
    simulator = PolytropicSimulator(engine="torchdiffeq")
    slopes = []
    for device in ("cpu", "cuda"):
        theta = gel.to(device).detach().requires_grad_()
        simulator(theta, design.to(device), TIMES.to(device)).radius.sum().backward()
        assert theta.grad is not None
        slopes.append(theta.grad.cpu())
    torch.testing.assert_close(slopes[1], slopes[0], rtol=1e-6, atol=1e-9)


def test_sensitivities() -> None:
    gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})
    design = torch.tensor([300.0, 0.2], dtype=torch.float64)
    names = ("G", "mu")
    _, here = sensitivities(PolytropicSimulator(threads=1), gel, design, TIMES, names=names)
    _, there = sensitivities(
        PolytropicSimulator(), gel.cuda(), design.cuda(), TIMES.cuda(), names=names
    )
    assert there.is_cuda
    scale = here.abs().amax(-2)
    assert bool(((there.cpu() - here).abs().amax(-2) < 2e-2 * scale).all())


def test_the_change_of_engine_is_said() -> None:
    engines._warn_once.cache_clear()
    parameters, designs = bubbles(1)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        PolytropicSimulator()(parameters.cuda(), designs.cuda(), TIMES.cuda())
    assert [
        "does not run on cuda" in str(each.message)
        for each in said
        if each.category is EngineWarning
    ] == [True]
