# %% [markdown]
# # One campaign
# You will be able to let the toolkit choose your next experiment, tell it the result, and resume where you stopped. Takes
# half a minute on one core.
#
# Gels are costly, so each experiment should be the one that tells most. We keep a gel secret, ask for the most
# informative design, shoot it, learn, and ask again.

# %%
import os
import tempfile
from pathlib import Path

from imr_torch.assimilate import SearchOptions
from imr_torch.campaign import Campaign, CampaignSettings, ExactLearner, Optimal
from imr_torch.design import Laplace, Plan
from imr_torch.material import PARAMETERS, reference_case
from imr_torch.observe import SimulatedLaboratory
from imr_torch.random import child
from imr_torch.results.plot import draw_information, plot_parameter
from imr_torch.simulate import PolytropicSimulator

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
OUT = Path(tempfile.mkdtemp()) if SMOKE else Path("out/03")

# %% [markdown]
# ## What we believe before
# Two candidate models, equally probable, each with (truncated) Gaussian parameters.

# %%
case = reference_case("stiff-pa")
for part in case.prior.models:
    for name, mean, sd in zip(
        part.names, part.means.tolist(), part.sds.tolist(), strict=True
    ):
        print(
            f"{part.material.title:10s} {name:6s} {mean:10.4g} +- {sd:.3g} {PARAMETERS[name].unit}"
        )

# %% [markdown]
# ## The laboratory and the campaign
# `SimulatedLaboratory` stands for yours. With real files, make an `Experiment` from each curve (`to_experiment`) and give
# it to `campaign.tell`; what counts is the design that was achieved, not the one that was asked for.

# %%
simulator = PolytropicSimulator()
laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=100)
settings = CampaignSettings(plan=Plan(repeats=100))
if SMOKE:
    small = SearchOptions(raw_samples=32, starts=2)
    settings = CampaignSettings(
        plan=Plan(repeats=100),
        policy=Optimal(Laplace(draws=4), evaluations=4, initial=3),
        learner=ExactLearner(options=small),
    )
campaign = Campaign(OUT, case.prior, simulator, settings=settings, seed=1)

# %%
for number in range(len(campaign.experiments) + 1, (1 if SMOKE else 2) + 1):
    proposal = campaign.ask()
    print(
        "shoot", settings.space.describe(proposal.design, simulator.conditions.surroundings)
    )
    step = campaign.tell(laboratory.shoot(proposal.design, seed=child(1, "shoot", number)))
    print("  models:", {k: round(v, 4) for k, v in step.belief.probabilities.items()})
    part = step.belief["gen_qkv"]
    for name, mean, sd in zip(
        part.names, part.means.tolist(), part.sds.tolist(), strict=True
    ):
        print(
            f"  {name:6s} error {100 * (mean / case.truth[name] - 1):+.2f} %, posterior sd {100 * sd / case.truth[name]:.2f} %"
        )

# %% [markdown]
# ## Look, and resume
# The folder holds a journal. Opening it again continues where it stopped: run this file twice and nothing is shot again.

# %%
again = Campaign(OUT, case.prior, simulator, settings=settings, seed=1)
assert again.belief.to_dict() == campaign.belief.to_dict()
found = again.search(1)
if found:
    draw_information(found).figure.savefig(OUT / "information.png")
history = [("prior", case.prior["gen_qkv"]), ("posterior", campaign.belief["gen_qkv"])]
plot_parameter(history, "alpha", truth=case.truth["alpha"]).figure.savefig(
    OUT / "alpha.png"
)
