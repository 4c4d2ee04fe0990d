# %% [markdown]
# # An active diagnosis
# You will be able to find the cause of a gap with few shots, by choosing each shot so that the remaining causes differ most.
# Takes some twenty seconds on one core.
#
# A model misses the data, and several causes could explain it. More shots of the same kind may never tell them
# apart. So after each shot the experiments are diagnosed, and the next design is the one at which the causes that are left
# predict the most different curves.

# %%
import os
import tempfile

import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.campaign import Campaign, CampaignSettings, CauseProbability
from imr_torch.design import Plan
from imr_torch.gap import CauseLearner, TellCausesApart
from imr_torch.gap.figures import plot_causes
from imr_torch.material import PARAMETERS
from imr_torch.observe import SimulatedLaboratory
from imr_torch.random import child

SMOKE = os.environ.get("IMR_TORCH_SMOKE") == "1"
HOME = tempfile.mkdtemp()

# %% [markdown]
# ## The secret
# An NHKV gel that softens with the strain it has gone through. We believe NHKV, and we offer the causes below; an effect
# that nobody has thought of is always among the candidates, as "other".

# %%
simulator = PolytropicSimulator()
plan = Plan(
    times=torch.linspace(0.0, 2.5, 51, dtype=torch.float64), repeats=3, collapses=None
)
truth = PARAMETERS.pack({"G": 8000.0, "mu": 0.08, "damage": 0.02})
laboratory = SimulatedLaboratory(simulator, truth, times=plan.times, repeats=plan.repeats)
causes = ("damage", "strain_stiffening", "sound_speed") + (
    () if SMOKE else ("heat_exchange", "rinf_bias", "shear_thinning")
)

# %% [markdown]
# ## The campaign
# The learner diagnoses, the policy tells causes apart, and it stops when one cause has a probability of 0.8. The unknown
# effect, "other", has half of the probability before the data, and keeps some of it however well a known one fits.

# %%
learner = CauseLearner(causes)
policy = TellCausesApart(learner, designs=4 if SMOKE else 16, draws=4 if SMOKE else 16)
settings = CampaignSettings(
    plan=plan, policy=policy, learner=learner, stop=CauseProbability(0.8)
)
campaign = Campaign(HOME, wide_prior(["nhkv"]), simulator, settings=settings, seed=1)

# %%
for number in range(1, (1 if SMOKE else 6) + 1):
    proposal = campaign.ask()
    print(
        f"{number}. shoot",
        settings.space.describe(proposal.design, simulator.conditions.surroundings),
    )
    finding = campaign.tell(
        laboratory.shoot(proposal.design, seed=child(1, "shoot", number))
    ).finding
    ranked = sorted(finding.probabilities.items(), key=lambda item: -item[1])[:3]
    print(
        "   ",
        ", ".join(f"{name} {probability:.2f}" for name, probability in ranked)
        or "no test rejects the model yet",
    )
    if campaign.reason_to_stop():
        print(f"stop: {campaign.reason_to_stop()}")
        break

# %% [markdown]
# ## What was found
# The bars are the probabilities after the last shot.

# %%
ax = plot_causes(finding.probabilities) if finding.probabilities else None
print(
    f"verdict: {finding.verdict}, {', '.join(finding.causes) or 'no cause'}. {finding.reason}"
)

# %% [markdown]
# G and mu are inferred beside the cause. Without it they would have hidden a part of it.

# %%
best = campaign.belief.best
for name, mean, sd in zip(best.names, best.means.tolist(), best.sds.tolist(), strict=True):
    print(f"{name:3s} {mean:9.4g} +- {sd:.2g} {PARAMETERS[name].unit}")

# %% [markdown]
# ## With your laboratory
# `imr-torch campaign --goal cause --out gel7` says what to shoot; `--resume --tell shot1.csv` tells it the result. The folder
# holds a journal, so you may stop at any time. A name is the best of the known effects, not a proof; see "What to trust".
