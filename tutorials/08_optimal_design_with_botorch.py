# %% [markdown]
# # Optimal design with BoTorch
# You will be able to use the expected information gain as an acquisition function in BoTorch code of your own. Takes about
# a minute on one core.
#
# The expected information gain is a BoTorch acquisition function: it maps a batch of `q` designs to the nats that shooting them
# together is expected to tell. So BoTorch can maximise it as it stands, or a surrogate of it by noisy Bayesian optimisation.

# %%
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from botorch.optim import optimize_acqf
from botorch.utils.sampling import manual_seed

from imr_torch.design import (
    DesignSpace,
    ExpectedInformationGain,
    InformationEstimator,
    InformationGain,
    Laplace,
    Plan,
    Shot,
    search_design,
)
from imr_torch.material import reference_case
from imr_torch.results.plot import draw_information
from imr_torch.simulate import PolytropicSimulator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
OUT = Path(tempfile.mkdtemp()) if SMOKE else Path("out/08")
OUT.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The acquisition
# Belief, simulator and plan say what is asked; the estimator, an object, how. `Laplace` is cheap and does not saturate. With
# one seed all designs share gels and noise, so the surface is smooth, and differences between designs are known better than
# their level. `target="model"` asks only which model is right, `target="parameters"` only for its parameters.

# %%
prior, simulator, plan = (
    reference_case("stiff-pa").prior,
    PolytropicSimulator(),
    Plan(repeats=100),
)
space = DesignSpace(weber=(100.0, 1000.0), rest_radius=(0.14, 0.30))
laplace = Laplace(draws=4 if SMOKE else 32)
acquisition = ExpectedInformationGain(
    prior, simulator, laplace, plan=plan, space=space, seed=1
)

X = torch.tensor(
    [[[900.0, 0.28]], [[300.0, 0.20]]], dtype=torch.float64
)  # batch_shape x q x 2
print("gain in nats:", acquisition(X).tolist())
gain = acquisition.estimate(X[0])
print(
    f"of which {gain.parameters:.2f} about parameters, {gain.model:.2f} about the model; +- {gain.variance**0.5:.2f}"
)

# %% [markdown]
# ## BoTorch maximises it directly

# %%
with manual_seed(0):
    best, value = optimize_acqf(
        acquisition,
        space.bounds,
        q=1,
        num_restarts=1,
        raw_samples=4 if SMOKE else 16,
        options={
            "with_grad": False,
            "method": "Nelder-Mead",
            "xatol": 10.0,
            "fatol": 0.5 if SMOKE else 0.02,
        },
    )
print(
    f"direct: We {float(best[0, 0]):.0f}, R_inf* {float(best[0, 1]):.3f}, {float(value):.2f} nats"
)

# %% [markdown]
# ## Or through a surrogate
# Each evaluation costs simulations and carries a known error, so a Gaussian process with known noise and
# `qLogNoisyExpectedImprovement` need few. What is recommended is the maximum of its posterior mean, not the luckiest value.

# %%
search = search_design(
    acquisition,
    seed=0,
    evaluations=5 if SMOKE else 25,
    initial=4 if SMOKE else 10,
)
chosen = search.recommendation
print(
    f"surrogate: {space.describe(chosen.design, simulator.conditions.surroundings)}, {chosen.mean:.2f} +- {chosen.sd:.2f} nats"
)
found = search.to_dict(simulator.conditions.surroundings)
draw_information(found).figure.savefig(OUT / "information.png")

# %% [markdown]
# ## Two bubbles at once
# Joint information is not a sum: what the second tells is what the first left open. Different stretch beats a repetition.

# %%
one, other = chosen.design, torch.tensor([900.0, 0.15], dtype=torch.float64)
for name, second in (("the same design again", one), ("another stretch", other)):
    pair = acquisition.estimate(torch.stack((one, second)))
    print(
        f"{name}: {pair.value:.2f} nats together, {pair.value - acquisition.estimate(one[None]).value:.2f} more than alone"
    )

# %% [markdown]
# `search_design(..., q=3)` finds such sets, one design after the other with those before it pending (`X_pending`), and says
# what each adds. On the command line: `imr-torch design --case stiff-pa --q 3`.

# %%
pair = search_design(
    acquisition, seed=0, q=2, evaluations=5 if SMOKE else 15, initial=4 if SMOKE else 8
)
for design, nats in zip(pair.chosen, pair.increments, strict=True):
    print(
        f"{space.describe(design, simulator.conditions.surroundings)} adds {nats:.2f} nats"
    )

# %% [markdown]
# ## An estimator of your own
# Any subclass of `InformationEstimator` works wherever these do. This one halves what another says.


# %%
@dataclass(frozen=True)
class Half(InformationEstimator):
    of: InformationEstimator

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        gain = self.of(shot, generator)
        return replace(
            gain,
            parameters=gain.parameters / 2,
            model=gain.model / 2,
            variance=gain.variance / 4,
            influence=None,
        )


print(
    "half of it:",
    ExpectedInformationGain(prior, simulator, Half(laplace), plan=plan, seed=1)(X).tolist(),
)
