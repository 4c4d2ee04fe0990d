"""The torchdiffeq engine:

bubbles integrated through ``torchdiffeq.odeint``, whole states and all.
"""

import sys

import pytest
import torch
from torchdiffeq import odeint

from imr_torch.errors import UnsupportedError
from imr_torch.material import PARAMETERS
from imr_torch.simulate import METHOD, TransportField, TransportSimulator, ode_method
from imr_torch.simulate.ode_method import CONTROL

TICKS = torch.arange(151, dtype=torch.float64)
GELS = PARAMETERS.pack({"G": torch.tensor([2770.0, 8310.0], dtype=torch.float64), "mu": 0.15})
DESIGNS = torch.tensor([[300.0, 0.25], [150.0, 0.2]], dtype=torch.float64)


def path(rtol: float = 3e-4):
    field = TransportField.of(GELS, DESIGNS)
    return field, odeint(field, field.start(), TICKS, method=METHOD, rtol=rtol)


def test_odeint_gives_whole_states_that_lie_on_the_simulated_curves():
    _, states = path()
    assert states.shape == (151, 4 + 3 * 18 + CONTROL, 2)
    assert torch.isfinite(states).all()
    for member in range(2):
        rows = states[:, :, member]
        moved = torch.cat((torch.tensor([True]), rows[1:, -CONTROL] > rows[:-1, -CONTROL]))
        time = rows[moved, -CONTROL]
        radius = rows[moved, 0]
        log_pressure = rows[moved, 2]
        for engine in ("compiled", "torchdiffeq"):
            simulated = TransportSimulator(engine=engine)(GELS[member], DESIGNS[member], time)
            assert float((radius - simulated.radius).abs().max()) < 1e-9
            assert float((log_pressure.exp() / simulated.bubble_pressure - 1.0).abs().max()) < 1e-8


def test_ticks_may_be_taken_several_at_a_time():
    field, states = path()
    coarse = odeint(field, field.start(), TICKS[::50], method=METHOD, rtol=3e-4)
    assert torch.equal(coarse, states[::50])


def test_the_wall_stays_in_balance():
    field, states = path(1e-6)
    equations = field.equations
    balance = torch.stack(
        [equations.rate(equations.fields(state[:-CONTROL]))[3] for state in states]
    )
    assert float(balance.abs().max()) < 1e-4


def test_other_right_hand_sides_are_refused():
    with pytest.raises(UnsupportedError, match="needs a TransportField"):
        odeint(lambda t, y: -y, torch.ones(3, dtype=torch.float64), TICKS, method=METHOD)


def test_other_methods_are_refused():
    field = TransportField.of(GELS, DESIGNS)
    with pytest.raises(UnsupportedError, match="integrated by method='imr_rodas4p' only"):
        odeint(field, field.start(), TICKS, method="rk4")


def test_a_torchdiffeq_that_keeps_its_methods_elsewhere_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "torchdiffeq._impl.odeint", None)
    with pytest.raises(UnsupportedError, match=r"install torchdiffeq 0\.2\.5"):
        ode_method._register()
