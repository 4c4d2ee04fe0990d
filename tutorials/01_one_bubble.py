# %% [markdown]
# # One bubble
# You will be able to simulate bubbles in any gel of the catalogue and plot R(t). Takes some seconds on one core.
#
# A laser makes a bubble in a gel; it collapses and rebounds. Here we simulate it, see what each property of the gel
# does to the curve, and learn the four objects that everything else is made of: parameters, designs, times, solution.
#
# The notebook and the script of the same name hold the same cells.

# %%
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from imr_torch.material import MATERIALS, PARAMETERS
from imr_torch.simulate import STEPPINGS, PolytropicSimulator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
OUT = Path(tempfile.mkdtemp()) if SMOKE else Path("out/01")
OUT.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The gel
# All constitutive models share one parameter vector. What a model does not use stays at its neutral value, where it
# does nothing. Values are in SI units.

# %%
for model in MATERIALS.values():
    print(f"{model.title:22s} {', '.join(model.names):28s} {model.reference}")

# %% [markdown]
# We take one model. (The vector also holds what gas, liquid and camera may do; the catalogue of the documentation has it all.)

# %%
for name in MATERIALS["gen_qkv"].names:
    parameter = PARAMETERS[name]
    unit = "" if parameter.unit == "1" else parameter.unit
    print(
        f"{name:6s} {parameter.meaning:18s} {unit:5s} does nothing at {parameter.neutral:g}"
    )

stiffening = torch.tensor([0.0, 0.25, 0.5, 1.0], dtype=torch.float64)
gels = PARAMETERS.pack({"G": 2770.0, "mu": 0.186, "alpha": stiffening})
print("batch of parameter vectors:", tuple(gels.shape))

# %% [markdown]
# ## The design and the times
# A design is (We, R_inf*): the Weber number fixes the maximum radius, and R_inf* = R_inf/Rmax how far the bubble was
# stretched. Times are in units of Rmax/U_c; zero is the maximum radius.

# %%
simulator = PolytropicSimulator()
design = torch.tensor([550.0, 0.22], dtype=torch.float64)
print(
    f"Rmax = {1e6 * float(simulator.conditions.surroundings.max_radius(design[0])):.0f} um"
)
times = torch.linspace(0.0, 4.0, 401, dtype=torch.float64)
solution = simulator(gels, design, times)
print(solution.summary())

# %%
figure, ax = plt.subplots(layout="constrained")
ax.plot(times, solution.radius.T, label=[f"alpha = {a:g}" for a in stiffening.tolist()])
ax.set(xlabel="t*", ylabel="R*", ylim=(0.0, None))
ax.legend()
figure.savefig(OUT / "stiffening.png")
assert bool(solution.ok.all())

# %% [markdown]
# ## How exact is it?
# The step of the stretched time decides; halving it lowers the error sixteenfold. Compare with the `reference` setting.

# %%
reference = PolytropicSimulator(stepping=STEPPINGS["reference"])(gels, design, times)
for name in ("fast", "default"):
    coarse = PolytropicSimulator(stepping=STEPPINGS[name])(gels, design, times)
    print(
        f"{name:8s} largest error in R* {float((coarse.radius - reference.radius).abs().max()):.1e}"
    )

# %% [markdown]
# ## Many bubbles cost little
# One call solves a whole batch; a bubble that cannot be solved gets a status and leaves the others alone.

# %%
count = 50 if SMOKE else 1000
many = PARAMETERS.pack(
    {"G": torch.linspace(500.0, 20000.0, count, dtype=torch.float64), "mu": 0.1}
)
result = simulator(many, design, torch.linspace(0.0, 4.0, 81, dtype=torch.float64))
print(result.summary())
