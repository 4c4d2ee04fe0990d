"""Bubbles by SciPy: they agree with the toolkit's own solvers, and the finite-difference grid with
the spectral one.
"""

import pytest
import torch

from imr_torch.material import PARAMETERS
from imr_torch.simulate import (
    Accuracy,
    Conditions,
    GasMixture,
    Medium,
    PolytropicSimulator,
    Resolution,
    Status,
    Stepping,
    TransportSimulator,
)
from tests.simulate.bubble import sine
from tests.simulate.difference_grids import AuthorsResolution, DifferenceResolution
from tests.simulate.scipy_reference import ScipySimulator

TIMES = torch.linspace(0.0, 1.2, 31, dtype=torch.float64)
GELS = {
    "qKV": {"G": 2770.0, "mu": 0.186, "alpha": 0.48},
    "NHKV": {"G": 8310.0, "mu": 0.093},
    "standard linear solid": {"G_lin": 3e3, "mu": 0.05, "tau_sls": 1e-5},
}
DESIGN = torch.tensor([300.0, 0.3], dtype=torch.float64)
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
        ("standard linear solid", Conditions(mixture=GasMixture(vapour="constant")), "Radau", 1e-4),
    ],
    ids=["qKV, published", "NHKV, authors' code", "memory, constant vapour, Radau"],
)
def test_transport_agrees_with_the_toolkits_solver(name, conditions, method, rtol):
    ours = TransportSimulator(conditions, Accuracy(1e-6, FEW))(gel(name), DESIGN, TIMES)
    scipy = ScipySimulator(conditions, resolution=FEW, method=method, rtol=rtol, atol=1e-2 * rtol)(
        gel(name), DESIGN, TIMES
    )
    assert ours.ok.all()
    assert scipy.ok.all()
    assert int(scipy.steps) > 50
    torch.testing.assert_close(scipy.radius, ours.radius, rtol=0.0, atol=2e-4)
    torch.testing.assert_close(scipy.bubble_pressure, ours.bubble_pressure, rtol=5e-3, atol=0.0)
    assert float((scipy.velocity - ours.velocity).abs().max()) < 5e-3 * float(
        ours.velocity.abs().max()
    )


@pytest.mark.parametrize("name", GELS)
def test_polytropic_agrees_to_eight_digits(name):
    conditions = Conditions(driving=sine(2e4, 2e4)) if name == "qKV" else Conditions()
    ours = PolytropicSimulator(conditions, Stepping(0.015, max_steps=10**5))(
        gel(name), DESIGN, TIMES
    )
    scipy = ScipySimulator(conditions, "polytropic", method="LSODA", rtol=1e-11, atol=1e-13)(
        gel(name), DESIGN, TIMES
    )
    assert ours.ok.all()
    assert scipy.ok.all()
    torch.testing.assert_close(scipy.radius, ours.radius, rtol=0.0, atol=1e-8)
    torch.testing.assert_close(scipy.bubble_pressure, ours.bubble_pressure, rtol=1e-6, atol=0.0)


def test_the_finite_difference_grid_is_of_second_order_in_a_bubble():
    """Each doubling of the nodes brings the radius four times closer to that on a converged spectral grid."""

    def radius(resolution):
        return TransportSimulator(accuracy=Accuracy(1e-5, resolution))(gel(), DESIGN, TIMES).radius

    converged = radius(Resolution(20, 24))
    grids = [DifferenceResolution(n, n) for n in (16, 32, 64)]
    coarse, middle, fine = (float((radius(grid) - converged).abs().max()) for grid in grids)
    assert 3.4 < coarse / middle < 4.6
    assert 3.4 < middle / fine < 4.6
    assert fine < 6e-4
    crowded = float((radius(AuthorsResolution(32, 32, reach=2.0)) - converged).abs().max())
    assert crowded > 5.0 * middle  # what crowding the nodes at the wall is for


def test_scipy_on_finite_differences_shares_neither_time_nor_space_with_the_default():
    grid = DifferenceResolution(24, 24)
    times = TIMES[:28]
    other = ScipySimulator(resolution=grid, rtol=1e-5, atol=1e-7)(gel(), DESIGN, times)
    assert (
        float((other.radius - TransportSimulator()(gel(), DESIGN, times).radius).abs().max()) < 5e-3
    )


def test_batches_broadcast_and_number_types_follow():
    gels = torch.stack([gel("qKV"), gel("NHKV")])
    simulator = ScipySimulator(physics="polytropic", method="LSODA")
    solution = simulator(gels, DESIGN.expand(3, 1, 2), TIMES)
    assert solution.radius.shape == (3, 2, 31)
    assert solution.steps.dtype == solution.status.dtype == torch.int64
    assert torch.equal(solution.radius[0], solution.radius[2])
    assert torch.equal(solution.radius[0, 1], simulator(gel("NHKV"), DESIGN, TIMES).radius)


@pytest.mark.parametrize("method", ["Radau", "BDF", "LSODA"])
def test_a_bubble_that_scipy_cannot_do_has_a_status_and_the_rest_goes_on(method):
    gels = torch.stack([gel(), torch.full_like(gel(), torch.nan)])
    for simulator in (
        ScipySimulator(physics="polytropic", method=method),
        ScipySimulator(resolution=Resolution(4, 4), method=method, rtol=1e-3, atol=1e-4),
    ):
        solution = simulator(gels, DESIGN, TIMES[:5])
        assert solution.status.tolist() == [Status.DONE, Status.NON_FINITE]
        assert torch.isfinite(solution.radius[0]).all()
        assert torch.isnan(solution.radius[1, -1])
