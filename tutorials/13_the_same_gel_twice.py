# %% [markdown]
# # The same gel twice
# You will be able to say whether shots of "one gel" are of one gel, how much the gel differs from shot to shot, and what a
# shot to come would have. Takes about half a minute on one core.
#
# Eight shots of one gel never give the same modulus. Is that the error of each shot, or does the gel differ from place to
# place? A population answers: every shot has its own gel, and all gels come from one distribution, whose median and
# scatter are inferred.

# %%
import os

import matplotlib.pyplot as plt
import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.drawing import MODEL, PALE, TRUTH
from imr_torch.material import PARAMETERS
from imr_torch.observe import SimulatedLaboratory
from imr_torch.population import fit_shots, infer_population
from imr_torch.random import generator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"

# %% [markdown]
# ## Two gels
# One is the same in every shot. The other differs: the standard deviation of the logarithm of G is 0.25, about 25 %.
# (Polytropic bubbles keep this short; take the default simulator for real gels.)

# %%
simulator = PolytropicSimulator()
prior = wide_prior(["nhkv"])["nhkv"]
count = 4 if SMOKE else 8
designs = torch.tensor(
    [[350.0 + 30.0 * number, 0.2] for number in range(count)], dtype=torch.float64
)


def shots_of(scatter):
    """Shots of gels whose log modulus scatters so, and the moduli."""
    moduli = 8000.0 * torch.exp(
        scatter * torch.randn(count, generator=generator(5), dtype=torch.float64)
    )
    shots = []
    for number, (design, modulus) in enumerate(
        zip(designs, moduli.tolist(), strict=True), start=1
    ):
        laboratory = SimulatedLaboratory(
            simulator, PARAMETERS.pack({"G": modulus, "mu": 0.09}), repeats=2
        )
        shots.append(laboratory.shoot(design, seed=number, label=f"shot {number}"))
    return shots, moduli


gels = {"one gel": shots_of(0.0), "a gel that differs": shots_of(0.25)}

# %% [markdown]
# ## Each shot, then the population
# `fit_shots` fits each shot by itself. `infer_population` needs no more bubbles: it weighs what the fits have said. The
# evidence compares scatter with none, in nats: above ln 10 = 2.3 the odds are ten to one for it, below -2.3 against it.

# %%
populations = {}
for name, (shots, _) in gels.items():
    fits = fit_shots(prior, shots, simulator, rounds=0, samples=64 if SMOKE else 256)
    populations[name] = found = infer_population(fits, draws=1024 if SMOKE else 8192)
    print(f"{name}: {found.sentence}")
    print(
        f"  evidence of any scatter {found.any_scatter}; of G {found.by_parameter['G']}; of mu {found.by_parameter['mu']}"
    )
    low, middle, high = found.scatter("G")
    print(f"  scatter of log G {middle:.2f} (90 %: {low:.2f} to {high:.2f})")
if not SMOKE:
    assert populations["one gel"].verdict != "scatter"
    assert populations["a gel that differs"].verdict == "scatter"

# %% [markdown]
# ## Look
# Grey, each shot alone; blue, given all shots. Where the gel is one, the shots draw together, because each tells about the
# others. Where it differs, they hardly move. The band is the median of the population, and the dotted lines hold 90 % of the
# gels of shots to come.

# %%
figure, axes = plt.subplots(
    1, 2, figsize=(8.0, 3.4), sharex=True, sharey=True, layout="constrained"
)
for ax, (name, found) in zip(axes, populations.items(), strict=True):
    low, middle, high = (1e-3 * x for x in found.median("G"))
    ax.axvspan(low, high, color=MODEL, alpha=0.15, linewidth=0)
    for end in (found.next_shot("G")[0], found.next_shot("G")[2]):
        ax.axvline(1e-3 * end, color=MODEL, linestyle=":")
    for row, label in enumerate(found.labels):
        alone, given_all = found.alone(label, "G"), found.shot(label, "G")
        ax.plot(
            [1e-3 * alone[0], 1e-3 * alone[2]],
            [row - 0.15] * 2,
            color=PALE,
            linewidth=3,
            label="alone",
        )
        ax.plot(
            [1e-3 * given_all[0], 1e-3 * given_all[2]],
            [row + 0.15] * 2,
            color=MODEL,
            label="given all",
        )
    ax.plot(
        1e-3 * gels[name][1], range(count), "|", color=TRUTH, markersize=14, label="truth"
    )
    ax.set(
        title=name,
        xlabel="G (kPa)",
        yticks=range(count),
        yticklabels=found.labels,
        ylim=(count - 0.5, -0.5),
    )
handles, labels = axes[0].get_legend_handles_labels()
unique = dict(zip(labels, handles, strict=True))
legend = figure.legend(
    unique.values(), unique.keys(), loc="outside lower center", ncols=3, frameon=False
)

# %% [markdown]
# ## With files
# `imr-torch characterize day1/ --population --html day1.html` does all of this, with the noise inferred. A parameter that
# follows the size of the bubble is named there as a likely error of the model: gels do not know how large a bubble will be.
