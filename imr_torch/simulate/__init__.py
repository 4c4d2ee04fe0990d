"""Stage 2, the bubble: from a gel and a design to radius, velocity and pressure over time."""

from imr_torch.simulate.conditions import STEPPINGS, Conditions, PolytropicGas, Stepping
from imr_torch.simulate.polytropic import PolytropicSimulator
from imr_torch.simulate.simulator import Simulator, Solution, Status, broadcast_batch
from imr_torch.simulate.wall import check_designs

__all__ = [
    "STEPPINGS",
    "Conditions",
    "PolytropicGas",
    "PolytropicSimulator",
    "Simulator",
    "Solution",
    "Status",
    "Stepping",
    "broadcast_batch",
    "check_designs",
]
