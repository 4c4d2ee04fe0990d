"""Multistart logic: which starts of a search begin, which are dropped, and which are restarted.

Two starts of a model must agree before its minimum is believed. Where several models are compared
(``SearchOptions.drop_behind``) most have a far higher cost than the best long before that, and
their chains are dropped. Each function takes the states of the searches, one a model, between two
iterations, and returns new ones.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch

from imr_torch.assimilate.basins import deeper_nuisances
from imr_torch.assimilate.chains import Chains, lowest_cost
from imr_torch.assimilate.descent import NEAR
from imr_torch.assimilate.fit import NEARLY, PROMISED
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.options import SearchOptions
from imr_torch.assimilate.starts import around

Searches = list[Chains]

_AWAY = (
    10.0,
    3.0,
)  # posterior standard deviations from the best point at which a first and a second restart begin
# share of the largest decrease of the cost from which a model with several minima gets all its
# starts
_FAIR = 0.2
_FAR_BEHIND = (
    200.0  # nats between minima that no other basin of the nuisances is likely to make up for
)
_RESERVE = (
    10.0  # times ``drop_behind`` by which a model may be behind and still begin its other starts
)


def defer_starts(searches: Searches, options: SearchOptions) -> Searches:
    """Where models are compared, only the best start of each begins.

    The others wait until it is near a minimum.
    """
    if options.drop_behind is None:
        return searches
    return [chains.put(chains.ranked[1:], finished=True) for chains in searches]


def manage_starts(searches: Searches, options: SearchOptions, source: torch.Generator) -> Searches:
    """After an iteration: drop chains that are far behind, end those that have converged, and begin
    or restart others.
    """
    searches = [_settled(chains, options) for chains in _dropped(searches, options)]
    for number in range(len(searches)):
        searches[number] = _restarted(searches, number, options, source)
    return searches


def enter_deeper_basins(
    searches: Searches, options: SearchOptions, source: torch.Generator
) -> tuple[Searches, bool]:
    """Restart models whose nuisances have a deeper basin at the gel where they ended, and say
    whether any has.

    Two starts begin, at the best point and beside it. Models far behind are left out.
    """
    reach = _FAR_BEHIND if options.drop_behind is None else min(options.drop_behind, _FAR_BEHIND)
    far = lowest_cost(searches) + reach
    any_moved = False
    result = []
    for chains in searches:
        best = chains.ranked[:1]
        if not bool(chains.cost[best] < far):
            result.append(chains)
            continue
        here = chains.point[best]
        deeper = deeper_nuisances(chains.posterior, here)
        if torch.equal(deeper, here.nuisances):
            result.append(chains)
            continue
        any_moved = True
        rows = chains.ranked[:2]
        other = _beside(chains, Point(here.gel[0], deeper[0]), int(best), _AWAY[0], 1, source)
        both = Point(torch.cat((here.gel, other.gel)), torch.cat((deeper, other.nuisances)))
        chains = chains.restarted(rows, both[: len(rows)])
        result.append(replace(chains, restarts=0))
    return result, any_moved


def _dropped(searches: Searches, options: SearchOptions) -> Searches:
    """End chains whose cost stays more than ``drop_behind`` above the lowest of all models."""
    if options.drop_behind is None:
        return searches
    limit = min(lowest_cost(searches), options.known_cost) + options.drop_behind
    result = []
    for chains in searches:
        reached = chains.cost - PROMISED * chains.gradient.clamp_max(1e6).square()
        behind = torch.nonzero((reached > limit) & ~chains.masking)[:, 0]
        result.append(chains.put(behind, finished=True))
    return result


def _settled(chains: Chains, options: SearchOptions) -> Chains:
    """End the other starts of a model once its best one has converged and a second has nearly, at
    the same cost.
    """
    agree = (chains.cost < chains.cost.min() + options.agreement) & ~chains.masking
    sure = agree & (chains.gradient < options.gradient) & chains.finished
    near = agree & (chains.gradient < max(NEARLY, options.gradient))
    if bool(sure.any()) and int(near.sum()) >= 2 and not _several(chains, options):
        return chains.put(torch.arange(len(chains)), finished=True)
    return chains


def _restarted(
    searches: Sequence[Chains], number: int, options: SearchOptions, source: torch.Generator
) -> Chains:
    """Begin starts that were deferred.

    Where starts disagree, restart near the best point, then nearer.
    """
    chains = searches[number]
    rows = chains.ranked
    several = _several(chains, options)
    apart = rows[chains.cost[rows] > chains.cost[rows[0]] + options.agreement]
    fresh = apart[(chains.iterations[apart] == 0) & torch.isfinite(chains.cost[apart])]
    # none disagrees, as of a single start, or two agree and no start waits that may find another
    # minimum
    if not len(apart) or (len(rows) - len(apart) >= 2 and not (len(fresh) and several)):
        return chains
    behind = chains.lowest - min(lowest_cost(searches), options.known_cost)
    lags = _lags(behind, options, _RESERVE) and not (several and _promising(chains, searches))
    if len(fresh) and bool((chains.finished | (chains.gradient < NEAR)).all()) and not lags:
        return chains.put(fresh, finished=False)
    if (
        not bool(chains.finished.all())
        or chains.restarts == len(_AWAY)
        or _lags(behind, options, 1.0)
    ):
        return chains
    best = int(rows[0])
    point = _beside(chains, chains.point[best], best, _AWAY[chains.restarts], len(apart), source)
    return replace(chains.restarted(apart, point), restarts=chains.restarts + 1)


def _lags(behind: float, options: SearchOptions, times: float) -> bool:
    """Whether a model is behind the best one by more than so many times ``drop_behind``."""
    return options.drop_behind is not None and behind > times * options.drop_behind


def _several(chains: Chains, options: SearchOptions) -> bool:
    """Whether a model among others has starts for several minima, so that agreement of two does not
    exclude others.
    """
    return options.drop_behind is not None and len(chains) > 2


def _promising(chains: Chains, searches: Sequence[Chains]) -> bool:
    """Whether the best chain of a model lowered its cost by a fair share of what the best one of
    all did.
    """
    gained = [float((c.begun - c.cost).nan_to_num(0.0).max()) for c in searches]
    best = chains.ranked[0]
    return float((chains.begun - chains.cost)[best].nan_to_num(0.0)) >= _FAIR * max(gained)


def _beside(
    chains: Chains, point: Point, row: int, away: float, count: int, source: torch.Generator
) -> Point:
    """``count`` points about one, so many posterior standard deviations of a chain away, whose
    nuisances follow the gel.
    """
    moves = torch.stack([around(chains.scale[row], source, away) for _ in range(count)])
    equations = chains.equations[row]
    nuisances = point.nuisances.expand(count, -1, -1)
    if equations is not None:
        nuisances = (
            nuisances + (equations.reduced.nuisance_response @ moves[:, None, :, None])[..., 0]
        )
    return Point(point.gel + moves, nuisances)
