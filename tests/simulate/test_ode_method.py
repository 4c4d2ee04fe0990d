"""The solver reached through ``torchdiffeq.odeint``."""

import pytest
import torch
from torchdiffeq import odeint

from imr_torch.errors import ConvergenceError, UnsupportedError
from imr_torch.material import PARAMETERS
from imr_torch.simulate import TransportSimulator
from imr_torch.simulate.ode_method import METHOD, TransportField

TIMES = torch.linspace(0.0, 1.6, 17, dtype=torch.float64)
GELS = PARAMETERS.pack({"G": torch.tensor([2770.0, 8310.0], dtype=torch.float64), "mu": 0.15})
DESIGNS = torch.tensor([[300.0, 0.25], [150.0, 0.2]], dtype=torch.float64)


def test_odeint_gives_the_radius_of_the_simulator_and_all_fields():
    field = TransportField(GELS, DESIGNS)
    states = odeint(field, field.start(), TIMES, method=METHOD, rtol=2e-5)
    assert states.shape == (17, 4 + 3 * 18, 2)
    simulated = TransportSimulator()(GELS, DESIGNS, TIMES)
    assert float((states[:, 0].T - simulated.radius).abs().max()) < 1e-3
    assert float((states[:, 2].T.exp() / simulated.bubble_pressure - 1.0).abs().max()) < 1e-2
    assert torch.isfinite(states).all()


def test_the_wall_stays_in_balance():
    field = TransportField(GELS, DESIGNS)
    states = odeint(field, field.start(), TIMES, method=METHOD, rtol=1e-6)
    balance = torch.stack([field(TIMES[0], state)[3] for state in states])
    assert float(balance.abs().max()) < 1e-4


def test_other_right_hand_sides_are_refused():
    with pytest.raises(UnsupportedError, match="needs a TransportField"):
        odeint(lambda t, y: -y, torch.ones(3, dtype=torch.float64), TIMES, method=METHOD)


def test_running_out_of_steps_is_an_error_here():
    field = TransportField(GELS, DESIGNS)
    with pytest.raises(ConvergenceError, match="took more than 3 steps"):
        odeint(field, field.start(), TIMES, method=METHOD, options={"max_steps": 3})
