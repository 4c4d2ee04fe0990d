"""The full-physics simulator: its contract, its physics in the limits that are known, its
robustness.
"""

import math

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre

from imr_torch.errors import ShapeError
from imr_torch.float64 import linspace, rand, tensor
from imr_torch.material import PARAMETERS
from imr_torch.random import generator
from imr_torch.simulate import (
    ACCURACIES,
    Accuracy,
    Conditions,
    GasMixture,
    Medium,
    Resolution,
    TransportSimulator,
)
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.engines import ENGINES
from imr_torch.simulate.rhs import HEAD, Equations
from imr_torch.simulate.rosenbrock import rosenbrock_step, scaled_error, step_factor
from tests.refusals import refusals, refused
from tests.simulate.bubble import CLOSURES, draw_bubbles, largest_difference

TIMES = linspace(0.0, 2.5, 51)
GEL = PARAMETERS.pack({"G": 2770.0, "mu": 0.186, "alpha": 0.48})
DESIGN = tensor([550.0, 0.22])


@pytest.mark.parametrize("engine", ENGINES)
def test_a_member_does_not_depend_on_its_neighbours_or_on_the_blocks(engine, monkeypatch):
    parameters, designs = draw_bubbles(5, 11)
    simulator = TransportSimulator(engine=engine)
    times = TIMES[:16]
    alone = torch.stack(
        [simulator(parameters[i], designs[i], times).radius for i in (0, 4)]
    )
    monkeypatch.setattr(TransportSimulator, "members", 3)
    together = simulator(parameters, designs, times)
    assert largest_difference(together.radius[[0, 4]], alone) < 1e-9
    assert engine != "compiled" or torch.equal(together.radius[[0, 4]], alone)


def test_default_accuracy_meets_its_target_on_prior_draws():
    parameters, designs = draw_bubbles(12, 11)
    radius = [
        TransportSimulator(accuracy=a)(parameters, designs, TIMES).radius
        for a in (Accuracy(), Accuracy(1e-5, Resolution(24, 24)))
    ]
    error = (radius[0] - radius[1]).abs().amax(1)
    assert error.median() < 1e-3
    assert error.max() < 3e-3


def test_velocity_is_the_slope_of_the_radius_and_pressure_peaks_at_collapse():
    centres = linspace(0.05, 2.0, 400)
    eps = 1e-5
    times = (centres[:, None] + tensor([-eps, 0.0, eps])).reshape(-1)
    solution = TransportSimulator()(GEL, DESIGN, times)
    radius = solution.radius.reshape(-1, 3)
    velocity = solution.velocity.reshape(-1, 3)[:, 1]
    slope = (radius[:, 2] - radius[:, 0]) / (2.0 * eps)
    assert largest_difference(slope, velocity) < 1e-3
    assert abs(int(solution.bubble_pressure.argmax()) - int(solution.radius.argmin())) <= 3


def test_air_is_neither_made_nor_lost():
    equations = Equations(
        Bubbles.of(GEL[None], DESIGN[None], Conditions()), *Resolution(24, 24).grids()
    )
    state = equations.start()
    step = tensor([1e-3])
    masses = [air(equations, state)]
    time = 0.0
    while time < 1.2:
        after, change = rosenbrock_step(equations, state, step, 0.0 * step)
        error = scaled_error(state, after, change, equations, 1e-5)
        if error <= 1.0:
            state = after
            time = time + float(step)
            masses.append(air(equations, state))
        step = step * step_factor(error)
    assert max(masses) / min(masses) - 1.0 < 1e-4


def air(equations, state):
    """Mass of air over 4 pi, by spectral quadrature of ``(1 - C) P/(R_mix T) R^3 y^2`` over ``y``."""
    f = equations.fields(state, torch.zeros_like(state[0]))
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
    density = ((1.0 - vapour) * at.pressure / (mixture * temperature) * at.radius**3)[
        :, 0
    ].numpy()
    return float(quadrature @ density)


def test_closures_differ():
    radius = [
        TransportSimulator(conditions, ACCURACIES["fast"])(GEL, DESIGN, TIMES).radius
        for conditions in CLOSURES.values()
    ]
    for i in range(len(radius)):
        for other in radius[:i]:
            assert largest_difference(radius[i], other) > 1e-3


def test_a_wide_box_of_gels_and_designs_is_solved():
    random = generator(2)
    low = torch.tensor([50.0, 0.08, 0.0, 0.0, 0.0])
    high = torch.tensor([2000.0, 0.5, 3e5, 1.0, 0.3])
    box = low + (high - low) * rand(40, 5, generator=random)
    parameters = PARAMETERS.pack({"G": box[:, 2], "mu": box[:, 3], "alpha": box[:, 4]})
    solution = TransportSimulator(accuracy=ACCURACIES["fast"])(
        parameters, box[:, :2], TIMES
    )
    assert solution.ok.all(), solution.summary()
    assert torch.isfinite(solution.radius).all()


test_bad_input_is_refused_with_advice = refusals(
    (
        lambda: GasMixture(vapour="wet"),
        "expected one of transported, constant, frozen, absent",
    ),
    (lambda: GasMixture(heat_ratio=1.0), "expected above 1"),
    (lambda: GasMixture(diffusivity=-1.0), "GasMixture.diffusivity is -1.0"),
    (lambda: Medium(heat_capacity=math.nan), "Medium.heat_capacity is nan"),
    (lambda: Medium(capacity_of="air"), "expected one of medium, gas_wall"),
    (lambda: Accuracy(tolerance=0.0), "expected 1e-12 to 0.1"),
    (lambda: Accuracy(max_steps=0), "max_steps is 0; expected at least 1"),
)


def test_a_wrong_shape_is_refused():
    with refused("batch_shape x 2", ShapeError):
        TransportSimulator()(GEL, torch.tensor([550.0, 0.2, 1.0]), TIMES)
