"""Simulators inside ``torch.func``: vmap is a batch, forward and reverse derivatives are those of
``sensitivities``.
"""

import torch
from torch.func import grad, hessian, jacfwd, jacrev, vmap
from torch.testing import assert_close

from imr_torch.errors import UnsupportedError
from imr_torch.float64 import linspace, tensor
from imr_torch.material import PARAMETERS, material
from imr_torch.simulate import (
    Accuracy,
    PolytropicSimulator,
    Resolution,
    TransportSimulator,
    sensitivities,
)
from tests.refusals import refused
from tests.tables import for_each

TIMES = linspace(0.0, 2.0, 9)
DESIGN = tensor([300.0, 0.2])
GELS = torch.stack(
    [
        PARAMETERS.pack({"G": g, "mu": m})
        for g, m in ((5000.0, 0.1), (9000.0, 0.06), (3000.0, 0.2))
    ]
)
FEW = material(
    "nhkv"
).terms  # each entry of a gel is moved, so that all laws would act at every step
SIMULATORS = {
    "polytropic": PolytropicSimulator(),
    "tensors": PolytropicSimulator(engine="torchdiffeq", terms=FEW),
    "transport": TransportSimulator(accuracy=Accuracy(1e-3, Resolution(9, 12)), terms=FEW),
}
EACH = for_each("simulator", SIMULATORS)


@EACH
def test_that_vmap_is_a_batch_over_gels_designs_and_both(simulator):
    designs = torch.stack((DESIGN, 1.3 * DESIGN))
    by_gel = vmap(lambda gel: simulator(gel, DESIGN, TIMES).radius)(GELS)
    assert_close(by_gel, simulator(GELS, DESIGN, TIMES).radius, atol=1e-9, rtol=0.0)
    both = vmap(
        lambda gel: vmap(lambda design: simulator(gel, design, TIMES).radius)(designs)
    )(GELS)
    assert both.shape == (3, 2, 9)
    assert_close(both, simulator(GELS[:, None], designs, TIMES).radius, atol=1e-9, rtol=0.0)


@EACH
def test_that_forward_and_reverse_jacobians_are_the_sensitivities(simulator):
    _, slopes = sensitivities(simulator, GELS[0], DESIGN, TIMES, names=["G", "mu"])
    entries = PARAMETERS.index(["G", "mu"])
    forward = jacfwd(lambda gel: simulator(gel, DESIGN, TIMES).radius)(GELS[0])[:, entries]
    reverse = jacrev(lambda gel: simulator(gel, DESIGN, TIMES).radius)(GELS[0])[:, entries]
    assert_close(forward, slopes, rtol=1e-8, atol=1e-6 * float(slopes.abs().amax()))
    assert_close(reverse, slopes, rtol=1e-8, atol=1e-6 * float(slopes.abs().amax()))
    _, by_design = sensitivities(
        simulator, GELS[0], DESIGN, TIMES, names=["weber", "rest_radius"]
    )
    found = jacfwd(lambda design: simulator(GELS[0], design, TIMES).radius)(DESIGN)
    assert_close(found, by_design, rtol=1e-8, atol=1e-6 * float(by_design.abs().amax()))


def test_that_second_derivatives_are_refused_and_not_wrong():
    simulator = PolytropicSimulator()

    def total(gel: torch.Tensor, design: torch.Tensor = DESIGN) -> torch.Tensor:
        return simulator(gel, design, TIMES).radius.sum()

    for twice in (
        lambda: jacrev(grad(total))(GELS[0]),
        lambda: jacfwd(jacfwd(total))(GELS[0]),
        lambda: hessian(total)(GELS[0]),
        lambda: jacfwd(lambda gel: jacrev(lambda design: total(gel, design))(DESIGN))(
            GELS[0]
        ),
        lambda: grad(total)(GELS[0].clone().requires_grad_()),
    ):
        with refused("Second derivatives of a bubble cannot be taken", UnsupportedError):
            twice()
    assert torch.equal(
        grad(total)(GELS[0].clone().requires_grad_().detach()), grad(total)(GELS[0])
    )
