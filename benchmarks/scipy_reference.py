"""Bubbles by SciPy, and on finite differences: steps, process CPU time, and the distance to the
toolkit's own solver.

  python benchmarks/scipy_reference.py

One mild bubble (We 300, R_inf* .3, qKV). SciPy on 10 + 10 modes and t* up to 2.5, against the
toolkit's solver at tolerance 1e-6 on the same modes; grids up to t* = 1.5, against a converged
spectral one.
"""

import time

import torch
from torch import Tensor

from imr_torch.material import PARAMETERS
from imr_torch.simulate import (
    Accuracy,
    PolytropicSimulator,
    Resolution,
    ScipySimulator,
    Simulator,
    Stepping,
    TransportSimulator,
)

GEL = PARAMETERS.pack({"G": 2770.0, "mu": 0.186, "alpha": 0.48})
DESIGN = torch.tensor([300.0, 0.3], dtype=torch.float64)
MODES = Resolution(10, 10)


def compare(label: str, simulator: Simulator, reference: Tensor, last: float) -> None:
    """Print one row: label, steps, CPU seconds, largest distance from the radii of ``reference``."""
    started = time.process_time()
    solution = simulator(GEL, DESIGN, times(last))
    error = float((solution.radius - reference).abs().max())
    print(
        f"{label:32} {int(solution.steps):6} {time.process_time() - started:8.2f} s {error:10.1e}",
        flush=True,
    )


def times(last: float) -> Tensor:
    """Sample times, 61 of them."""
    return torch.linspace(0.0, last, 61, dtype=torch.float64)


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    radius = TransportSimulator(accuracy=Accuracy(1e-6, MODES))(GEL, DESIGN, times(2.5)).radius
    for method, rtol in (("BDF", 1e-5), ("BDF", 1e-7), ("Radau", 1e-5), ("LSODA", 1e-5)):
        stiff = ScipySimulator(resolution=MODES, method=method, rtol=rtol, atol=1e-2 * rtol)
        compare(f"{method}, {rtol:g}", stiff, radius, 2.5)
    radius = PolytropicSimulator(stepping=Stepping(0.01, max_steps=10**6))(
        GEL, DESIGN, times(2.5)
    ).radius
    compare(
        "polytropic, LSODA, 1e-12",
        ScipySimulator(physics="polytropic", method="LSODA", rtol=1e-12, atol=1e-14),
        radius,
        2.5,
    )
    radius = TransportSimulator(accuracy=Accuracy(1e-7, Resolution(24, 28)))(
        GEL, DESIGN, times(1.5)
    ).radius
    grids = [Resolution(n, n, kind="finite_difference") for n in (20, 40, 80)] + [
        Resolution(80, 80, reach=2.0, kind="authors")
    ]
    for grid in grids:
        compare(
            f"{grid.kind}, {grid.inside} nodes",
            TransportSimulator(accuracy=Accuracy(1e-6, grid)),
            radius,
            1.5,
        )


if __name__ == "__main__":
    main()
