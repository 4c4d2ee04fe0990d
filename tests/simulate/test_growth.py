"""Growth before the maximum radius, against SciPy integrating the equations of motion backwards."""

import numpy as np
import pytest
import torch

from imr_torch import PolytropicSimulator, TransportSimulator
from imr_torch.errors import UnsupportedError
from imr_torch.float64 import linspace, ones, tensor
from imr_torch.material import MATERIALS, PARAMETERS, TERMS
from imr_torch.observe import Experiment, ExperimentBatch, Nuisance, predict
from imr_torch.simulate import Conditions, PolytropicGas, Stepping, TabulatedDriving
from imr_torch.simulate.growth import WithGrowth, check_reversible
from tests.record.bubbles import LIQUID, paths
from tests.refusals import refused

SIZE, REST = 300e-6, 60e-6
DESIGN = tensor([float(LIQUID.weber(SIZE)), REST / SIZE])
SIMULATOR = PolytropicSimulator(
    Conditions(gas=PolytropicGas(exponent=1.4, reference="rest")),
    Stepping(0.05, max_steps=60000),
)


@pytest.mark.parametrize(("modulus", "viscosity"), [(0.0, 0.1), (2e4, 0.0), (8e3, 0.15)])
def test_that_growth_and_collapse_are_those_of_another_solver(modulus, viscosity):
    growth, collapse = paths(SIZE, REST, modulus, viscosity)
    scale = float(LIQUID.time_scale(SIZE))
    times = np.linspace(0.98 * growth.t[-1], 0.98 * collapse.t[-1], 61)
    before = times < 0
    exact, speed = np.where(
        before, growth.sol(times * before), collapse.sol(times * ~before)
    )
    gel = PARAMETERS.pack({"G": modulus, "mu": viscosity})
    solution = WithGrowth(SIMULATOR)(gel, DESIGN, torch.tensor(times / scale))
    assert np.abs(solution.radius.numpy() - exact / SIZE).max() < 2e-6
    assert np.abs(solution.velocity.numpy() - speed * scale / SIZE).max() < 1e-4


def test_that_a_lossless_bubble_grows_as_it_collapses():
    quiet = Conditions(surroundings=type(LIQUID)(sound_speed=1e12))
    times = linspace(-0.85, 0.85, 35)
    radius = WithGrowth(PolytropicSimulator(quiet))(
        PARAMETERS.pack({"G": 5e3}), DESIGN, times
    ).radius
    assert torch.allclose(radius, radius.flip(0), atol=1e-7)


def test_that_bundles_and_single_bubbles_agree_and_the_tangent_is_smooth():
    times = linspace(-0.7, 0.7, 29)
    gels = PARAMETERS.pack({"G": 8e3, "mu": tensor([0.1, 0.1001])})
    simulator = WithGrowth(TransportSimulator())
    alone = simulator(gels, DESIGN, times)
    bundle = simulator.bundle(gels, DESIGN.expand(2, 2), times.expand(2, -1))
    assert torch.allclose(alone.radius, bundle.radius, atol=2e-6)
    slope = (bundle.radius[1] - bundle.radius[0]) / 1e-4
    assert (slope[times < -0.1] < 0.0).all()  # seen from its maximum: faster growth
    assert (slope[times > 0.1] > 0.0).all()


def test_that_frames_before_the_maximum_are_predicted_with_any_shift_of_time():
    times = linspace(-0.6, 0.8, 29)
    plan = Experiment(
        "shot",
        tuple(DESIGN.tolist()),
        times,
        ones(1, 29),
        Nuisance(0.01, 0.02, 0.02),
    )
    batch = ExperimentBatch((plan,))
    gel = PARAMETERS.pack({"G": 8e3, "mu": 0.1})[None]
    shift = tensor([0.0, -0.05, 0.0])
    seen = predict(SIMULATOR, gel, batch, shift[None, None])[0, 0]
    exact = WithGrowth(SIMULATOR)(gel[0], DESIGN, times - 0.05).radius
    assert torch.allclose(seen, exact, atol=1e-9)


def test_that_models_that_remember_are_refused_by_name():
    for key, model in MATERIALS.items():
        if any(term.states for term in model.terms):
            with refused(f"Growth cannot be predicted for {key}", UnsupportedError):
                check_reversible(key, model.names, SIMULATOR)
        else:
            check_reversible(key, model.names, SIMULATOR)
    with refused("vapour_pressure is of a gel", UnsupportedError):
        check_reversible("nhkv", ("G", "mu", "vapour_pressure"), SIMULATOR)


def test_that_every_law_said_to_be_reversible_is():
    state = [tensor(x) for x in (0.7, -0.6, 0.2)]
    back = [state[0], -state[1], state[2]]
    tested = [term for term in TERMS if term.odd is not None]
    assert len(tested) >= 8
    for term in tested:
        assert not term.states
        theta = {name: tensor(0.3) for name in term.names}
        mirrored = {name: -x if name in term.odd else x for name, x in theta.items()}
        here = term.evaluate_law(*state, theta, None)
        there = term.evaluate_law(*back, mirrored, None)
        # S is the same, dS/dt changes its sign with time, and so the factor of dU/dt
        assert torch.allclose(here[0], there[0])
        assert torch.allclose(here[1], -there[1])
        assert torch.allclose(here[2], -there[2])


def test_that_growth_under_a_driving_pressure_is_refused():
    driven = Conditions(driving=TabulatedDriving((0.0, 1e-5, 2e-5), (0.0, 1e4, 0.0)))
    with refused("under a driving pressure", UnsupportedError):
        check_reversible("nhkv", ("G", "mu"), PolytropicSimulator(driven))
