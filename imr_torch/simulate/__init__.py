"""Stage 2, the bubble: from a gel and a design to radius, velocity and pressure over time."""

from imr_torch.simulate.conditions import (
    PRESETS,
    STEPPINGS,
    Conditions,
    GasMixture,
    Medium,
    PolytropicGas,
    Stepping,
    preset,
)
from imr_torch.simulate.grids import Resolution
from imr_torch.simulate.polytropic import PolytropicSimulator
from imr_torch.simulate.simulator import Simulator, Solution, Status, broadcast_batch, check_designs, check_times, solve_batch
from imr_torch.simulate.transport import ACCURACIES, Accuracy, TransportSimulator

__all__ = [
    "ACCURACIES",
    "PRESETS",
    "STEPPINGS",
    "Accuracy",
    "Conditions",
    "GasMixture",
    "Medium",
    "PolytropicGas",
    "PolytropicSimulator",
    "Resolution",
    "Simulator",
    "Solution",
    "Status",
    "Stepping",
    "TransportSimulator",
    "broadcast_batch",
    "check_designs",
    "check_times",
    "preset",
    "solve_batch",
]
