# %% [markdown]
# # Is it calibrated?
# You will be able to test on simulated gels whether reported intervals hold the truth as often as they say. Takes some two
# minutes on one core.
#
# A 90 % interval should hold the truth nine times in ten, and a model given 70 % should be the right one seven times in ten.
# For your own prior, design, camera and simulator that can be tried before the first shot: draw gels from the prior, shoot
# them in simulation, infer, and look where the truths came to lie.

# %%
import os
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from scipy.stats import binomtest

from imr_torch.assimilate import SearchOptions
from imr_torch.calibration import Arrangement, calibrate, coverage, uniformity
from imr_torch.design import Plan
from imr_torch.material import reference_case
from imr_torch.observe import ExperimentBatch, Noise
from imr_torch.results.plot import plot_places
from imr_torch.simulate import PolytropicSimulator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
OUT = Path(tempfile.mkdtemp()) if SMOKE else Path("out/07")
OUT.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## Your arrangement
# What you believe, what you will shoot, and how you will film it. Each replicate is one gel: drawn, shot and inferred.

# %%
plan = Plan(times=torch.linspace(0.0, 2.5, 51, dtype=torch.float64), repeats=5)
options = SearchOptions(raw_samples=24, starts=2) if SMOKE else SearchOptions()
mine = Arrangement(
    reference_case("soft-pa").prior,
    ((400.0, 0.22),),
    plan,
    samples=64 if SMOKE else 256,
    options=options,
)
count = 10 if SMOKE else 100
replicates = list(calibrate(mine, PolytropicSimulator(), range(count), seed=0))

# %% [markdown]
# ## Where the truths lie
# The place of the truth in its posterior is uniform if all is well. `spread` says most: above 1 the intervals are too
# narrow, below 1 too wide. With few replicates chance leaves much open, and the intervals and p-values say how much.


# %%
def judge(replicates):
    for name in ("G", "mu"):
        places = [r.reported[name] for r in replicates if r.failure is None]
        test, hold = uniformity(places), coverage(places, 0.9)
        print(
            f"{name:3s} 90 % intervals hold {hold.share:.2f} of {test.count} truths ({hold.low:.2f} to {hold.high:.2f}); "
            f"spread {test.spread:.2f}, p {test.p:.3g}"
        )
    return {
        name: [r.reported[name] for r in replicates if r.failure is None]
        for name in ("G", "mu")
    }


plot_places(judge(replicates)).figure.savefig(OUT / "places.png")

# %% [markdown]
# ## Whether probabilities mean what they say

# %%
stated = np.array([r.probabilities["nhkv"] for r in replicates if r.failure is None])
right = np.array([r.model == "nhkv" for r in replicates if r.failure is None])
gap = ((right - stated) * (1.0 - 2.0 * stated)).sum()  # Spiegelhalter, Stat. Med. 5 (1986)
sd = ((1.0 - 2.0 * stated) ** 2 * stated * (1.0 - stated)).sum() ** 0.5
print(
    f"Spiegelhalter's z {gap / sd:.2f}: beyond 2 in one of twenty where probabilities are right"
)
figure, ax = plt.subplots()
ax.plot((0, 1), (0, 1), color="grey")
bins = np.minimum((5 * stated).astype(int), 4)
for place in np.unique(bins):
    own = bins == place
    ends = binomtest(int(right[own].sum()), int(own.sum())).proportion_ci()
    ax.vlines(stated[own].mean(), ends.low, ends.high)
    ax.plot(stated[own].mean(), right[own].mean(), "o", color="C0")
ax.set(xlabel="stated probability", ylabel="share that came true")
figure.savefig(OUT / "reliability.png")

# %% [markdown]
# ## And when it is not
# Suppose the camera is noisier than you think. The same gels, inferred with half the noise: the intervals are too narrow, and
# the test says so. Before you trust a result, make sure that your check could have failed.

# %%
sure = replace(
    mine, learn=lambda experiments: ExperimentBatch(experiments, Noise(scale=0.5))
)
places = judge(list(calibrate(sure, PolytropicSimulator(), range(count), seed=0)))
