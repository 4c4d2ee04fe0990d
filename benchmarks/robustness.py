"""How often a solve fails over a box far wider than any gel, by model, and how long the slowest
draw takes.

  python benchmarks/robustness.py [--draws 10000] [--seed 0] [--json OUT]

Draws are shared among all registered models, uniform over We 50-2000, R_inf* .08-.5 and the
parameters of the model in ``BOX``, integrated to t* = 4, one after the other. Failures are counted
by status, apart for gels whose strain energy has no lower bound (alpha < 0).
"""

import argparse
import json
import time

import torch

from imr_torch.files import write_json
from imr_torch.material import MATERIALS, PARAMETERS
from imr_torch.random import child, generator
from imr_torch.simulate import PolytropicSimulator, Status, TransportSimulator

DESIGNS = ((50.0, 2000.0), (0.08, 0.5))
BOX = {
    "G": (0.0, 3e5),
    "mu": (0.0, 1.0),
    "alpha": (-0.3, 3.0),
    "G_lin": (0.0, 3e5),
    "alpha_fung2": (0.0, 1.0),
    "alpha_fung": (0.0, 0.2),
    "thinning": (0.0, 1.0),
    "shear_time": (0.0, 1e-4),
    "tau": (0.0, 1e-4),
    "retardation": (0.0, 1.0),
    "tau_sls": (0.0, 1e-4),
    "tau_sns": (0.0, 1e-4),
    "tau_ucm": (0.0, 1e-4),
}


def draws(model: str, count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Parameters ``count x p`` and designs ``count x 2`` of one model."""
    names = MATERIALS[model].names
    box = torch.tensor([*DESIGNS, *(BOX[name] for name in names)], dtype=torch.float64)
    unit = torch.rand(count, len(box), generator=generator(child(seed, model)), dtype=torch.float64)
    values = box[:, 0] + (box[:, 1] - box[:, 0]) * unit
    return PARAMETERS.pack(dict(zip(names, values[:, 2:].T, strict=True))), values[:, :2]


def main() -> None:
    """Draw, solve, count."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=10000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="OUT")
    args = parser.parse_args()
    torch.set_num_threads(1)
    times = torch.linspace(0.0, 4.0, 81, dtype=torch.float64)
    result = {}
    for simulator in (PolytropicSimulator(threads=1), TransportSimulator(threads=1)):
        kind = type(simulator).__name__
        slowest = 0.0
        total = 0.0
        failures = {}
        for model in MATERIALS:
            gels, designs = draws(model, args.draws // len(MATERIALS), args.seed)
            for gel, design in zip(gels, designs, strict=True):
                start = time.process_time()
                status = Status(int(simulator(gel, design, times).status))
                taken = time.process_time() - start
                slowest = max(slowest, taken)
                total = total + taken
                if status != Status.DONE:
                    label = f"{model}, {status.name}"
                    failures[label] = failures.get(label, 0) + 1
        result[kind] = {"seconds": total, "slowest_s": slowest, "failures": failures}
        print(json.dumps({kind: result[kind]}, indent=1), flush=True)
    if args.json:
        write_json(args.json, result)


if __name__ == "__main__":
    main()
