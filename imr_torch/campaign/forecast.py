"""How many shots a target needs, predicted from linearised Gaussian posteriors (a preposterior
analysis).

Gels are drawn from the belief, and curves of each at a sequence of designs. After every shot the
linearised posterior is handed to the rule that would end the campaign, so that prediction and
campaign mean the same by a target that is reached. Designs are those of the sequence whatever the
earlier curves show, and the true model of a draw is taken for sure unless the rule asks for its
probability.
"""

import math
from dataclasses import dataclass, replace

import torch

from imr_torch.assimilate.gauss_newton import inverse_chol
from imr_torch.campaign.stopping import (
    AllOf,
    AnyOf,
    CampaignState,
    ModelProbability,
    RelativeSd,
    StoppingRule,
)
from imr_torch.design import Laplace, Plan, Shot
from imr_torch.design.laplace import local_precision
from imr_torch.design.likelihood import (
    Data,
    draw_cloud_controls,
    infer_linear,
    simulate_gels,
)
from imr_torch.errors import InputDataError
from imr_torch.float64 import full
from imr_torch.material import Belief, even_belief
from imr_torch.random import generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Designs, DrawnValues


@dataclass(frozen=True)
class ShotForecast:
    """Shots that draws of gel and noise need until a target is reached.

    Args:
        counts: of each draw, the fewest first; infinite where the sequence is too short.
        weights: of the draws; they sum to 1.

    >>> import torch
    >>> from imr_torch.campaign import ShotForecast
    >>> found = ShotForecast(torch.tensor([1.0, 2.0, torch.inf]), torch.tensor([0.3, 0.3, 0.4]))
    >>> found.quantile(0.5), found.quantile(0.9), found.to_dict()["high"]
    (2.0, inf, None)
    """

    counts: DrawnValues
    weights: DrawnValues

    def quantile(self, level: float) -> float:
        """Shots that are enough for a share of the draws."""
        row = int(torch.searchsorted(self.weights.cumsum(0), level))
        return float(self.counts[min(row, len(self.counts) - 1)])

    def to_dict(self) -> dict[str, float | None]:
        """JSON-ready: the expected number, its quantiles of 10, 50 and 90 %, each None where it is
        above the length of the sequence, and the share of the draws that reach the target.
        """
        found = {
            "mean": float(self.weights @ self.counts),
            "low": self.quantile(0.1),
            "median": self.quantile(0.5),
            "high": self.quantile(0.9),
        }
        finite = {
            name: count if count < math.inf else None for name, count in found.items()
        }
        return finite | {"reached": float(self.weights[self.counts < math.inf].sum())}


@one_torch_thread()
def forecast_shots(
    belief: Belief,
    designs: Designs,
    simulator: Simulator,
    plan: Plan,
    rule: StoppingRule,
    *,
    draws: int = 32,
    seed: int = 0,
) -> ShotForecast:
    """How many shots of a sequence of designs a target needs.

    Args:
        belief: what is thought of the gel now.
        designs: the sequence; its length is the most that is looked at.
        simulator: makes the bubbles.
        plan: how shots are observed.
        rule: says whether the target is reached; of the belief alone.
        draws: gels per constitutive model.
        seed: of gels and noise.

    Raises:
        InputDataError: for a rule about something else, or a parameter that no model has.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.campaign import forecast_shots, stopping_rule
    >>> from imr_torch.design import Plan
    >>> designs = torch.tensor([[400.0, 0.22]], dtype=torch.float64).expand(8, 2)
    >>> found = forecast_shots(
    ...     reference_case("soft-pa").prior, designs, PolytropicSimulator(), Plan(), stopping_rule("mu:10%"), draws=4
    ... )
    >>> 1 <= found.quantile(0.5) <= 8
    True
    """
    about_models = check_target(rule, belief)
    if rule.find_reason(CampaignState(belief, ())):
        return ShotForecast(torch.zeros(1), torch.ones(1))
    distinct, place = designs.unique(dim=0, return_inverse=True)
    shot = Shot(belief, distinct, simulator, plan)
    source = generator(seed)
    estimator = Laplace(draws, rivals=draws)
    with torch.no_grad():
        seen = simulate_gels(shot, draw_cloud_controls(shot, draws, source))
        data = seen.at_designs(place).observe(shot, source)
        chances = shot.belief.log_probabilities.expand(len(data), -1)
        counts = full((len(data),), math.inf)
        for count in range(1, len(designs) + 1):
            gels = seen.at_designs(place[:count])
            told = Data(data.radius[:, :count], data.window[:, :count])
            if about_models:
                so_far = replace(shot, designs=designs[:count])
                _, logs = estimator.weigh_models(so_far, gels, told)
                chances = logs.nan_to_num(-math.inf).mT + shot.belief.log_probabilities
            for number, (gel, rows) in enumerate(zip(gels.parts, gels.rows, strict=True)):
                part = shot.belief.models[number]
                learnt = infer_linear(told[rows], gel, plan)
                means = learnt.mean if part.cloud is None else gel.controls
                chols = inverse_chol(local_precision(part, gel.controls) + learnt.fisher)
                for i, row in enumerate(range(len(data))[rows]):
                    if counts[row] < count:
                        continue
                    mean = part.unwhitened(means[i])
                    after = even_belief((part.with_gaussian(mean, part.chol @ chols[i]),))
                    if about_models:
                        models = list(shot.belief.models)
                        models[number] = after.best
                        after = Belief(tuple(models), chances[row])
                    if rule.find_reason(CampaignState(after, ())):
                        counts[row] = count
            if (counts < math.inf).all():
                break
    drawn = torch.tensor([len(gel) for gel in seen.parts])
    weights = (shot.belief.log_probabilities.exp() / drawn).repeat_interleave(drawn)
    order = counts.argsort()
    return ShotForecast(counts[order], (weights / weights.sum())[order])


def check_target(rule: StoppingRule, belief: Belief) -> bool:
    """Whether a target is about the probability of models."""
    if isinstance(rule, AnyOf | AllOf):
        return max(check_target(part, belief) for part in rule.rules)
    known = sorted({name for part in belief.models for name in part.names})
    if isinstance(rule, RelativeSd) and rule.name in (None, *known):
        return False
    if isinstance(rule, ModelProbability) and len(belief.models) > 1:
        return True
    raise InputDataError(
        f"{rule} is no target that shots are counted for; name one of {', '.join(known)}, as "
        f"{known[0]}:5%, or, of several models, model:.99."
    )


def camera_variants(plan: Plan) -> dict[str, Plan]:
    """Other cameras and numbers of repeats, by what they are.

    With half the exposure a frame has half the light, and where that is what its noise is of, a
    standard deviation the square root of 2 times as large.

    >>> from imr_torch.campaign import camera_variants
    >>> from imr_torch.design import Plan
    >>> [(what, len(plan.times), plan.repeats) for what, plan in camera_variants(Plan(repeats=5)).items()][0:2]
    [('designs chosen', 81, 5), ('a camera twice as fast', 161, 5)]
    """
    times = plan.times
    fast = replace(
        plan, times=torch.cat((times, 0.5 * (times[1:] + times[:-1]))).sort().values
    )
    dim = replace(fast, noise=replace(plan.noise, scale=math.sqrt(2.0) * plan.noise.scale))
    return {
        "designs chosen": plan,
        "a camera twice as fast": fast,
        "twice as fast at half the exposure, noise 1.4 times": dim,
        "a camera half as fast": replace(plan, times=times[::2]),
        "twice the repeats": replace(plan, repeats=2 * plan.repeats),
    }
