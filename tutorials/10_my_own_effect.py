# %% [markdown]
# # An effect of my own
# You will be able to write down what you think your model lacks, ask the data whether it acts, and let a diagnosis decide
# between it and the effects of the library. Takes about a minute on one core.
#
# An effect is a parameter that every model leaves at zero, where it does nothing, and a law that says what it does
# otherwise. As an example: the laser has heated the liquid around the bubble, so the far-field pressure is higher at first, and
# the excess fades. (The library has a constant far-field pressure, a sound field and a pulse, but nothing that fades.)

# %%
import os

import matplotlib.pyplot as plt
import torch

from imr_torch.assimilate import SearchOptions, assimilate
from imr_torch.elementary import Scalar, exp
from imr_torch.gap import describe, diagnose, examine, to_json
from imr_torch.material import (
    PARAMETERS,
    Effect,
    Parameter,
    TruncatedNormal,
    library,
    register_effect,
    wide_prior,
)
from imr_torch.observe import ExperimentBatch, Film, SimulatedLaboratory, predict
from imr_torch.simulate import PolytropicSimulator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"

# %% [markdown]
# ## The parameter
# Name, meaning, unit, how it is made dimensionless (here it is a pure number), bounds, the value at which it does nothing,
# and what is believed of it: 3 % of an atmosphere is one standard deviation.

# %%
prior = TruncatedNormal(0.0, 0.03)
parameter = PARAMETERS.register(
    Parameter(
        "fading_pressure",
        "far-field pressure beyond p_inf at time zero, over p_inf",
        "1",
        "none",
        -0.5,
        0.5,
        0.0,
        prior=prior,
    )
)


# %% [markdown]
# ## The law
# `far_field` laws give the excess of the far-field pressure over $p_\infty$ at a dimensionless time, and its first two
# derivatives. Written with `imr_torch.elementary`, a law runs on tensors and is compiled for numbers. Other laws of an
# effect change the setting of a bubble (`setting`), the vapour pressure (`vapour`) or the amount of gas (`gas_loss`).


# %%
def fading(time: Scalar, excess: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """An excess pressure that falls to 1/e within Rmax/U_c."""
    value = excess * exp(-time)
    return value, -value, value


# %% [markdown]
# ## The effect
# What a diagnosis needs of it: a name, a phrase, where it acts, its parameters with their priors, and its law.

# %%
effect = register_effect(
    Effect(
        "fading_pressure",
        "the far-field pressure is higher at first and fades",
        "liquid",
        {"fading_pressure": prior},
        far_field=fading,
    )
)

# %% [markdown]
# ## What it does to R(t)

# %%
simulator = PolytropicSimulator()
design = torch.tensor([450.0, 0.20], dtype=torch.float64)
times = torch.linspace(0.0, 3.0, 301, dtype=torch.float64)
sizes = [0.0, 0.05, 0.1]
gels = PARAMETERS.pack(
    {"G": 5000.0, "mu": 0.1, "fading_pressure": torch.tensor(sizes, dtype=torch.float64)}
)
figure, ax = plt.subplots(layout="constrained")
ax.plot(
    times,
    simulator(gels, design, times).radius.T,
    label=[f"{100 * size:g} % of p_inf" for size in sizes],
)
ax.set(xlabel="t*", ylabel="R*", ylim=(0.0, None))
_ = ax.legend()

# %% [markdown]
# Check the sign before you believe a law: a higher pressure makes the bubble collapse earlier.

# %%
film = Film(design[None], times[None])
radius = predict(simulator, gels, film)[:, 0]
first = [float(times[int(row[:150].argmin())]) for row in radius]
print("first collapse at t* =", first)
assert first[2] < first[1] < first[0]

# %% [markdown]
# ## Would a diagnosis find it?
# We make data that have it, of two designs with ten repeats each, and let a diagnosis choose among it and some effects of
# the library. The base model is fitted first: it hides as much of the effect in G and mu as it can.

# %%
truth = PARAMETERS.pack({"G": 5000.0, "mu": 0.1, "fading_pressure": 0.05})
laboratory = SimulatedLaboratory(simulator, truth, repeats=10)
designs = torch.tensor([[300.0, 0.18], [650.0, 0.22]], dtype=torch.float64)
experiments = tuple(
    laboratory.shoot(row, seed=number) for number, row in enumerate(designs, start=1)
)
rivals = ("fading_pressure", "far_field_pressure", "sound_speed") + (
    () if SMOKE else ("heat_exchange", "rinf_bias", "wall")
)
report = diagnose(experiments, effects=library(rivals), simulator=simulator, seed=0)
print(describe(to_json(report, examine(report, simulator, seed=0))))

# %% [markdown]
# ## And in a fit
# `nhkv+fading_pressure` is a model like any other, in every Python program that has imported this file before.

# %%
batch = ExperimentBatch(experiments, laboratory.noise)
options = SearchOptions(raw_samples=32, starts=2) if SMOKE else None
for model in ("nhkv", "nhkv+fading_pressure"):
    fit = assimilate(wide_prior([model]), batch, simulator, seed=1, options=options)[model]
    print(
        model,
        {
            name: round(float(x), 4)
            for name, x in zip(fit.posterior.names, fit.posterior.means, strict=True)
        },
    )
