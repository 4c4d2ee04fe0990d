# %% [markdown]
# # Where does my model fail?
# You will be able to ask whether your model explains your curves, and which effect it may lack. Takes some five minutes on
# one core.
#
# A fit always returns numbers. Whether the model behind them is right is another question: refitting hides most of a missing
# effect in biased parameters. We keep an effect secret, let the diagnosis look for it, and then look at a file.

# %%
import os
import tempfile
from pathlib import Path

import torch

from imr_torch import example_gel
from imr_torch.gap import LIBRARY, describe, diagnose, examine, library, to_json
from imr_torch.gap.figures import plot_tests
from imr_torch.material import PARAMETERS
from imr_torch.observe import SimulatedLaboratory, load_traces, prepare
from imr_torch.results import write_page
from imr_torch.simulate import PolytropicSimulator, TransportSimulator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
OUT = Path(tempfile.mkdtemp()) if SMOKE else Path("out/05")
OUT.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## What may be missing
# The library holds effects of the gel, the gas, the liquid, the driving and the camera. Each has a value at which it does
# nothing, a prior, and a note on what it is easily mistaken for.

# %%
for effect in LIBRARY.values():
    print(f"{effect.place:12s} {effect.name:20s} {effect.meaning}")

# %% [markdown]
# ## A withheld effect
# Two designs, ten repeats each; the liquid's speed of sound is not what the base model takes it for. With real bubbles use
# the default simulator, which has heat and vapour transport; polytropic gas keeps this example short.

# %%
simulator = PolytropicSimulator()
secret = PARAMETERS.pack({"G": 8000.0, "mu": 0.08, "sound_speed": 0.5})
times = torch.linspace(0.0, 2.6, 53, dtype=torch.float64)
laboratory = SimulatedLaboratory(simulator, secret, repeats=10, times=times)
designs = torch.tensor([[200.0, 0.20], [600.0, 0.17], [400.0, 0.25]], dtype=torch.float64)[
    : 2 if SMOKE else 3
]
experiments = [laboratory.shoot(design, seed=i) for i, design in enumerate(designs)]
offered = library(("sound_speed", "rinf_bias", "strain_stiffening") if SMOKE else None)

report = diagnose(experiments, effects=offered, simulator=simulator)
parts = examine(report, simulator)
document = to_json(report, parts, simulator=simulator)
print(describe(document))

# %% [markdown]
# The page holds the same words with their figures; every figure can be drawn alone.

# %%
write_page(document, OUT / "withheld.html", title="A withheld effect")
plot_tests(document["tests"]).figure.savefig(OUT / "tests.png")

# %% [markdown]
# ## The effect is not in the library
# A closed list always names somebody. So the winner must also be adequate: the same tests at its own fit decide between a name
# and "other".

# %%
without = library(
    ("rinf_bias", "strain_stiffening", "refraction") if SMOKE else None,
    without=("sound_speed", "heat_exchange"),
)
blind = diagnose(experiments, effects=without, simulator=simulator)
print(blind.verdict, blind.cause, "-", blind.reason)

# %% [markdown]
# ## Your file
# Single curves have no repeats to take the noise from; it is inferred from how their frames scatter about the fit, in such a
# way that a misfit is not taken for noise. On the command line: `imr-torch diagnose example_gel.csv --html page.html`.
#
# The gel of this file was simulated without any effect, and no gap is found. A gap may come from the camera as well as from
# the gel: these films begin 0.3 us after the maximum, where the radius changes less than the noise, so the largest frame comes
# 1 to 3 us late in all four curves. Taken for time zero, it would be a gap, with `trigger_offset` as its cause; the maximum is
# fitted to the frames after it instead.

# %%
physics = PolytropicSimulator() if SMOKE else TransportSimulator()
traces = load_traces(example_gel())
curves = prepare(traces.select(["shot_1"]) if SMOKE else traces).experiments
offered = library(("rinf_bias", "clock", "heat_exchange")) if SMOKE else None
report = diagnose(curves, effects=offered, estimate_noise=True, simulator=physics)
print(f"noise {report.batch.noise}")
parts = examine(report, physics)
document = to_json(report, parts, simulator=physics)
print(describe(document))
write_page(document, OUT / "example_gel.html", title="Example gel")
print(
    {
        key: value
        for key, value in document.items()
        if key in ("gap", "p_gap", "verdict", "cause", "converged")
    }
)
