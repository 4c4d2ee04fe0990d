"""Makes ``example_gel.csv`` and ``example_gel.json``: four noisy bubbles in a known gel, as a laboratory would store them.

NHKV with G = 8.31 kPa and mu = 0.093 Pa s, heat and vapour transport, 1 us between frames, 0.3 % noise, Rmax from 250 to
400 um. The records end while the bubbles still ring; R_inf was measured afterwards and stands in the JSON file.
"""

import csv

import torch

from imr_torch import example_gel
from imr_torch.files import write_json
from imr_torch.material import PARAMETERS
from imr_torch.random import generator
from imr_torch.simulate import ACCURACIES, TransportSimulator

FOLDER = example_gel().parent
simulator = TransportSimulator(accuracy=ACCURACIES["reference"])
surroundings = simulator.conditions.surroundings
gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})
source = generator(7)
measured = []
with (FOLDER / "example_gel.csv").open("w", newline="") as stream:
    table = csv.writer(stream)
    table.writerow(["experiment_id", "time_s", "radius_m"])
    for number, (max_radius, rest) in enumerate(
        [(250e-6, 0.17), (300e-6, 0.21), (350e-6, 0.19), (400e-6, 0.23)], start=1
    ):
        scale = float(surroundings.time_scale(max_radius))
        times = torch.arange(0.3e-6, 2.6 * scale, 1e-6, dtype=torch.float64)
        design = torch.tensor([surroundings.weber(max_radius), rest], dtype=torch.float64)
        solution = simulator(gel, design, times / scale)
        noise = 0.003 * torch.randn(len(times), generator=source, dtype=torch.float64)
        for time, radius in zip(
            times.tolist(), (max_radius * (solution.radius + noise)).tolist(), strict=True
        ):
            table.writerow([f"shot_{number}", f"{time:.4e}", f"{radius:.5e}"])
        error = 1.0 + 0.01 * float(torch.randn((), generator=source, dtype=torch.float64))
        entry = {
            "experiment_id": f"shot_{number}",
            "Rinf_m": error * rest * max_radius,
            "Rinf_settled": True,
        }
        measured.append(entry | {"Rinf_tail_std_m": 0.01 * rest * max_radius})
write_json(
    FOLDER / "example_gel.json", {"material": "synthetic NHKV gel", "experiments": measured}
)
