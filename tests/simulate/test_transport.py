"""The full-physics simulator: its contract, its physics in the limits that are known, its
robustness.
"""

import math

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre
from scipy.interpolate import CubicHermiteSpline

from imr_torch.errors import InputDataError, ShapeError
from imr_torch.material import PARAMETERS, reference_case
from imr_torch.simulate import (
    ACCURACIES,
    PRESETS,
    Accuracy,
    Conditions,
    GasMixture,
    Medium,
    PolytropicGas,
    PolytropicSimulator,
    Resolution,
    Status,
    TransportSimulator,
)
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.clock import bracket_times, ends_of, hermite_cubic
from imr_torch.simulate.engines import ENGINES
from imr_torch.simulate.rhs import HEAD, Equations
from imr_torch.simulate.rosenbrock import rosenbrock_step, scaled_error, step_factor

TIMES = torch.linspace(0.0, 2.5, 51, dtype=torch.float64)
GEL = PARAMETERS.pack({"G": 2770.0, "mu": 0.186, "alpha": 0.48})
DESIGN = torch.tensor([550.0, 0.22], dtype=torch.float64)
CLOSURES = {
    **PRESETS,
    "cold gel": Conditions(medium=Medium(warm=False)),
    "dry gas": Conditions(mixture=GasMixture(vapour="absent")),
    "constant vapour": Conditions(mixture=GasMixture(vapour="constant")),
    "frozen vapour": Conditions(mixture=GasMixture(vapour="frozen")),
}


def draws(count):
    """Gels of the paper's prior and designs all over its box."""
    random = torch.Generator().manual_seed(11)
    parameters = reference_case("stiff-pa").prior.sample(count, seed=11).parameters
    low = torch.tensor([100.0, 0.14])
    high = torch.tensor([1000.0, 0.30])
    return parameters, low + (high - low) * torch.rand(
        count, 2, generator=random, dtype=torch.float64
    )


def test_batch_shapes_broadcast_and_every_member_is_done():
    designs = torch.tensor([[[550.0, 0.22]], [[300.0, 0.3]]], dtype=torch.float64)
    solution = TransportSimulator(accuracy=ACCURACIES["fast"])(GEL.expand(3, -1), designs, TIMES)
    assert solution.radius.shape == (2, 3, 51)
    assert solution.ok.all()
    assert torch.equal(solution.radius[..., 0], torch.ones(2, 3, dtype=torch.float64))
    assert solution.radius.dtype == torch.float64


@pytest.mark.parametrize("engine", ENGINES)
def test_a_member_does_not_depend_on_its_neighbours_or_on_the_blocks(engine, monkeypatch):
    parameters, designs = draws(5)
    simulator = TransportSimulator(engine=engine)
    times = TIMES[:26]
    alone = torch.stack([simulator(parameters[i], designs[i], times).radius for i in (0, 4)])
    monkeypatch.setattr(TransportSimulator, "members", 3)
    together = simulator(parameters, designs, times)
    assert float((together.radius[[0, 4]] - alone).abs().max()) < 1e-9
    assert engine != "compiled" or torch.equal(together.radius[[0, 4]], alone)


def test_both_engines_give_the_same_solution_of_a_batch():
    parameters, designs = draws(12)
    compiled, tensors = (
        TransportSimulator(engine=engine)(parameters, designs, TIMES) for engine in ENGINES
    )
    assert compiled.ok.all()
    assert torch.equal(compiled.steps, tensors.steps)
    assert torch.equal(compiled.status, tensors.status)
    for name in ("radius", "velocity", "bubble_pressure"):
        torch.testing.assert_close(
            getattr(compiled, name), getattr(tensors, name), rtol=1e-9, atol=1e-10
        )


def test_default_accuracy_meets_its_target_on_prior_draws():
    parameters, designs = draws(12)
    radius = [
        TransportSimulator(accuracy=a)(parameters, designs, TIMES).radius
        for a in (Accuracy(), Accuracy(1e-5, Resolution(24, 24)))
    ]
    error = (radius[0] - radius[1]).abs().amax(1)
    assert float(error.median()) < 1e-3
    assert float(error.max()) < 3e-3


def test_velocity_is_the_slope_of_the_radius_and_pressure_peaks_at_collapse():
    centres = torch.linspace(0.05, 2.0, 400, dtype=torch.float64)
    eps = 1e-5
    times = (centres[:, None] + torch.tensor([-eps, 0.0, eps], dtype=torch.float64)).reshape(-1)
    solution = TransportSimulator()(GEL, DESIGN, times)
    radius = solution.radius.reshape(-1, 3)
    velocity = solution.velocity.reshape(-1, 3)[:, 1]
    slope = (radius[:, 2] - radius[:, 0]) / (2.0 * eps)
    assert float((slope - velocity).abs().max()) < 1e-3
    assert abs(int(solution.bubble_pressure.argmax()) - int(solution.radius.argmin())) <= 3


@pytest.mark.parametrize("conditions", CLOSURES.values(), ids=CLOSURES)
def test_an_equilibrium_bubble_stays_put(conditions):
    parameters = PARAMETERS.pack({"G": 5e3, "mu": 0.1, "alpha": 0.5}).expand(1, -1)
    equations = Equations(Bubbles.of(parameters, DESIGN[None], conditions), *Resolution().grids())
    pressure = 1.0 + 1.0 / (DESIGN[0] * DESIGN[1]) - equations.bubbles.numbers.constant_vapour
    state = equations.start()
    state[0], state[2] = DESIGN[1], pressure.log()
    wall = equations.fields(state).point.wall.vapour
    state[HEAD + equations.n : HEAD + 2 * equations.n] = wall
    assert float(equations.rate(equations.fields(state)).abs().max()) < 1e-8


def test_air_is_neither_made_nor_lost():
    equations = Equations(
        Bubbles.of(GEL[None], DESIGN[None], Conditions()), *Resolution(24, 24).grids()
    )
    state = equations.start()
    step = torch.tensor([1e-3], dtype=torch.float64)
    masses = [air(equations, state)]
    time = 0.0
    while time < 1.2:
        after, change = rosenbrock_step(equations, state, step)
        error = scaled_error(state, after, change, equations, 1e-5)
        if error <= 1.0:
            state = after
            time = time + float(step)
            masses.append(air(equations, state))
        step = step * step_factor(error)
    assert max(masses) / min(masses) - 1.0 < 1e-4


def air(equations, state):
    """Mass of air over 4 pi, by spectral quadrature of ``(1 - C) P/(R_mix T) R^3 y^2`` over ``y``."""
    f = equations.fields(state)
    at = f.point
    n = equations.n
    stretch = Resolution().stretch
    y = np.concatenate(([1.0], equations.inside.nodes.numpy()))
    nodes, weights = legendre.leggauss(80)
    fine = 0.5 * (nodes + 1.0)

    def basis(y):
        eta = np.arctanh(y * math.tanh(stretch)) / stretch
        return np.cos(2.0 * np.arange(n + 1) * np.arccos(np.clip(eta, -1.0, 1.0))[:, None])

    quadrature = (0.5 * weights * fine**2) @ basis(fine) @ np.linalg.inv(basis(y))
    vapour = torch.cat((at.wall.vapour[None], state[HEAD + n : HEAD + 2 * n]))
    mixture = torch.cat((at.wall.mixture[None], f.node.mixture))
    temperature = torch.cat((at.wall.temperature[None], f.node.temperature))
    density = ((1.0 - vapour) * at.pressure / (mixture * temperature) * at.radius**3)[:, 0].numpy()
    return float(quadrature @ density)


@pytest.mark.parametrize(
    ("factor", "exponent"), [(1e5, 1.0), (1e-5, 1.4)], ids=["isothermal", "adiabatic"]
)
def test_perfect_and_absent_conduction_are_the_polytropic_limits(factor, exponent):
    mixture = GasMixture(
        conductivity_slope=5.3e-5 * factor, conductivity_offset=1.17e-2 * factor, vapour="absent"
    )
    gas = PolytropicGas(exponent, vapour=False)
    conditions = Conditions(gas=gas, mixture=mixture, medium=Medium(warm=False))
    parameters = PARAMETERS.pack({"G": 2770.0, "mu": 0.2})
    designs = torch.tensor([300.0, 0.3], dtype=torch.float64)
    transport = TransportSimulator(conditions, Accuracy(1e-5, Resolution(32, 8)))(
        parameters, designs, TIMES
    )
    polytropic = PolytropicSimulator(conditions)(parameters, designs, TIMES)
    assert float((transport.radius - polytropic.radius).abs().max()) < 5e-3


@pytest.fixture(scope="module")
def by_closure():
    return {
        name: TransportSimulator(c, ACCURACIES["fast"])(GEL, DESIGN, TIMES)
        for name, c in CLOSURES.items()
    }


def test_every_closure_runs_and_damps_the_bubble(by_closure):
    for solution in by_closure.values():
        assert solution.ok.all()
        assert float(solution.radius[25:].max()) < 0.95
        assert float(solution.radius.min()) > 0.02


def test_closures_differ(by_closure):
    radius = [solution.radius for solution in by_closure.values()]
    for i in range(len(radius)):
        for other in radius[:i]:
            assert float((radius[i] - other).abs().max()) > 1e-3


def test_a_member_that_fails_has_a_status_and_leaves_the_others_alone():
    parameters = PARAMETERS.pack({"mu": torch.tensor([0.3, 1e-3], dtype=torch.float64), "G": 6e2})
    designs = torch.tensor([[100.0, 0.4], [1500.0, 0.1]], dtype=torch.float64)
    solution = TransportSimulator(accuracy=Accuracy(max_steps=90))(parameters, designs, TIMES)
    assert solution.status.tolist() == [Status.DONE, Status.TOO_MANY_STEPS]
    assert torch.isfinite(solution.radius[0]).all()
    assert torch.isfinite(solution.radius[1, :10]).all()
    assert torch.isnan(solution.radius[1, -1])
    assert "TOO_MANY_STEPS" in solution.summary()


def test_a_wide_box_of_gels_and_designs_is_solved():
    random = torch.Generator().manual_seed(2)
    low = torch.tensor([50.0, 0.08, 0.0, 0.0, 0.0])
    high = torch.tensor([2000.0, 0.5, 3e5, 1.0, 0.3])
    box = low + (high - low) * torch.rand(40, 5, generator=random, dtype=torch.float64)
    parameters = PARAMETERS.pack({"G": box[:, 2], "mu": box[:, 3], "alpha": box[:, 4]})
    solution = TransportSimulator(accuracy=ACCURACIES["fast"])(parameters, box[:, :2], TIMES)
    assert solution.ok.all(), solution.summary()
    assert torch.isfinite(solution.radius).all()


@pytest.mark.parametrize(("radius", "accepted"), [(1e-3, True), (0.0, False), (-1e-3, False)])
def test_that_a_step_ends_at_any_size_short_of_the_centre(radius, accepted):
    equations = Equations(
        Bubbles.of(GEL[None], DESIGN[None], Conditions()), *Resolution(6, 6).grids()
    )
    before = equations.start()
    after = before.clone()
    after[0] = radius
    error = scaled_error(before, after, torch.zeros_like(before), equations, 1e-5)
    assert bool(error <= 1.0) == accepted


def test_that_values_between_steps_are_a_cubic_and_before_the_first_a_line():
    nodes = torch.tensor([[0.0, 0.3, 0.5, 1.2]], dtype=torch.float64)
    values = torch.sin(3.0 * nodes) + 1.0
    rates = 3.0 * torch.cos(3.0 * nodes)
    times = torch.tensor([[-0.2, 0.0, 0.1, 0.29, 0.4, 0.6, 1.1, 1.2]], dtype=torch.float64)
    expected = torch.as_tensor(
        CubicHermiteSpline(*(x[0].numpy() for x in (nodes, values, rates)))(times.numpy())
    )
    expected[0, 0] = 1.0 - 0.2 * 3.0
    end, step, share = bracket_times(nodes, times)
    found = hermite_cubic(share, step, ends_of(values, end), ends_of(rates, end))
    torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: GasMixture(vapour="wet"), "expected one of transported, constant, frozen, absent"),
        (lambda: GasMixture(heat_ratio=1.0), "expected above 1"),
        (lambda: GasMixture(diffusivity=-1.0), "GasMixture.diffusivity is -1.0"),
        (lambda: Medium(heat_capacity=math.nan), "Medium.heat_capacity is nan"),
        (lambda: Medium(capacity_of="air"), "expected one of medium, gas_wall"),
        (lambda: Accuracy(tolerance=0.0), "expected 1e-12 to 0.1"),
        (lambda: Accuracy(max_steps=0), "max_steps is 0; expected at least 1"),
        (
            lambda: TransportSimulator(engine="gpu"),
            "engine is 'gpu'; expected one of compiled, torchdiffeq",
        ),
        (lambda: TransportSimulator()(GEL, torch.tensor([550.0, 1.2]), TIMES), "0 < R_inf\\* < 1"),
        (lambda: TransportSimulator()(GEL, DESIGN, TIMES.flip(0)), "do not increase"),
    ],
)
def test_bad_input_is_refused_with_advice(make, text):
    with pytest.raises(InputDataError, match=text):
        make()


def test_a_wrong_shape_is_refused():
    with pytest.raises(ShapeError, match="batch_shape x 2"):
        TransportSimulator()(GEL, torch.tensor([550.0, 0.2, 1.0]), TIMES)
