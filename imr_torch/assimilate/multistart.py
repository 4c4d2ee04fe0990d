"""Multistart search for the lowest minimum of one model: which starts are descended from, in which
order, and when two agree.

A start from the prior is first lowered by coarse bubbles without the frames next to collapses,
which make local minima (:mod:`imr_torch.assimilate.starts`), then by the simulator's own bubbles
and all frames, and near a minimum by bubbles that take the solver steps of one point
(:mod:`imr_torch.assimilate.local_minimum`). Starts follow each other until the cost of a second is
that of the lowest. Where they disagree, others begin near the lowest point.
"""

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from imr_torch.assimilate.basins import deeper_nuisances, nuisances_beside
from imr_torch.assimilate.fit import PROMISED
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.local_minimum import Descent, Report, descend_from
from imr_torch.assimilate.options import SearchOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.starts import draw_perturbation, without_collapses


@dataclass
class ModelSearch:
    """The search for the lowest minimum of one model.

    Args:
        posterior: of the model.
        starts: where descents begin, in that order.
        options: how to search.
        masking: whether frames next to collapses are left out at first.
        source: of starts near the lowest point.
        report: called with what an iteration led to.
        minima: where descents ended.
        limit: cost above which a descent ends and no further start follows, nats.
    """

    posterior: Posterior
    starts: list[Point]
    options: SearchOptions
    masking: bool
    source: torch.Generator
    report: Report | None = None
    minima: list[Descent] = field(default_factory=list)
    limit: float = math.inf

    @property
    def lowest(self) -> Descent:
        """The lowest end of a descent."""
        return min(self.minima, key=lambda end: end.cost)

    @property
    def agreement(self) -> float:
        """Cost of the second lowest end minus that of the lowest, nats."""
        costs = sorted(end.cost for end in self.minima)
        return (
            costs[1] - costs[0] if len(costs) > 1 and math.isfinite(costs[0]) else math.inf
        )

    def approach_first(self) -> float:
        """Lower the first start without the frames next to collapses; returns its cost."""
        self.starts[0] = self._lower_masked(self.starts[0])
        return self._cost_at(self.starts[0])

    def find_lowest(self) -> None:
        """Descend from starts until two agree, and from points near the lowest where they do not.

        Among models, of which one may be far behind in a poor minimum, from all if more than two,
        and of two from the lower one first: near a neutral value an effect may have no slope.
        """
        starts = self.starts
        among = self.options.drop_behind is not None
        several = among and len(starts) > 2
        if several:
            starts = self._sift_starts()
        elif among and len(starts) == 2 and not self.masking:
            starts = sorted(starts, key=self._cost_at)
        self._add_minimum(starts[0])
        for start in starts[1:]:
            if several or not (self._two_agree() or _is_behind(self.lowest, self.limit)):
                self._add_minimum(self._lower_masked(start))
        if len(starts) > 1:
            self._agree_nearby()

    def _sift_starts(self) -> list[Point]:
        """The starts; of many those that a few iterations bring lowest, and where these ended."""
        options = self.options.descent
        if options.sifted is None or len(self.starts) <= options.sifted:
            return self.starts
        posterior = (
            without_collapses(self.posterior.coarse) if self.masking else self.posterior
        )
        ends = [
            descend_from(
                posterior,
                start,
                None,
                gradient=options.own_steps,
                iterations=options.sifting,
            )
            for start in self.starts
        ]
        return [
            end.point for end in sorted(ends, key=lambda end: end.cost)[: options.sifted]
        ]

    def enter_deeper_basins(self) -> None:
        """Descend again where the nuisances of an experiment have a deeper basin at the gel found."""
        for _ in range(self.options.basin_rounds):
            end = self.lowest
            here = end.point.nuisances
            if not end.cost < self.limit:
                break
            deeper = deeper_nuisances(
                self.posterior, Point(end.point.gel[None], here[None])
            )[0]
            if torch.equal(deeper, here):
                break
            self._enter_basin(deeper)

    def follow_rival(self, rival: "ModelSearch") -> None:
        """Descend again from the nuisances of a narrower model with a lower minimum, where they lead
        to a deeper basin.
        """
        names, others = (set(one.posterior.prior.material.names) for one in (self, rival))
        end = self.lowest
        least = rival.lowest.cost + self.options.descent.nested
        if not (others < names and least < end.cost < math.inf):
            return
        deeper = nuisances_beside(self.posterior, end.point, rival.lowest.point.nuisances)
        if not torch.equal(deeper, end.point.nuisances):
            self._enter_basin(deeper)

    def _enter_basin(self, deeper: Tensor) -> None:
        """Descend from the lowest point and from one beside it, with other nuisances."""
        end = self.lowest
        beside = self._move_away(end, self.options.descent.restart)
        self._add_minimum(Point(end.point.gel, deeper))
        self._add_minimum(
            Point(beside.gel, beside.nuisances + deeper - end.point.nuisances)
        )
        self._agree_nearby()

    def _cost_at(self, point: Point) -> float:
        return -float(self.posterior.log_joint(point))

    def _agree_nearby(self) -> None:
        """Descend from points near the lowest one while no two ends agree."""
        for away in (self.options.descent.restart, self.options.descent.nearer):
            if not self._two_agree() and not _is_behind(self.lowest, self.limit):
                self._add_minimum(self._move_away(self.lowest, away))

    def _two_agree(self) -> bool:
        return self.agreement < self.options.agreement

    def _highest_useful(self) -> float:
        """Cost above which a descent ends: of a model among others that of its lowest minimum too."""
        if self.options.drop_behind is None or not self.minima:
            return self.limit
        return min(self.limit, self.lowest.cost + self.options.agreement)

    def _lower_masked(self, point: Point) -> Point:
        """A point lowered by coarse bubbles without the frames next to collapses, as far as it may
        come below the limit.
        """
        if not self.masking:
            return point
        masked = without_collapses(self.posterior.coarse)
        # frames can only add to the cost, but for the normaliser of their noise
        added = self.posterior.least_cost - masked.least_cost
        return descend_from(
            masked,
            point,
            None,
            gradient=self.options.descent.own_steps,
            iterations=self.options.iterations,
            limit=self.limit - added,
            failures=self.options.descent.failures,
        ).point

    def _add_minimum(self, point: Point) -> None:
        """Add the minimum below a point, by bubbles that take the solver steps of one."""
        left = self.options.iterations
        options = self.options.descent
        limit = self._highest_useful()

        def lower_cost(
            leader: Point | None, gradient: float, reach: float = math.inf
        ) -> Descent:
            return descend_from(
                self.posterior,
                point,
                leader,
                gradient=gradient,
                iterations=min(left, options.leader_iterations),
                reach=reach,
                limit=limit,
                failures=options.failures,
                report=self.report,
            )

        leader = self._shared_leader(point)
        if leader is None:
            end = lower_cost(None, options.own_steps)
            left -= end.iterations
            if _is_behind(end, limit):
                self.minima.append(end)
                return
            point = end.point
            leader = self._shared_leader(point)
        reach = options.reach
        while True:
            shared = leader is not None
            leader = leader or point
            end = lower_cost(leader, self.options.gradient, math.inf if shared else reach)
            left -= end.iterations
            close = options.shared_distance if shared else options.leader_distance
            arrived = (
                end.gradient < self.options.gradient and end.distance_to(leader) < close
            )
            # where no step of its own bubbles lowers the cost, as beside gels whose bubbles fail
            stuck = not shared and end.distance_to(point) == 0.0
            if (
                arrived
                or stuck
                or end.iterations == 0
                or left <= 0
                or _is_behind(end, limit)
            ):
                self.minima.append(replace(end, iterations=self.options.iterations - left))
                return
            point = end.point
            leader = None
            reach *= 2.0

    def _shared_leader(self, point: Point) -> Point | None:
        """The leader of the lowest minimum, for points that are close to it."""
        close = (
            bool(self.minima)
            and self.lowest.distance_to(point) < self.options.descent.shared_distance
        )
        return self.lowest.leader if close else None

    def _move_away(self, end: Descent, away: float) -> Point:
        """A point so many posterior standard deviations away, whose nuisances follow the gel."""
        move = draw_perturbation(end.equations.posterior_chol, self.source, away)
        response = end.equations.reduced.nuisance_response
        return Point(end.point.gel + move, end.point.nuisances + response @ move)


def _is_behind(end: Descent, limit: float) -> bool:
    """Whether a cost, less what its gradient allows, is above a limit."""
    return end.cost - PROMISED * min(end.gradient, 1e6) ** 2 > limit
