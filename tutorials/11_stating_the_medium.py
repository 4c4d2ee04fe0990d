# %% [markdown]
# # Stating the medium
# You will be able to state what you know of the liquid around the bubble, to see what a wrong value does to your answer,
# and to let the answer account for what you do not know. Takes some two minutes on one core.
#
# The bubble moves the gel, so its density matters; and the gel's stiffness holds the bubble back in much the same way.

# %%
import os
from dataclasses import replace

import matplotlib.pyplot as plt

from imr_torch import characterize, example_gel, load_traces, wide_prior
from imr_torch.assimilate import SearchOptions
from imr_torch.characterization import intervals
from imr_torch.drawing import MODEL, TRUTH
from imr_torch.observe import Statement, TraceSet, gel_medium

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
options = SearchOptions(raw_samples=32, starts=2) if SMOKE else None
traces = load_traces(example_gel()).select(["shot_1"] if SMOKE else ["shot_1", "shot_3"])
prior = wide_prior(["nhkv"])

# %% [markdown]
# ## Nothing stated
# The file beside the example gel states its medium; here that is left out. The density is then inferred beside the gel, from
# 1060 +- 30 kg/m^3, and the report begins with that. What else was assumed is named, with what other values would change.

# %%
silent = TraceSet(tuple(replace(t, given=replace(t.given, stated=None)) for t in traces))
assumed = characterize(silent, prior=prior, estimate_noise=False, options=options)
lines = assumed.report().splitlines()
print("\n".join(line for line in lines if "Not stated" in line or "assumed" in line))

# %% [markdown]
# ## A density that is 3 % higher
# Say that you weighted the gel: 1092 kg/m^3. The example gel was simulated with 1060 kg/m^3 and G = 8.31 kPa, so this is wrong.

# %%
heavier = characterize(
    traces, prior=prior, estimate_noise=False, options=options, medium="density=1092"
)
found = {}
for name, result in (("not stated", assumed), ("stated 1092", heavier)):
    found[name] = [1e-3 * x for x in intervals(result.posterior.best)["G"]]
    low, middle, high = found[name]
    print(f"{name}: G = {middle:.2f} kPa (90 %: {low:.2f} to {high:.2f})")

# %% [markdown]
# ## A density that is not well known
# With a standard deviation, here 20 kg/m^3, the density is inferred beside the gel, and the interval of G becomes as wide as
# is honest. The last line says what the curves have told about the density itself.

# %%
honest = characterize(
    traces, prior=prior, estimate_noise=False, options=options, medium="density=1070:20"
)
found["1070 +- 20"] = [1e-3 * x for x in intervals(honest.posterior.best)["G"]]
low, middle, high = found["1070 +- 20"]
print(f"1070 +- 20: G = {middle:.2f} kPa (90 %: {low:.2f} to {high:.2f})")
print(
    "\n".join(
        line.strip()
        for line in honest.report().splitlines()
        if "density was stated" in line
    )
)

# %%
figure, ax = plt.subplots(figsize=(5.2, 2.2), layout="constrained")
for row, (low, middle, high) in enumerate(found.values()):
    ax.plot([low, high], [row, row], color=MODEL)
    ax.plot(middle, row, "o", color=MODEL)
ax.axvline(8.31, color=TRUTH, linestyle="--", label="truth")
ax.set(
    yticks=range(len(found)),
    ylim=(len(found) - 0.5, -0.5),
    xlabel="G (kPa), 90 % interval",
    ylabel="density (kg/m$^3$)",
)
ax.set_yticklabels(found)
legend = ax.legend(frameon=False)

# %% [markdown]
# ## By name, and beside the file
# A name sets the properties that its source has; values after it replace single ones; the rest stays assumed. The same text
# works on the command line, `imr-torch characterize gel.csv --medium water,temperature=310`, and as an object in the JSON
# file beside a table: `{"medium": {"name": "water", "temperature": 310, "density": [1070, 20]}}`.

# %%
print(gel_medium(Statement.from_text("water,temperature=310,density=1070:20")).report())
