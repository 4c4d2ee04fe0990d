# %% [markdown]
# # Calibrate my own posterior
# You will be able to test an inference that you have written yourself, or taken from elsewhere, on simulated gels. Takes about
# a minute on one core.
#
# An inference is a function from data to draws of the gel. If gels are drawn from the prior and shot in simulation, the truth
# must lie anywhere among the draws with equal chance. That holds for the exact posterior and for hardly anything
# else (simulation-based calibration, Talts et al. 2018).

# %%
import os

import torch

from imr_torch import PolytropicSimulator
from imr_torch.calibration import Arrangement, calibrate, coverage, uniformity
from imr_torch.design import Plan
from imr_torch.material import Belief, LogNormal
from imr_torch.observe import predict
from imr_torch.random import generator
from imr_torch.results.plot import plot_places

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"

# %% [markdown]
# ## The arrangement
# What is believed, what is shot, and how it is filmed: one curve of 51 frames, with the published law of noise. Frames are not
# cut at a collapse (`collapses=None`), so that every gel has the same ones.

# %%
prior = Belief.prior({"nhkv": {"G": LogNormal(8e3, 1.3), "mu": LogNormal(0.1, 1.3)}})
part = prior["nhkv"]
simulator = PolytropicSimulator()
plan = Plan(
    times=torch.linspace(0.0, 2.5, 51, dtype=torch.float64), repeats=1, collapses=None
)
arrangement = Arrangement(prior, designs=((400.0, 0.22),), plan=plan)
count = 12 if SMOKE else 200

# %% [markdown]
# ## My inference
# As an example, the simplest that is right if gels abound: many gels of the prior are simulated once, each is weighted with
# the likelihood of the data, and draws are taken with these weights. `batch` holds the data, its noise and designs;
# `simulate` is the film that they share.

# %%
library = part.controls(512 if SMOKE else 20000, seed=2)
curves = {}


def likelihood(batch):
    """Log likelihood of every gel of the library."""
    if not curves:
        curves["all"] = predict(simulator, part.parameters(library), batch)
    predicted = curves["all"]
    sd = batch.noise.sd(predicted, batch.times)
    residual = (batch.mean - predicted) / sd
    each = torch.where(batch.mask, -0.5 * residual.square() - sd.log(), 0.0)
    return each.flatten(1).sum(1).nan_to_num(-torch.inf)


def resampled(batch, model, seed):
    """400 draws of G and mu with the weights of the likelihood."""
    weights = torch.softmax(likelihood(batch), 0)
    picked = torch.multinomial(weights, 400, replacement=True, generator=generator(seed))
    return part.physical(library[picked])


# %% [markdown]
# ## And one with a mistake
# The same, but every frame is taken to be worth two, as if neighbouring frames were repeated. It is an easy slip, and the
# curves look just as good.


# %%
def overconfident(batch, model, seed):
    """The same with the likelihood squared."""
    weights = torch.softmax(2.0 * likelihood(batch), 0)
    picked = torch.multinomial(weights, 400, replacement=True, generator=generator(seed))
    return part.physical(library[picked])


# %% [markdown]
# ## The test
# `spread` is 1 if the intervals are right, larger if they are too narrow. The p-value is small if the places of the truths are
# not uniform.

# %%
places = {}
for infer in (resampled, overconfident):
    replicates = list(calibrate(arrangement, simulator, range(count), seed=0, infer=infer))
    for name in part.names:
        found = [replicate.reported[name] for replicate in replicates]
        test, hold = uniformity(found), coverage(found, 0.9)
        places[f"{infer.__name__}, {name}"] = found
        print(
            f"{infer.__name__:13s} {name:2s}: 90 % intervals hold {hold.share:.2f} of {test.count} truths "
            f"({hold.low:.2f} to {hold.high:.2f}), spread {test.spread:.2f}, p {test.p:.2g}"
        )

# %% [markdown]
# ## Look
# Each line is the share of truths below a place, less the place itself. Inside the band all is well. A slope as an S
# means intervals that are too narrow.

# %%
ax = plot_places(places)

# %% [markdown]
# With a prior that is ten times as wide, the same library has too few gels where the data are, and `resampled` fails the
# test too. Try it: a test for your prior, design and camera is worth more than a proof for others.
#
# The function may hold anything: a chain of your own, a network from sbi, or a call of other software. A test with few
# replicates cannot see small errors: the interval behind the share says what it could not have seen.
