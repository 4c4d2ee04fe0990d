"""Bubbles by SciPy: they agree with the toolkit's own solvers, and the finite-difference grid with
the spectral one.
"""

import numpy as np
import pytest

from imr_torch.float64 import linspace, tensor
from imr_torch.material import PARAMETERS
from imr_torch.simulate import (
    Accuracy,
    Conditions,
    GasMixture,
    Medium,
    Resolution,
    TransportSimulator,
)
from tests.simulate.difference_grids import AuthorsResolution, DifferenceResolution
from tests.simulate.scipy_reference import solve_by_scipy

TIMES = linspace(0.0, 1.2, 31)
GELS = {
    "qKV": {"G": 2770.0, "mu": 0.186, "alpha": 0.48},
    "NHKV": {"G": 8310.0, "mu": 0.093},
    "standard linear solid": {"G_lin": 3e3, "mu": 0.05, "tau_sls": 1e-5},
}
DESIGN = tensor([300.0, 0.3])
FEW = Resolution(8, 8)


def gel(name="qKV"):
    return PARAMETERS.pack(GELS[name])


@pytest.mark.parametrize(
    ("name", "conditions", "method", "rtol"),
    [
        ("qKV", Conditions(), "BDF", 1e-5),
        (
            "NHKV",
            Conditions(medium=Medium(capacity_of="gas_wall"), stress_acceleration=False),
            "BDF",
            1e-5,
        ),
        (
            "standard linear solid",
            Conditions(mixture=GasMixture(vapour="constant")),
            "Radau",
            1e-4,
        ),
    ],
    ids=["qKV, published", "NHKV, authors' code", "memory, constant vapour, Radau"],
)
def test_transport_agrees_with_the_toolkits_solver(name, conditions, method, rtol):
    ours = TransportSimulator(conditions, Accuracy(1e-6, FEW))(gel(name), DESIGN, TIMES)
    radius, velocity, pressure = solve_by_scipy(
        (gel(name), DESIGN, TIMES),
        conditions=conditions,
        resolution=FEW,
        method=method,
        rtol=rtol,
    )
    assert ours.ok.all()
    np.testing.assert_allclose(radius, ours.radius, rtol=0.0, atol=2e-4)
    np.testing.assert_allclose(pressure, ours.bubble_pressure, rtol=5e-3)
    scale = float(ours.velocity.abs().max())
    np.testing.assert_allclose(velocity, ours.velocity, rtol=0.0, atol=5e-3 * scale)


def test_the_finite_difference_grid_is_of_second_order_in_a_bubble():
    """Each doubling of the nodes brings the radius four times closer to that on a converged spectral grid."""

    def radius(resolution):
        return TransportSimulator(accuracy=Accuracy(1e-5, resolution))(
            gel(), DESIGN, TIMES
        ).radius

    converged = radius(Resolution(20, 24))
    grids = [DifferenceResolution(n, n) for n in (16, 32, 64)]
    coarse, middle, fine = (float((radius(grid) - converged).abs().max()) for grid in grids)
    assert 3.4 < coarse / middle < 4.6
    assert 3.4 < middle / fine < 4.6
    assert fine < 6e-4
    crowded = float((radius(AuthorsResolution(32, 32, reach=2.0)) - converged).abs().max())
    assert crowded > 5.0 * middle  # what crowding the nodes at the wall is for


def test_scipy_on_finite_differences_shares_neither_time_nor_space_with_the_default():
    bubble = gel(), DESIGN, TIMES[:28]
    radius, _, _ = solve_by_scipy(
        bubble, conditions=Conditions(), resolution=DifferenceResolution(24, 24)
    )
    np.testing.assert_allclose(
        radius, TransportSimulator()(*bubble).radius, rtol=0.0, atol=5e-3
    )
