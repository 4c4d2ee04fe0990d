"""The torchdiffeq engine: bubbles integrated through ``torchdiffeq.odeint``, whole states and all."""

import functools

import torch
from torchdiffeq import odeint

from imr_torch.float64 import arange, tensor
from imr_torch.material import PARAMETERS
from imr_torch.simulate import Conditions, Resolution, TransportField, TransportSimulator
from imr_torch.simulate.bubbles import Bubbles
from imr_torch.simulate.ode_method import CONTROL
from imr_torch.simulate.rhs import Equations

TICKS = arange(151)
GELS = PARAMETERS.pack({"G": tensor([2770.0, 8310.0]), "mu": 0.15})
DESIGNS = tensor([[300.0, 0.25], [150.0, 0.2]])


@functools.cache
def path(tolerance: float = 3e-4):
    bubbles = Bubbles.of(GELS, DESIGNS, Conditions())
    field = TransportField(Equations(bubbles, *Resolution().grids()), tolerance=tolerance)
    return field, odeint(field, field.start(), TICKS, method="euler")


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
            simulated = TransportSimulator(engine=engine)(
                GELS[member], DESIGNS[member], time
            )
            assert (radius - simulated.radius).abs().max() < 1e-9
            assert (log_pressure.exp() / simulated.bubble_pressure - 1.0).abs().max() < 1e-8
