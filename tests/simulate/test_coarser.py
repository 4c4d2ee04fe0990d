"""Coarser bubbles: of the same physics, close to the exact ones, and only where there are finer
ones.
"""

from imr_torch.float64 import linspace, tensor
from imr_torch.material import reference_case
from imr_torch.simulate import (
    ACCURACIES,
    PolytropicSimulator,
    TransportSimulator,
    coarser,
)

TIMES = linspace(0.0, 3.0, 61)
DESIGN = tensor([400.0, 0.2])


def test_that_only_finer_bubbles_of_the_full_physics_are_made_coarse():
    fine = TransportSimulator()
    coarse = TransportSimulator(accuracy=ACCURACIES["coarse"])
    assert coarser(fine) == coarse
    for simulator in (coarse, PolytropicSimulator()):
        assert coarser(simulator) is simulator


def test_that_their_errors_are_of_the_order_of_a_thousandth():
    gels = reference_case("soft-pa").prior.sample(40, seed=0).parameters
    exact = TransportSimulator(accuracy=ACCURACIES["reference"])(gels, DESIGN, TIMES).radius
    coarse, default = (
        float(
            (
                TransportSimulator(accuracy=ACCURACIES[name])(gels, DESIGN, TIMES).radius
                - exact
            )
            .abs()
            .mean()
        )
        for name in ("coarse", "default")
    )
    assert 1e-4 < coarse < 1e-3
    assert default < 0.5 * coarse
