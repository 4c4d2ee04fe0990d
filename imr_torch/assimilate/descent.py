"""One Gauss-Newton iteration of all chains: linearise at the point of each, and try a damped step.

Near a minimum a chain gets a *leader*, the point whose solver steps all its bubbles take: the cost
    is then a smooth function,
equal to itself from iteration to iteration and between chains, where solves that each choose their
own steps differ by some 1e-4 in R*. Behind a leader it also learns the curvature that Gauss-Newton
leaves out (:mod:`imr_torch.assimilate.curvature`). Steps are those of Levenberg and Marquardt,
several dampings where the first does not lower the cost as predicted, and are taken only if they
lower the exact cost. Which chains are active is decided elsewhere
(:mod:`imr_torch.assimilate.multistart`).
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.assimilate.chains import Chains
from imr_torch.assimilate.curvature import damped_step, updated
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.gauss_newton import NormalEquations, stacked
from imr_torch.assimilate.options import SearchOptions
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.assimilate.secant import carried

NEAR = 1.0
"""Posterior standard deviations from a minimum at which a chain gets a leader, and another start may begin."""

_DAMPINGS = (
    0.0,
    1.0,
    30.0,
)  # times the current damping; the others where the first does not lower the cost as predicted
# share of the predicted decrease of the cost with which a step is taken without trying others
_KEPT = 0.5
# the same below which a chain gets a leader: there the solver's own steps decide on the cost
_ROUGH = 0.01
_STUCK = 1e4  # damping at which nothing lowers the cost any more
_LONGEST_STEP = 4.0  # prior standard deviations
_FURTHER = 3  # steps by the same sensitivities, each corrected by the step before
# share of the predicted decrease of the cost that such a step must reach for another to follow
_WORTH = 0.25


def iterate(chains: Chains, options: SearchOptions) -> Chains:
    """One iteration of the active chains."""
    chains = _explored(chains)
    rows = chains.active
    if not rows.numel():
        return chains
    chains, equations = _linearised(chains, rows)
    arrived = chains.masking[rows] & (equations.whitened_gradient < NEAR)
    if bool(arrived.any()):
        chains, equations = _linearised(chains.put(rows[arrived], masking=False), rows)
    gradient = equations.whitened_gradient
    chains = _curved(chains, rows, equations)
    chains = chains.put(
        rows,
        gradient=gradient,
        scale=equations.posterior_chol,
        iterations=chains.iterations[rows] + 1,
        equations=[equations[row] for row in range(len(rows))],
        finished=(gradient < options.gradient) & chains.leading[rows],
    )
    moving = torch.nonzero(~chains.finished[rows])[:, 0]
    if moving.numel():
        before = chains
        chains = _stepped(chains, rows[moving], equations[moving], options)
        chains = _led(_continued(before, chains, rows[moving], options), rows[moving])
    return chains


def _curved(chains: Chains, rows: Tensor, equations: NormalEquations) -> Chains:
    """With the curvature of chains learned from their last step, if all of it was seen with the
    solver steps of one leader.
    """
    led = chains.leading[rows] & ~chains.masking[rows]
    known = torch.tensor([chains.origin[row] is not None for row in rows.tolist()]) & led
    if chains.curvature.numel() and bool(known.any()):
        own = rows[known]
        points = [p for row in own.tolist() if (p := chains.origin[row]) is not None]
        before = (
            Neighbourhood.stack(points),
            stacked([e for row in own.tolist() if (e := chains.equations[row]) is not None]),
        )
        after = chains.near(own), equations[known]
        chains = chains.put(own, curvature=updated(chains.curvature[own], before, after))
    now = [
        chains.around[row] if ahead else None
        for row, ahead in zip(rows.tolist(), led.tolist(), strict=True)
    ]
    return chains.put(rows, origin=now)


def predict_led(
    chains: Chains, rows: Int[Tensor, "rows"], point: Point
) -> Float[Tensor, "rows points experiments frames"]:
    """Predictions ``C x N x E x T`` of ``N`` points of each of some chains, behind its leader or,
    without one, each alone.
    """
    leading = chains.leading[rows]
    posterior = chains.posterior
    made = torch.empty(*point.gel.shape[:2], *posterior.batch.mask.shape, dtype=torch.float64)
    if not bool(leading.all()):
        made[~leading] = posterior.predict(point[~leading])
    if bool(leading.any()):
        leader = chains.leader[rows[leading]]
        others = point[leading]
        gel = torch.cat((leader.gel[:, None], others.gel), 1)
        nuisances = torch.cat((leader.nuisances[:, None], others.nuisances), 1)
        made[leading] = posterior.predict(Point(gel, nuisances), bundled=True)[:, 1:]
    return made


def _explored(chains: Chains) -> Chains:
    """With the points beside all active chains simulated.

    Where rounding decides whether a bubble can be simulated at all, one that could may be lost; its
    chain ends there.
    """
    unknown = torch.tensor(
        [row for row in chains.active.tolist() if chains.around[row] is None], dtype=torch.long
    )
    chains = _looked_around(chains, unknown) if unknown.numel() else chains
    rows = chains.active
    if not rows.numel():
        return chains
    lost = rows[torch.isinf(chains.near(rows).log_joint)]
    return chains.put(lost, finished=True, cost=math.inf)


def _looked_around(chains: Chains, rows: Tensor) -> Chains:
    """With the points beside some chains simulated.

    One whose bubbles fail with its leader's steps loses its leader.
    """
    for leading in (False, True):
        some = rows[chains.leading[rows] == leading]
        if some.numel():
            made = _led_neighbours(chains, some) if leading else _coarse_neighbours(chains, some)
            chains = chains.put(some, around=[made[row] for row in range(len(some))])
    lost = rows[torch.isinf(chains.near(rows).log_joint) & chains.leading[rows]]
    if not lost.numel():
        return chains
    chains = chains.put(lost, leading=False, seen=chains.posterior.predict(chains.point[lost]))
    return _looked_around(chains, lost)


def _led_neighbours(chains: Chains, rows: Tensor) -> Neighbourhood:
    """Points of chains and those beside them, behind their leaders."""
    return chains.posterior.neighbourhood(
        chains.point[rows], chains.scale[rows], leader=chains.leader[rows]
    )


def _coarse_neighbours(chains: Chains, rows: Tensor) -> Neighbourhood:
    """Points of chains and those beside them: what changes from one to the other is simulated more
    coarsely.

    Slopes that are wrong by a hundredth do no harm as far from a minimum as chains without a leader
    are.
    """
    near = chains.posterior.coarse.neighbourhood(chains.point[rows], chains.scale[rows])
    seen = chains.seen[rows]
    prediction = near.prediction + (seen - near.centre).unsqueeze(-3)
    prediction[:, 0] = seen
    return replace(near, posterior=chains.posterior, prediction=prediction)


def _linearised(chains: Chains, rows: Tensor) -> tuple[Chains, NormalEquations]:
    """Costs and normal equations of some chains at their points, each behind its leader."""
    near = chains.near(rows)
    chains = replace(
        chains,
        simulated=chains.simulated + near.prediction[..., 0].numel(),
        failed=chains.failed + int((~torch.isfinite(near.prediction)).any(-1).sum()),
    )
    aim, cost = _aim(chains, rows, near.point, near.centre)
    return chains.put(rows, aim=aim, cost=cost), _equations(chains, rows, near)


def _equations(chains: Chains, rows: Tensor, near: Neighbourhood) -> NormalEquations:
    """Normal equations of what some chains lower."""
    masking = chains.masking[rows]
    if not bool(masking.any()):
        return near.equations
    return chains.masked.neighbourhood(near).equations.where(masking, near.equations)


def _aim(chains: Chains, rows: Tensor, point: Point, prediction: Tensor) -> tuple[Tensor, Tensor]:
    """What some chains lower, and the cost, at points whose leading dimension is that of the
    chains.
    """
    cost = -chains.posterior.log_joint(point, prediction)
    masking = chains.masking[rows]
    if not bool(masking.any()):
        return cost, cost
    fewer = -chains.masked.posterior.log_joint(point, chains.masked.seen(prediction))
    fewer = torch.where(
        torch.isfinite(cost), fewer, torch.inf
    )  # a bubble may fail after the frames that are kept
    return torch.where(masking.view(-1, *[1] * (cost.ndim - 1)), fewer, cost), cost


def _stepped(
    chains: Chains, rows: Tensor, equations: NormalEquations, options: SearchOptions
) -> Chains:
    """Try steps of several dampings; take the best if it lowers what the chain lowers."""
    tried = torch.tensor(_DAMPINGS, dtype=torch.float64) * chains.damping[rows, None]
    point = _damped_step(chains, rows, equations, tried)
    aim, cost = (torch.full(tried.shape, torch.inf, dtype=torch.float64) for _ in range(2))
    seen = torch.full((*tried.shape, *chains.seen.shape[1:]), torch.nan, dtype=torch.float64)
    aim[:, :1], cost[:, :1], seen[:, :1] = _tried(chains, rows, point[:, :1])
    poor = aim[:, 0] > chains.aim[rows] - _KEPT * 0.5 * chains.gradient[rows].square()
    if bool(poor.any()):
        aim[poor, 1:], cost[poor, 1:], seen[poor, 1:] = _tried(
            chains, rows[poor], point[poor][:, 1:]
        )
    best, which = aim.min(dim=1)
    better = (
        best < chains.aim[rows] - 0.01 * options.gradient**2
    )  # a fiftieth of what the tolerance leaves
    kept = rows[better]
    at = (torch.nonzero(better)[:, 0], which[better])
    eased = chains.damping[kept] * torch.tensor(_DAMPINGS, dtype=torch.float64)[which[better]]
    damping = torch.where(eased > 0.0, 0.3 * eased, 0.1 * chains.damping[kept]).clamp(1e-6, 1e6)
    rough = best > chains.aim[rows] - _ROUGH * 0.5 * chains.gradient[rows].square()
    rough = rows[better & rough & ~chains.leading[rows] & ~chains.masking[rows]]
    chains = chains.put(
        kept, point=point[at], seen=seen[at], cost=cost[at], around=None, damping=damping
    )
    return _unstuck(_follow_oneself(chains, rough), rows[~better])


def _continued(before: Chains, chains: Chains, rows: Tensor, options: SearchOptions) -> Chains:
    """Further steps of chains that moved, by the sensitivities from before, while each lowers the
    cost about as predicted.

    A chain that converges slowly gets several steps for one set of sensitivities. Where solver
    steps are not those of a leader, the cost is not smooth enough for steps of less than a standard
    deviation.
    """
    moved = (chains.point.gel[rows] != before.point.gel[rows]).any(1)
    rows = rows[moved & ~chains.finished[rows]]
    if not rows.numel():
        return chains
    near = before.near(rows)
    equations = near.equations
    for _ in range(_FURTHER):
        near = carried(near, equations, chains.point[rows], chains.seen[rows])
        equations = near.equations
        aims = _equations(chains, rows, near)
        expected = 0.5 * aims.whitened_gradient.square()
        least = torch.where(chains.leading[rows], options.gradient, NEAR)
        some = torch.nonzero(expected > 0.5 * least.square())[:, 0]
        if not some.numel():
            break
        rows = rows[some]
        near = near.take(some)
        equations = equations[some]
        expected = expected[some]
        point = _damped_step(chains, rows, aims[some], chains.damping[rows, None])
        aim, cost, seen = (found[:, 0] for found in _tried(chains, rows, point))
        gained = _aim(chains, rows, near.point, near.centre)[0] - aim
        lower = gained > 0.01 * options.gradient**2
        chains = chains.put(
            rows[lower], point=point[:, 0][lower], seen=seen[lower], cost=cost[lower]
        )
        good = torch.nonzero(lower & (gained > _WORTH * expected))[:, 0]
        if not good.numel():
            break
        rows = rows[good]
        near = near.take(good)
        equations = equations[good]
    return chains


def _damped_step(
    chains: Chains, rows: Tensor, equations: NormalEquations, damping: Float[Tensor, "rows points"]
) -> Point:
    """``C x N`` points to which steps of ``N`` dampings lead, none of them farther than allowed."""
    steps = [damped_step(equations, chains.curvature[rows], own) for own in damping.unbind(1)]
    gel_step, nuisance_step = (torch.stack(parts, dim=1) for parts in zip(*steps, strict=True))
    shorter = (_LONGEST_STEP / gel_step.norm(dim=-1, keepdim=True).clamp_min(1e-300)).clamp_max(1.0)
    own = chains.point[rows]
    return Point(
        own.gel[:, None] + shorter * gel_step,
        own.nuisances[:, None] + shorter[..., None] * nuisance_step,
    )


def _tried(chains: Chains, rows: Tensor, point: Point) -> tuple[Tensor, Tensor, Tensor]:
    """What some chains lower, and the cost, at ``N`` points of each (``C x N`` tensors), and the
    prediction there.
    """
    prediction = predict_led(chains, rows, point)
    return *_aim(chains, rows, point, prediction), prediction


def _unstuck(chains: Chains, rows: Tensor) -> Chains:
    """Damp chains that found no better point.

    Then give them a leader, which smooths their cost; then end them.
    """
    chains = chains.put(rows, damping=chains.damping[rows] * 100.0)
    stuck = rows[chains.damping[rows] > _STUCK]
    chains = chains.put(stuck, finished=chains.leading[stuck])
    chains = _follow_oneself(chains, stuck[~chains.masking[stuck]])
    return chains.put(stuck, masking=False, damping=1e-2)


def _follow_oneself(chains: Chains, rows: Tensor) -> Chains:
    """Make the current points of chains their leaders."""
    return chains.put(rows, leading=True, leader=chains.point[rows], around=None, origin=None)


def _led(chains: Chains, rows: Tensor) -> Chains:
    """Near a minimum a chain takes the leader of another that is there already, or its own point,
    until it moves away.
    """
    close_to_one = chains.leading[rows] | (chains.gradient[rows] < NEAR) & ~chains.masking[rows]
    for row in rows[close_to_one].tolist():
        others = torch.nonzero(chains.leading)[:, 0]
        gaps = (chains.leader.gel[others] - chains.point.gel[row]).mT
        distance = torch.linalg.solve_triangular(chains.scale[row], gaps, upper=False).norm(dim=0)
        close = others[distance < NEAR]
        this = torch.tensor([row])
        if not close.numel():
            chains = _follow_oneself(chains, this)
        elif not (close == row).any():
            chains = chains.put(
                this, around=None, origin=None, leading=True, leader=chains.leader[close[:1]]
            )
    return chains
