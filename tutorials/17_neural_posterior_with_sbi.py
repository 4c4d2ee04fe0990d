# %% [markdown]
# # A neural posterior with sbi
# You will be able to train a neural posterior on bubbles of this toolkit, compare it with the fit, and test both in the same
# way. Takes some two minutes on one core; needs the package `sbi` (`pip install sbi`).
#
# sbi learns the posterior from simulations, once for all data of one arrangement. That pays off where many curves of the same
# design and camera come in, and the prior stays the same.

# %%
import os

import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.assimilate import SearchOptions, assimilate
from imr_torch.calibration import Arrangement, calibrate, coverage, uniformity
from imr_torch.design import Plan
from imr_torch.export import sbi_simulator
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
from imr_torch.results.plot import plot_places

try:
    from sbi.inference import NPE
except ImportError:
    raise SystemExit(
        "This tutorial needs sbi: pip install sbi. Nothing else of the toolkit does."
    ) from None

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"

# %% [markdown]
# ## Prior and simulator
# `sbi_simulator` gives both in the form that sbi takes: float32, one draw of the noise for each row, rows of NaN for bubbles
# that could not be solved.

# %%
belief = wide_prior(["nhkv"])
part, bubbles = belief["nhkv"], PolytropicSimulator()
times = torch.linspace(0.0, 2.5, 51, dtype=torch.float64)
design = torch.tensor([400.0, 0.22], dtype=torch.float64)
prior, simulator = sbi_simulator(part, bubbles, design[None], times, seed=0)
torch.manual_seed(0)
theta = prior.sample((200 if SMOKE else 10000,))
x = simulator(theta)
print(
    theta.shape,
    x.shape,
    f"{int(torch.isnan(x).any(1).sum())} of {len(x)} could not be solved",
)

# %% [markdown]
# ## Train
# The network sees the logarithms: G and mu range over two decades. Draws are turned back below.

# %%
logs = theta.log()
scale = (logs.mean(0), logs.std(0))
inference = NPE(show_progress_bars=False)
inference.append_simulations((logs - scale[0]) / scale[1], x)
network = inference.train(max_num_epochs=3 if SMOKE else 200)
posterior = inference.build_posterior(network)


def draws(curve, number=2000):
    """Draws of G and mu, SI, given one curve."""
    found = posterior.sample((number,), x=curve.to(torch.float32), show_progress_bars=False)
    return (found * scale[1] + scale[0]).exp().double()


# %% [markdown]
# ## One curve, two answers

# %%
truth = {"G": 8000.0, "mu": 0.09}
plan = Plan(times=times, repeats=1, collapses=None)
laboratory = SimulatedLaboratory(bubbles, PARAMETERS.pack(truth), times=times, repeats=1)
experiment = laboratory.shoot(design, seed=1)
options = SearchOptions(raw_samples=32, starts=2) if SMOKE else None
fit = assimilate(
    belief,
    ExperimentBatch((experiment,), laboratory.noise),
    bubbles,
    seed=1,
    options=options,
)["nhkv"]
levels = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
neural, fitted = (
    draws(experiment.radius[0]).quantile(levels, 0),
    fit.posterior.quantile(levels.tolist()),
)
for column, name in enumerate(part.names):
    entry = PARAMETERS[name]
    print(f"{name} (truth {truth[name]:g} {entry.unit})")
    for who, found in (("fit", fitted), ("network", neural)):
        low, middle, high = found[:, column].tolist()
        print(f"  {who:8s} {middle:.4g} (90 %: {low:.4g} to {high:.4g})")

# %% [markdown]
# ## Is the network right?
# The test is the one of "Calibrate my own posterior". A network is an approximation; how good it is depends on the number of
# simulations.

# %%
arrangement = Arrangement(belief, designs=((400.0, 0.22),), plan=plan)


def by_network(batch, model, seed):
    """Draws given the curve of a batch."""
    torch.manual_seed(seed % 2**31)
    return draws(batch.mean[0], 400)


places = {}
replicates = list(
    calibrate(arrangement, bubbles, range(12 if SMOKE else 200), seed=0, infer=by_network)
)
for name in part.names:
    places[name] = [
        replicate.reported[name] for replicate in replicates if replicate.failure is None
    ]
    test, hold = uniformity(places[name]), coverage(places[name], 0.9)
    print(
        f"{name:2s} 90 % intervals hold {hold.share:.2f} of {test.count} truths ({hold.low:.2f} to {hold.high:.2f}); "
        f"spread {test.spread:.2f}, p {test.p:.2g}"
    )
ax = plot_places(places)

# %% [markdown]
# The fit needs no training, states its own convergence, and takes any design; the network answers in
# milliseconds. For a real gel, take `TransportSimulator` in place of `PolytropicSimulator`, and state `nuisance=` for what is
# not known exactly of Rmax, time zero and R_inf.
