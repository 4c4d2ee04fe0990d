# %% [markdown]
# # From a folder of shots to a table
# You will be able to characterise a whole day of shots with one call, resume it after an interruption, and continue with
# the table in the tool you like. Takes about a minute on one core.

# %%
import csv
import os
import shutil
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.characterization.batch import BatchOptions, run_batch
from imr_torch.material import PARAMETERS
from imr_torch.random import generator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
HOME = Path(tempfile.mkdtemp())

# %% [markdown]
# ## A folder of shots
# We make one, as a camera would store it: a file a shot, times in microseconds and radii in micrometres. The gel gets
# stiffer from shot to shot, as one that ages. One file is damaged.

# %%
simulator = PolytropicSimulator()
surroundings = simulator.conditions.surroundings
shots = 3 if SMOKE else 8
modulus = torch.linspace(4000.0, 9000.0, shots, dtype=torch.float64)
noise = generator(3)
day = HOME / "day1"
day.mkdir()
for number in range(shots):
    largest = 250e-6 + 15e-6 * number
    scale = float(surroundings.time_scale(largest))
    times = torch.arange(0.0, 2.8 * scale, 1e-6, dtype=torch.float64)
    gel = PARAMETERS.pack({"G": modulus[number], "mu": 0.1})
    design = torch.tensor([float(surroundings.weber(largest)), 0.2], dtype=torch.float64)
    radius = simulator(gel[None], design, times / scale).radius[0]
    radius = radius + 0.003 * torch.randn(len(times), generator=noise, dtype=torch.float64)
    lines = [
        f"{1e6 * t:.2f},{1e6 * largest * r:.3f}"
        for t, r in zip(times.tolist(), radius.tolist(), strict=True)
    ]
    (day / f"shot_{number + 1}.csv").write_text("time (us),R (um)\n" + "\n".join(lines))
(day / "shot_9.csv").write_text("time (us),R (um)\n0,250\n1,oops\n")
print(sorted(path.name for path in day.iterdir()))

# %% [markdown]
# ## One call
# Every file by itself. The films are too short for a settled tail, so the rest radius is stated with its error. On the
# command line: `imr-torch batch day1/ --out results --rest-radius 0.2:0.01`. (Polytropic bubbles keep this short; take the
# default for real gels.)

# %%
options = BatchOptions(
    wide_prior(["nhkv"]), simulator, rest_radius=(0.2, 0.01), estimate_noise=False
)
summary = run_batch(day, folder=HOME / "results", options=options)
print(summary.report())

# %% [markdown]
# The damaged file has cost only itself; the reason stands in the report and the table. The same call again computes only
# what is missing: mend the file, and run it again.

# %%
shutil.copy(day / "shot_1.csv", day / "shot_9.csv")
again = run_batch(day, folder=HOME / "results", options=options)
print(again.report().splitlines()[0])

# %% [markdown]
# ## The table

# %%
with (HOME / "results" / "summary.csv").open(newline="") as stream:
    rows = list(csv.DictReader(stream))
print(", ".join(rows[0]))

# %% [markdown]
# Modulus by shot, with 90 % intervals, and the truth. Shot 9 is a copy of shot 1.

# %%
low, middle, high = (
    [1e-3 * float(row[name]) for row in rows] for name in ("G_low", "G", "G_high")
)
errors = [
    [m - a for m, a in zip(middle, low, strict=True)],
    [b - m for m, b in zip(middle, high, strict=True)],
]
figure, ax = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
ax.errorbar(
    [row["shot"] for row in rows],
    middle,
    errors,
    fmt="o",
    color="#0072B2",
    label="inferred, 90 %",
)
ax.plot(
    [f"shot_{number + 1}" for number in range(shots)],
    1e-3 * modulus,
    "_",
    color="#D55E00",
    markersize=14,
    label="truth",
)
ax.set_ylabel("G (kPa)")
ax.set_ylim(0.0, None)
ax.tick_params(axis="x", rotation=45)
legend = ax.legend(frameon=False, loc="lower right")
