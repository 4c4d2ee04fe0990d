# %% [markdown]
# # Two ways to fit: the most probable gel, and ensemble 4D-Var
# You will be able to choose between the two methods that fit a gel, and to say what each of them does to your intervals.
# Takes half a minute on one core.
#
# - **The default** (`SearchOptions`) looks for the most probable gel: Gauss-Newton steps from several starts, with slopes by
#   finite differences. Each fit carries a certificate: the gradient at its end, and whether two starts ended in one place.
# - **Hybrid ensemble 4D-Var** (`En4DVarOptions`) is the method of Spratt et al. (2021) and arXiv 2409.00011. An ensemble of
#   gels as wide as the posterior gives the slopes by regression, and moves as a whole; restarts widen it again.
#
# Both use the likelihood of all repeats and frames, the prior once, the same nuisances and models. `weigh` draws from the
# Gaussian that either found and weighs the draws by the exact posterior, so what is reported is the same if both found the
# same minimum.

# %%
import os

from imr_torch import example_gel, load_traces
from imr_torch.assimilate import (
    SearchOptions,
    assimilate,
    assimilate_en4dvar,
    weigh,
)
from imr_torch.material import PARAMETERS, wide_prior
from imr_torch.observe import ExperimentBatch, Noise, prepare
from imr_torch.simulate import PolytropicSimulator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"

# %% [markdown]
# ## Data
# The gel that ships with the project; its noise is a constant .003 in R*. Polytropic bubbles keep this quick. They lack thermal
# damping, so the values are not those of the gel.

# %%
simulator = PolytropicSimulator()
experiments = prepare(load_traces(example_gel())).experiments
batch = ExperimentBatch(
    experiments[:2] if SMOKE else experiments, Noise(scale=0.2, floor=0.015)
)
prior = wide_prior(("nhkv",))

# %% [markdown]
# ## Fit, and weigh

# %%
default = assimilate(
    prior,
    batch,
    simulator,
    seed=0,
    options=SearchOptions(raw_samples=48, starts=2) if SMOKE else None,
)
ensemble = assimilate_en4dvar(prior, batch, simulator, seed=0)


def tell(name, result):
    part = weigh(result, simulator, seed=1).fits[0].posterior
    words = []
    for parameter, mean, sd in zip(
        part.names, part.means.tolist(), part.sds.tolist(), strict=True
    ):
        entry = PARAMETERS[parameter]
        words.append(
            f"{entry.display_scale * mean:.4g} +- {entry.display_scale * sd:.2g} {entry.display_unit or entry.unit}"
        )
    print(f"{name:22s} {', '.join(words)}   ({result.fits[0].certificate})")
    return part


found = {"most probable gel": default, "ensemble 4D-Var": ensemble}
parts = [tell(name, result) for name, result in found.items()]
sds = parts[0].chol.norm(dim=1)
assert bool(((parts[0].mean - parts[1].mean).abs() < 0.5 * sds).all())

# %% [markdown]
# ## Which to use
# - The default, unless you have a reason: its certificate says whether the minimum was found, and its cost is exact.
# - Ensemble 4D-Var where curves are rough (frames next to collapses make many small local minima), since an ensemble averages
#   over them; or where you want the method of the literature, with the likelihood of the data.
# - Published results divide the misfit by the number of frames, which makes intervals several times too wide
#   (`07_is_it_calibrated.py` shows how to see that).
#
# Its step is also a function of tensors, `imr_torch.assimilate.analyse_ensemble`, for a loop of your own (page "Extend it").
#
# On the command line: `imr-torch characterize gel.csv --method en4dvar`, `imr-torch campaign ... --method en4dvar`.
