"""How often a solve fails over a box far wider than any gel, and why.

  python benchmarks/robustness.py [--draws 10000] [--seed 0] [--json OUT]

Draws are uniform over We 50-2000, R_inf* .08-.5, G 0-300 kPa, mu 0-1 Pa s, alpha -.3 to 3, integrated to t* = 4. Failures are
counted by status, apart for gels whose strain energy is bounded (alpha >= 0) and for the others.
"""

import argparse
import json
import time

import torch

from imr_torch.files import write_json
from imr_torch.material import PARAMETERS
from imr_torch.random import generator
from imr_torch.simulate import PolytropicSimulator, Status, TransportSimulator

BOX = {"weber": (50.0, 2000.0), "rest": (0.08, 0.5), "G": (0.0, 3e5), "mu": (0.0, 1.0), "alpha": (-0.3, 3.0)}


def main() -> None:
    """Draw, solve, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=10000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="OUT")
    args = parser.parse_args()
    torch.set_num_threads(1)
    unit = torch.rand(args.draws, len(BOX), generator=generator(args.seed), dtype=torch.float64)
    columns = {name: low + (high - low) * u for (name, (low, high)), u in zip(BOX.items(), unit.T, strict=True)}
    designs = torch.stack((columns.pop("weber"), columns.pop("rest")), 1)
    gels = PARAMETERS.pack(columns)
    times = torch.linspace(0.0, 4.0, 81, dtype=torch.float64)
    result = {}
    for simulator in (PolytropicSimulator(), TransportSimulator()):
        start = time.process_time()
        status = torch.cat([simulator(g, d, times).status for g, d in zip(gels.split(1000), designs.split(1000), strict=True)])
        bounded = columns["alpha"] >= 0.0
        counts = {
            f"{kind.name}, {where}": int(((status == kind) & mask).sum())
            for kind in Status
            for where, mask in (("alpha >= 0", bounded), ("alpha < 0", ~bounded))
        }
        result[type(simulator).__name__] = {
            "seconds": time.process_time() - start,
            "draws with alpha >= 0": int(bounded.sum()),
            **{name: count for name, count in counts.items() if count},
        }
        print(json.dumps({type(simulator).__name__: result[type(simulator).__name__]}, indent=1), flush=True)
    if args.json:
        write_json(args.json, result)


if __name__ == "__main__":
    main()
