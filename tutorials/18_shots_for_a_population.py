# %% [markdown]
# # Shots for a population
# You will be able to run a campaign about a gel that differs from shot to shot: where to shoot next, what is known of the
# median and of the scatter after each shot, and when to stop. Takes about half a minute on one core.
#
# Where every shot has a gel of its own, more curves of one shot do not help: what is unknown is the population. So each
# shot is inferred by itself, the population from all of them, and the next design is the one from which most is
# expected to be learnt about the population's median and scatter.

# %%
import math
import os
import tempfile

import matplotlib.pyplot as plt
import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.campaign import (
    AnyOf,
    Campaign,
    CampaignSettings,
    Designs,
    GainBelow,
    LearnPopulation,
    PopulationLearner,
)
from imr_torch.design import Plan
from imr_torch.drawing import MODEL, PALE, TRUTH
from imr_torch.material import PARAMETERS
from imr_torch.observe import Noise, SimulatedLaboratory
from imr_torch.random import child, generator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
HOME = tempfile.mkdtemp()

# %% [markdown]
# ## The secret
# The median gel has G = 8 kPa and mu = 0.09 Pa s; from shot to shot G scatters by 20 % and mu by 10 %. Each shot is one curve.

# %%
simulator = PolytropicSimulator()
noise = Noise(scale=0.5)
MEDIAN, SCATTER = {"G": 8000.0, "mu": 0.09}, {"G": 0.2, "mu": 0.1}


def shoot(design, number):
    """One curve of a gel from the population."""
    source = generator(child(2, "gel", number))
    gel = {
        name: MEDIAN[name] * math.exp(SCATTER[name] * float(torch.randn((), generator=source)))
        for name in MEDIAN
    }
    laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(gel), noise=noise, repeats=1)
    return laboratory.shoot(design, seed=child(2, "noise", number), label=f"shot {number}")


# %% [markdown]
# ## The campaign
# The learner fits every shot and infers the population; the policy asks for the shot that tells most of it. It stops after
# eight shots, or where another shot is expected to tell less than .1 nats.

# %%
learner = PopulationLearner(samples=64 if SMOKE else 256)
stop = AnyOf((Designs(2 if SMOKE else 8), GainBelow(0.1)))
settings = CampaignSettings(
    plan=Plan(repeats=1, noise=noise), policy=LearnPopulation(), learner=learner, stop=stop
)
campaign = Campaign(HOME, wide_prior(["nhkv"]), simulator, settings=settings, seed=1)

# %%
history = []
while not (reason := campaign.reason_to_stop()):
    number = len(campaign.steps) + 1
    proposal = campaign.ask()
    step = campaign.tell(shoot(proposal.design, number))
    if step.population is None:
        print(f"{number}. We {proposal.design[0]:.0f}: one shot says nothing about a scatter")
        continue
    found = step.population["parameters"]
    history.append((number, found))
    words = [
        f"{name} {found[name]['median'][1]:.3g}, scatter {found[name]['scatter'][1]:.2f}"
        f" ({found[name]['scatter'][0]:.2f} to {found[name]['scatter'][2]:.2f})"
        for name in MEDIAN
    ]
    print(
        f"{number}. We {proposal.design[0]:.0f}, R_inf* {proposal.design[1]:.3f}: {'; '.join(words)}"
    )
print(f"stop: {reason}")

# %% [markdown]
# ## Look
# Bands hold 90 %; the dashed lines are the truth. The scatter of the gels limits what is known of the median: with a
# standard deviation of 20 % from shot to shot, the median of eight shots has one of 20 %/sqrt(8) = 7 %, even if each shot
# showed its gel without error. The scatter itself takes more shots still, since each of them is one draw from the population.

# %%
figure, axes = plt.subplots(2, 2, figsize=(7, 4.6), layout="constrained", sharex=True)
shots = [number for number, _ in history]
for column, name in enumerate(MEDIAN):
    for row, (what, truth) in enumerate((("median", MEDIAN[name]), ("scatter", SCATTER[name]))):
        low, middle, high = zip(*(found[name][what] for _, found in history), strict=True)
        axes[row, column].fill_between(shots, low, high, color=PALE)
        axes[row, column].plot(shots, middle, "o-", color=MODEL, ms=4)
        axes[row, column].axhline(truth, color=TRUTH, ls="--")
        label = (
            f"median of {name} ({PARAMETERS[name].unit})"
            if what == "median"
            else f"scatter of ln {name}"
        )
        axes[row, column].set_ylabel(label)
    axes[1, column].set_xlabel("shots")

# %% [markdown]
# ## The next gel
# What would the next shot have? The interval holds the uncertainty of the population and its scatter.

# %%
for name, entry in (history[-1][1] if history else {}).items():
    low, middle, high = entry["next_shot"]
    print(
        f"{name} of the next shot: {middle:.3g} (90 %: {low:.3g} to {high:.3g}) {PARAMETERS[name].unit}"
    )

# %% [markdown]
# ## With your laboratory
# `imr-torch campaign --goal population --models nhkv --out gels` says what to shoot; `--resume --tell shot1.csv` tells it the
# result. Whether shots that you have already differ is asked by `imr-torch characterize day1/ --population`.
