# %% [markdown]
# # Load your file
# You will be able to load files of your camera, whatever their columns are called, and get properties with intervals. Takes
# a minute and a half on one core.
#
# From the file your camera software wrote to properties with intervals. We load a CSV that ships with the project,
# then build files with the usual troubles and see what the loader says.

# %%
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from scipy.io import savemat

from imr_torch import example_gel
from imr_torch.assimilate import SearchOptions
from imr_torch.characterization import characterize, predictive_band
from imr_torch.errors import InputDataError
from imr_torch.material import wide_prior
from imr_torch.observe import KNOWN_LAYOUTS, Layout, find_landmarks, load_traces
from imr_torch.simulate import TransportSimulator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
OUT = Path(tempfile.mkdtemp()) if SMOKE else Path("out/02")
OUT.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## A CSV file
# Three columns: `experiment_id, time_s, radius_m`. A JSON file of the same name beside it may say more (R_inf, Rmax).
# The report tells what was read and what was left out; nothing is dropped in silence.

# %%
traces = load_traces(example_gel())
print(traces.report())

# %% [markdown]
# ## Landmarks
# The maximum radius lies between frames, so it is fitted; R_inf comes from the settled tail. Each has an uncertainty,
# and the fit of the gel knows about it.

# %%
marks = find_landmarks(traces["shot_2"])
print(
    f"Rmax {1e6 * marks.max_radius_m:.2f} +- {1e6 * marks.max_radius_sd_m:.2f} um ({marks.max_method})"
)
if marks.rest_radius_m is not None and marks.rest_radius_sd_m is not None:
    print(
        f"R_inf {1e6 * marks.rest_radius_m:.2f} +- {1e6 * marks.rest_radius_sd_m:.2f} um ({marks.rest_method})"
    )
print("first collapse at", f"{1e6 * marks.collapse_times_s[0]:.1f} us")

# %% [markdown]
# ## A MATLAB file of your own layout
# Name its variables and units once. Known layouts are recognised without.

# %%
time_us = np.arange(0.0, 200.0, 2.0)
radius_px = 100.0 * np.abs(np.cos(time_us / 30.0)) * np.exp(-time_us / 80.0) + 20.0
savemat(
    OUT / "mine.mat",
    {"Rpix": radius_px, "frames": np.arange(len(time_us)), "scale": 2.5e-6, "dt": 2e-6},
)
layout = Layout(
    "Rpix",
    radius_unit="px",
    time="frames",
    time_unit="frames",
    frame_interval="dt",
    pixel_size="scale",
)
print(load_traces(OUT / "mine.mat", layout=layout).report())
print("known layouts:", ", ".join(KNOWN_LAYOUTS))

# %% [markdown]
# Forgotten something? The message says what and how to mend it.

# %%
try:
    load_traces(
        OUT / "mine.mat", layout=Layout("Rpix", radius_unit="px", frame_interval="dt")
    )
except InputDataError as error:
    print("InputDataError:", error)

# %% [markdown]
# ## From curves to properties
# All curves are of one gel and are fitted together; every curve has its own errors of Rmax, time zero and R_inf. Bubbles
# have heat and vapour transport by default; `simulator=PolytropicSimulator()` gives a quick look, and a biased one.

# %%
prior = wide_prior(["nhkv"] if SMOKE else ["nhkv", "gen_qkv"])
options = SearchOptions(raw_samples=32, starts=2) if SMOKE else None
chosen = traces.select(["shot_1"]) if SMOKE else traces
result = characterize(chosen, prior=prior, estimate_noise=not SMOKE, options=options)
print(result.report())

# %%
# the prediction is drawn at times between the frames too, since the collapse is shorter than the distance of two frames
best, last = result.posterior.best.model, float(result.experiments[0].times.max())
times = torch.linspace(0.0, last, 60 if SMOKE else 500, dtype=torch.float64).expand(
    len(result.experiments), -1
)
draws = 10 if SMOKE else 100
band = predictive_band(
    result.assimilation,
    result.posterior,
    TransportSimulator(),
    best,
    draws=draws,
    times=times,
)
low, median, high = (quantile[0] for quantile in band)
figure, ax = plt.subplots()
ax.plot(result.experiments[0].times, result.experiments[0].radius.mT, ".", color="black")
ax.fill_between(times[0], low, high, alpha=0.3)
ax.plot(times[0], median)
ax.set(xlabel="t*", ylabel="R*")
figure.savefig(OUT / "fit.png")
