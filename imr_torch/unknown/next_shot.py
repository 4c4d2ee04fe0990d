"""The next shot where what is missing has no name: the design at which its explanations differ most.

Each kind of unknown, and each plain term in place of the most probable kind, predicts the curve of a
shot that was not made as a Gaussian: the bubble under its most probable pressure, spread by what the
data leave open of gel and weights and by the shot's own nuisances. A function of the gel's state is
carried over to another design; a pressure of each shot's own is new there. Data drawn from each
prediction are weighed by all of them.
"""

from collections.abc import Sequence

import torch
from torch.distributions import MultivariateNormal

from imr_torch.design import DesignSpace, NextDesign, Plan
from imr_torch.errors import ConvergenceError
from imr_torch.float64 import eye, ones, randn, tensor, zeros
from imr_torch.material import ModelBelief
from imr_torch.observe import NUISANCES, Experiment, ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Design, DrawnValues, FrameValues
from imr_torch.unknown.infer import Unknown
from imr_torch.unknown.search import Rival
from imr_torch.unknown.shot import Shot


def choose_shot(
    unknown: Unknown,
    prior: ModelBelief,
    simulator: Simulator,
    *,
    plan: Plan,
    seed: int,
    space: DesignSpace | None = None,
    designs: int = 8,
    least: float = 0.02,
) -> NextDesign | None:
    """The design that best tells the explanations of what is missing apart.

    Args:
        unknown: what is missing.
        prior: of the base model's gel.
        simulator: makes the bubbles.
        plan: how the next shot will be observed.
        seed: of designs and draws.
        space: designs that can be shot.
        designs: how many are compared, spread over the space.
        least: probability of an explanation that is worth telling from others.

    Returns:
        None where fewer than two explanations are that probable.

    Raises:
        ConvergenceError: if at no design all of them could be simulated.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.design import Plan
    >>> from imr_torch.gap.fits import fit_null
    >>> from imr_torch.gap.hypotheses import Inquiry
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> from imr_torch.unknown import choose_shot, infer_unknown
    >>> simulator, prior = PolytropicSimulator(), wide_prior(["nhkv"])["nhkv"]
    >>> truth = PARAMETERS.pack({"G": 8e3, "mu": 0.08, "alpha": 0.3})  # it stiffens
    >>> laboratory = SimulatedLaboratory(simulator, truth, repeats=5)
    >>> batch = ExperimentBatch((laboratory.shoot(torch.tensor([200.0, 0.2], dtype=torch.float64), seed=0),))
    >>> unknown = infer_unknown(fit_null(Inquiry(prior, batch, simulator), seed=0), batch, simulator)
    >>> found = choose_shot(unknown, prior, simulator, plan=Plan(repeats=5), seed=0, designs=2)
    >>> found.after > found.now  # one design does not tell a stress from a pressure in time, two do
    True
    """
    shares = {name: p for name, p in unknown.shares.items() if p >= least}
    if len(shares) < 2:
        return None
    total = sum(shares.values())
    shares = {name: p / total for name, p in shares.items()}
    rivals = [unknown.rivals[name] for name in shares]
    tried = []
    space = space or DesignSpace()
    for design in space.spread_designs(designs, seed=child(seed, "designs")):
        shot = plan_shot(design, plan, prior, simulator)
        still = shot.predict(rivals[0].gel, zeros(len(NUISANCES)), zeros(len(shot.moments)))
        curves = [predict_curve(shot, rival, still) for rival in rivals]
        if all(curve.mean.isfinite().all() for curve in curves):
            own = _weigh_outcomes(curves, shares, child(seed, "compare"))
            tried.append((NextDesign.judge(design, own, shares, plan), curves))
    if not tried:
        raise ConvergenceError(
            f"At none of {designs} designs could all explanations be simulated; narrow the space."
        )
    best, curves = max(tried, key=lambda item: item[0].gain)
    # fresh draws, so that the gain is not that of the luckiest design
    own = _weigh_outcomes(curves, shares, child(seed, "best"))
    return NextDesign.judge(best.design, own, shares, plan)


def plan_shot(design: Design, plan: Plan, prior: ModelBelief, simulator: Simulator) -> Shot:
    """A shot that was not made, of which only predictions may be asked."""
    radius = ones(plan.repeats, len(plan.times))
    weber, rest = design.tolist()
    experiment = Experiment("next", (weber, rest), plan.times, radius, plan.nuisance)
    return Shot(prior, ExperimentBatch((experiment,), plan.noise), simulator)


def predict_curve(shot: Shot, rival: Rival, reference: FrameValues) -> MultivariateNormal:
    """What an explanation predicts of a shot, the noise included: R* less that of a curve, whitened
    as there; NaN where its bubble cannot be simulated.

    Args:
        shot: the shot.
        rival: the explanation.
        reference: ``T`` tensor, the curve.
    """
    still = zeros(len(NUISANCES))
    response = shot.respond(rival.gel, still, zeros(len(shot.moments)))
    columns = rival.columns(0, shot, response)
    weights = torch.zeros_like(rival.weights) if rival.each else rival.weights
    made = columns @ weights
    if rival.inside and made.any():
        response = shot.respond(rival.gel, still, made)
        columns = rival.columns(0, shot, response)
    mean = shot.whiten((response.prediction - reference)[None], reference)[0]
    if rival.inside:
        changes = columns.mT @ response.pressure
    else:
        changes = shot.project_errors(columns, response.prediction)
        mean = mean + changes.mT @ weights
    gel = len(rival.gel)
    by_gel = response.fitted[:gel]
    spread = [eye(len(mean)), response.fitted[gel:]]
    if rival.each:
        spread += [rival.root[:gel].mT @ by_gel, rival.size * changes]
    else:
        spread.append(rival.root.mT @ torch.cat((by_gel, changes)))
    rows = torch.cat(spread).nan_to_num()
    failed = response.prediction.isnan().any()
    mean = torch.where(failed, torch.nan, mean)
    return MultivariateNormal(mean, rows.mT @ rows, validate_args=False)


def _weigh_outcomes(
    curves: Sequence[MultivariateNormal],
    shares: dict[str, float],
    seed: int,
    *,
    draws: int = 256,
) -> list[DrawnValues]:
    """For each explanation, the log probability that data drawn from it give to it."""
    prior = tensor(list(shares.values())).log()
    noise = randn(draws, len(curves[0].mean), generator=generator(seed))
    own = []
    for place, curve in enumerate(curves):
        data = curve.mean + noise @ curve.scale_tril.mT
        logs = torch.stack([other.log_prob(data) for other in curves], 1) + prior
        own.append(logs.log_softmax(1)[:, place])
    return own
