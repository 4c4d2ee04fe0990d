"""Starting points of a multistart search: the best of many prior draws, given points, or points
about an earlier optimum; and the posterior that it begins with, without the frames next to
collapses.

Starts of a model are apart from each other, so that their agreement is evidence of convergence.

At a collapse R(t) has a cusp, so a frame next to it sees the same radius before the collapse and
after. A model whose collapse lies on the wrong side of such a frame has a local minimum there, a
hundredth of the prior's width from the right one and tens of nats above it. Without those frames it
has none. Searches mask them at first, and use all frames near a minimum.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.assimilate.fit import ModelFit
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.options import SearchOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.errors import ConvergenceError, ShapeError
from imr_torch.float64 import randn
from imr_torch.observe import collapse_time
from imr_torch.types import ControlMatrix, Controls

ENOUGH = 8
"""Experiments that tell good starts from bad ones, so that the choice does not cost more with more shots."""


def best_prior_draws(
    posterior: Posterior, options: SearchOptions, source: torch.Generator
) -> Point:
    """The best of many prior draws that are not neighbours of each other, by coarse bubbles of some
    of the experiments.

    The prior mean is among them.
    """
    draws = randn(options.raw_samples, posterior.size, generator=source)
    draws[0] = 0.0
    batch = posterior.batch
    some = batch.experiments[:: -(-len(batch.experiments) // ENOUGH)]
    few = replace(posterior, batch=replace(batch, experiments=some))
    cost = -few.coarse.log_joint(Point(draws, few.mean_nuisances(options.raw_samples)))
    order = cost.argsort()
    order = order[torch.isfinite(cost[order])].tolist()
    if len(order) < 2:
        raise ConvergenceError(
            f"{posterior.prior.model}: {len(order)} of {len(cost)} prior draws could be simulated; "
            "check units and bounds of the prior and the designs."
        )
    picked: list[int] = []
    for row in order:
        if all(
            (draws[row] - draws[other]).norm() > options.descent.apart for other in picked
        ):
            picked.append(row)
        if len(picked) == options.starts:
            break
    picked += [row for row in order if row not in picked]
    chosen = (picked * options.starts)[: options.starts]
    return Point(draws[chosen], posterior.mean_nuisances(options.starts))


def given_starts(
    posteriors: Sequence[Posterior],
    gels: Sequence[Float[Tensor, "starts _"]],
    nuisances: Sequence[Float[Tensor, "*starts experiments nuisances"]] | None,
) -> list[Point]:
    """Given gels, a row or more of each model, with nuisances of each or for all of a model; zero
    by default.

    Raises:
        ShapeError: if the gels do not suit the models.
    """
    free = [posterior.size for posterior in posteriors]
    if [rows.shape[1] for rows in gels] != free or not all(map(len, gels)):
        shapes = [tuple(rows.shape) for rows in gels]
        raise ShapeError(
            f"starts has shapes {shapes}; expected a row or more of {free} free parameters."
        )
    own = [p.mean_nuisances() for p in posteriors] if nuisances is None else nuisances
    return [
        Point(rows, n.expand(len(rows), -1, -1)) for rows, n in zip(gels, own, strict=True)
    ]


def starts_beside(
    posterior: Posterior, fit: ModelFit, options: SearchOptions, source: torch.Generator
) -> Point:
    """A model's optimum in an earlier assimilation, and perturbed copies of it."""
    noise = torch.stack(
        [
            draw_perturbation(fit.chol, source, options.descent.restart)
            for _ in range(options.starts)
        ]
    )
    noise[0] = 0.0
    gels = fit.mean + noise
    failed = torch.isinf(posterior.log_joint(Point(gels, fit.nuisances_at(gels))))
    gels[failed] = fit.mean
    return Point(gels, fit.nuisances_at(gels))


def draw_perturbation(
    chol: ControlMatrix, source: torch.Generator, away: float, *, longest: float = 0.25
) -> Controls:
    """A ``d`` perturbation, ``away`` posterior standard deviations (``chol``, ``d x d``) or, if
    less, ``longest`` of the prior's.

    Where the data are sharp, a step on the prior's scale would lead to another local minimum.
    """
    noise = randn(chol.shape[0], generator=source)
    step = away * (chol @ noise)
    return step * (longest * noise.norm() / step.norm().clamp_min(1e-300)).clamp_max(1.0)


def without_collapses(posterior: Posterior) -> Posterior:
    """The posterior of all frames but those next to collapses."""
    batch = posterior.batch
    kept = tuple(e.at(away_from_collapses(e.times, e.mean)) for e in batch.experiments)
    return replace(posterior, batch=replace(batch, experiments=kept))


def away_from_collapses(
    times: Float[Tensor, "*#batch frames"], radius: Float[Tensor, "*#batch frames"]
) -> Bool[Tensor, "*#batch frames"]:
    """Frames that are neither a minimum nor next to one (the record may end at one).

    All, if those are less than half.
    """
    times = torch.cat((times, times[-1:] + 1.0))
    radius = torch.cat((radius, radius.amax(0, keepdim=True)))
    keep = torch.ones_like(times, dtype=torch.bool)
    number = 1
    while (at := collapse_time(times, radius, number)) < math.inf:
        frame = int((times == at).nonzero())
        keep[max(1, frame - 1) : frame + 2] = False
        number += 1
    keep = keep[:-1]
    return keep if 2 * int(keep.sum()) >= len(keep) else torch.ones_like(keep)
