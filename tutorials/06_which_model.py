# %% [markdown]
# # Which model?
# You will be able to compare models by evidence, and say what their probabilities do not say. Takes about a minute on one core.
#
# Two questions are easily confused: which of my models do the data support, and is any of them right? Here we fit three
# constitutive models to the same curves, compare them by evidence, and read the small print.

# %%
import os

import torch

from imr_torch.assimilate import SearchOptions, assimilate, weigh
from imr_torch.material import PARAMETERS, wide_prior
from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
from imr_torch.select import evidences, probability_errors, update
from imr_torch.simulate import PolytropicSimulator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"

# %% [markdown]
# ## A gel that stiffens
# Three designs, one curve each. With your own files, make the experiments with `prepare` (tutorial 02) and use
# `TransportSimulator`, whose bubbles conduct heat and hold vapour.

# %%
simulator = PolytropicSimulator()
secret = PARAMETERS.pack({"G": 2500.0, "mu": 0.12, "alpha": 0.1})
laboratory = SimulatedLaboratory(
    simulator, secret, repeats=1, times=torch.linspace(0.0, 3.0, 61, dtype=torch.float64)
)
designs = torch.tensor([[300.0, 0.25], [800.0, 0.17], [500.0, 0.20]], dtype=torch.float64)[
    : 2 if SMOKE else 3
]
batch = ExperimentBatch(
    tuple(laboratory.shoot(design, seed=i) for i, design in enumerate(designs))
)

# %% [markdown]
# ## Fit, and ask each fit whether to believe it
# The *certificate* says whether the minimum was found, and found from two starts: without it no number below means anything.
# The *verdict* comes from draws weighted by the exact posterior: `trusted` (it is Gaussian), `repaired` (it is not, and mean
# and covariance are now those of the draws), or not to be trusted.

# %%
prior = wide_prior(("newtonian", "nhkv", "gen_qkv"))
options = SearchOptions(raw_samples=24, starts=2) if SMOKE else SearchOptions()
fits = weigh(
    assimilate(prior, batch, simulator, seed=0, options=options),
    simulator,
    seed=0,
    samples=64 if SMOKE else 256,
)
for fit in fits.fits:
    print(
        f"{fit.prior.material.title}: RMSE {fits.rmse(fit.model):.4f} in R*\n  {fit.certificate}\n  {fit.trust}"
    )

# %% [markdown]
# ## Model probabilities
# Evidence is the probability of all data under a model, averaged over its prior: a free parameter that is not needed costs.
# Probabilities are prior odds times evidence, once. The error is that of the computation.
#
# Evidence leans on the prior: make it wider and the larger model loses. How well each model predicts a curve that it did not
# see leans on it less: ArviZ leaves one curve out after the other (`imr_torch.export.to_arviz`).

# %%
found = evidences(fits)
posterior, errors = update(fits, found), probability_errors(prior, found)
for e in found:
    print(
        f"{e.model:10s} log evidence {e.value:9.2f} +- {e.error:.2f}  probability {posterior.probabilities[e.model]:.4f}"
    )
print(
    "errors of the probabilities:", {key: round(value, 4) for key, value in errors.items()}
)

# %% [markdown]
# ## Is any of them right?
# Probabilities add up to one, whatever the truth. So look at the residual: here it should be the camera's noise, and the
# RMSE some .02. On real gels ask `imr-torch diagnose` (tutorial 05), which tests for what is left.

# %%
best = posterior.best.model
assert fits[best].certificate.converged
print(
    f"{best}: RMSE by experiment",
    {k: round(v, 4) for k, v in fits.rmse_by_experiment(best).items()},
)
