"""The bubble: from a gel and a design to radius, velocity and pressure over time."""

from imr_torch.simulate.conditions import (
    PRESETS,
    STEPPINGS,
    Conditions,
    GasMixture,
    Medium,
    PolytropicGas,
    Stepping,
)
from imr_torch.simulate.driving import TabulatedDriving
from imr_torch.simulate.engines import ENGINES, Engine
from imr_torch.simulate.grids import Resolution
from imr_torch.simulate.liquids import (
    LIQUIDS,
    ConstantDensity,
    Liquid,
    MieGruneisen,
    NobleAbel,
    Tait,
)
from imr_torch.simulate.ode_method import TransportField
from imr_torch.simulate.polytropic import PolytropicSimulator, fewer_steps
from imr_torch.simulate.radial import (
    RADIAL_EQUATIONS,
    Gilmore,
    Herring,
    KellerMiksis,
    KellerMiksisEnthalpy,
    RadialEquation,
    RayleighPlesset,
    SecondOrder,
)
from imr_torch.simulate.sensitivity import DESIGN, explain_growth, sensitivities
from imr_torch.simulate.simulator import (
    EARLIEST,
    Simulator,
    Solution,
    Status,
    broadcast_batch,
    check_designs,
    check_times,
    described,
    solve_batch,
    solve_bundles,
)
from imr_torch.simulate.transport import ACCURACIES, Accuracy, TransportSimulator, coarser
from imr_torch.threads import process_pool

__all__ = [
    "ACCURACIES",
    "DESIGN",
    "EARLIEST",
    "ENGINES",
    "LIQUIDS",
    "PRESETS",
    "RADIAL_EQUATIONS",
    "STEPPINGS",
    "Accuracy",
    "Conditions",
    "ConstantDensity",
    "Engine",
    "GasMixture",
    "Gilmore",
    "Herring",
    "KellerMiksis",
    "KellerMiksisEnthalpy",
    "Liquid",
    "Medium",
    "MieGruneisen",
    "NobleAbel",
    "PolytropicGas",
    "PolytropicSimulator",
    "RadialEquation",
    "RayleighPlesset",
    "Resolution",
    "SecondOrder",
    "Simulator",
    "Solution",
    "Status",
    "Stepping",
    "TabulatedDriving",
    "Tait",
    "TransportField",
    "TransportSimulator",
    "broadcast_batch",
    "check_designs",
    "check_times",
    "coarser",
    "described",
    "explain_growth",
    "fewer_steps",
    "process_pool",
    "sensitivities",
    "solve_batch",
    "solve_bundles",
]
