# %% [markdown]
# # Stating the medium
# You will be able to state what you know of the liquid around the bubble, to see what a wrong value does to your answer,
# and to let the answer account for what you do not know. Takes some two minutes on one core.
#
# The bubble moves the gel, so its density matters; and the gel's stiffness holds the bubble back in much the same way.

# %%
import os

from imr_torch import characterize, example_gel, load_traces, wide_prior
from imr_torch.assimilate import SearchOptions
from imr_torch.characterization import intervals
from imr_torch.observe import Statement

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
options = SearchOptions(scouts=32, starts=2) if SMOKE else None
traces = load_traces(example_gel()).select(["shot_1"] if SMOKE else ["shot_1", "shot_3"])
prior = wide_prior(["nhkv"])

# %% [markdown]
# ## Nothing stated
# The report says what was assumed, and what other values would have changed.

# %%
assumed = characterize(traces, prior=prior, estimate_noise=False, options=options)
print("\n".join(line for line in assumed.report().splitlines() if "assumed" in line))

# %% [markdown]
# ## A density that is 3 % higher
# Say that you weighed the gel: 1092 kg/m^3. The example gel was simulated with 1060, so this is wrong; look at G.

# %%
heavier = characterize(traces, prior=prior, estimate_noise=False, options=options, medium="density=1092")
for name, result in (("assumed 1060", assumed), ("stated 1092", heavier)):
    low, middle, high = (1e-3 * x for x in intervals(result.posterior.best)["G"])
    print(f"{name} kg/m^3: G = {middle:.2f} kPa (90 %: {low:.2f} to {high:.2f}); the truth is 8.31")

# %% [markdown]
# ## A density that is not well known
# With a standard deviation, here 20 kg/m^3, the density is inferred beside the gel. The interval of G becomes as wide as is
# honest. The
# line after it says what the curves have told about the density itself.

# %%
honest = characterize(traces, prior=prior, estimate_noise=False, options=options, medium="density=1070:20")
low, middle, high = (1e-3 * x for x in intervals(honest.posterior.best)["G"])
print(f"density 1070 +- 20: G = {middle:.2f} kPa (90 %: {low:.2f} to {high:.2f})")
print("\n".join(line for line in honest.report().splitlines() if "density" in line))

# %% [markdown]
# ## By name, and beside the file
# Names set all properties, with sources; values after a name replace single ones. The same text works on the command line,
# `imr-torch characterize gel.csv --medium water,temperature=310`, and as an object in the JSON file beside a table:
# `{"medium": {"name": "water", "temperature": 310, "density": [1070, 20]}}`.

# %%
statement = Statement.from_text("water,temperature=310,density=1070:20")
for name, (value, sd) in statement.values.items():
    print(f"{name}: {value:.6g}" + ("" if sd is None else f" +- {sd:g}"))
