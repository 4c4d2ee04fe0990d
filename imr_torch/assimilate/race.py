"""Which chains of a search are under way: who sets out, who rests, and who is sent out again.

Two starts of a model must agree before its minimum is believed. Where many models race (``EnsembleOptions.hopeless``), most
are left behind long before that matters, and their chains rest. Goes in: a search between two iterations. The numerics are
no business of this file.
"""

import torch
from torch import Tensor

from imr_torch.assimilate.fit import ALL_BUT, PROMISED
from imr_torch.assimilate.search import NEAR, Search
from imr_torch.assimilate.starts import around

_AWAY = (10.0, 3.0)  # posterior standard deviations by which a first and a second restart are away
_FAIR = 0.2  # share of the best chain's gain from which a model with several minima is given all its starts
_FAR_BEHIND = 200.0  # nats between minima that no valley of the nuisances is likely to make up for
_RESERVE = 10.0  # times ``hopeless`` by which a model may lag and still have its other starts sent out


class Race:
    """The chains of a search under way; those held back by ``hopeless`` are so from the first.

    Args:
        search: whose chains they are; which of them are finished is changed here.
    """

    def __init__(self, search: Search) -> None:
        self._search = search
        self._begun = search.cost.clone()
        self._restarts = [0] * len(search.belief.models)
        self._hold_back()

    def referee(self) -> None:
        """After an iteration: let chains rest that need not go on, and send others out."""
        self._give_up()
        self._settle()
        self._restart()

    def _hold_back(self) -> None:
        """In a race of models only the best start of each sets out; the others wait until it is near a minimum."""
        search = self._search
        if search.options.hopeless is None:
            return
        for model in range(len(search.belief.models)):
            rows = torch.nonzero(search.model == model)[:, 0]
            search.finished[rows[torch.argsort(search.cost[rows])[1:]]] = True

    def _give_up(self) -> None:
        """Let starts rest whose model the best one has left behind."""
        search = self._search
        if search.options.hopeless is None:
            return
        reached = search.cost - PROMISED * search.gradient.clamp_max(1e6).square()
        search.finished |= (reached > search.cost.min() + search.options.hopeless) & ~search.bluntly

    def _behind(self, chain: Tensor, times: float) -> bool:
        """Whether the best has left a chain behind by more than so many times ``hopeless``."""
        return self._search.options.hopeless is not None and bool(
            self._search.cost[chain] > self._search.cost.min() + times * self._search.options.hopeless
        )

    def _several(self, rows: Tensor) -> bool:
        """Whether a racing model was given starts for several minima: that two of them agree says little of the others."""
        return self._search.options.hopeless is not None and len(rows) > 2

    def _promising(self, chain: Tensor) -> bool:
        """Whether a chain came a fair part of the way that the best one came."""
        gained = (self._begun - self._search.cost).nan_to_num(0.0)
        return bool(gained[chain] >= _FAIR * gained.max())

    def _settle(self) -> None:
        """End the other starts of a model once its best one has converged and a second is all but there, at the same cost."""
        search = self._search
        for model in range(len(search.belief.models)):
            rows = torch.nonzero(search.model == model)[:, 0]
            agree = (search.cost[rows] < search.cost[rows].min() + search.options.agreement) & ~search.bluntly[rows]
            sure = agree & (search.gradient[rows] < search.options.gradient) & search.finished[rows]
            near = agree & (search.gradient[rows] < max(ALL_BUT, search.options.gradient))
            if bool(sure.any()) and int(near.sum()) >= 2 and not self._several(rows):
                search.finished[rows] = True

    def _restart(self) -> None:
        """Send starts out that were held back; where starts disagree, search again near the best point, then nearer."""
        search = self._search
        for model in range(len(search.belief.models)):
            rows = torch.nonzero(search.model == model)[:, 0]
            rows = rows[torch.argsort(search.cost[rows])]
            apart = rows[search.cost[rows] > search.cost[rows[0]] + search.options.agreement]
            fresh = apart[(search.iterations[apart] == 0) & torch.isfinite(search.cost[apart])]
            if len(rows) - len(apart) >= 2 and not (len(fresh) and self._several(rows)):
                continue
            near = search.finished[rows] | (search.gradient[rows] < NEAR)
            lags = self._behind(rows[0], _RESERVE) and not (self._several(rows) and self._promising(rows[0]))
            if len(fresh) and bool(near.all()) and not lags:
                search.finished[fresh] = False
                continue
            if not bool(search.finished[rows].all()):
                continue
            if self._restarts[model] == len(_AWAY) or self._behind(rows[0], 1.0):
                continue
            away = _AWAY[self._restarts[model]]
            self._restarts[model] += 1
            search.send(apart, self._near(rows[0], away, len(apart)), search.nuisances[rows[0]])

    def _near(self, chain: Tensor, away: float, count: int) -> Tensor:
        """``count x size`` gels about a chain's, so many posterior standard deviations away."""
        search = self._search
        free = len(search.belief.models[int(search.model[chain])].names)
        noise = torch.stack([around(search.chol[chain, :free, :free], search.source, away) for _ in range(count)])
        return search.gel[chain] + search.problem.padded(noise)

    def descend(self) -> bool:
        """Once all rest: send models out again whose nuisances have a deeper valley where they ended; whether any has.

        Two starts set out, from the best and from beside it. Models far behind are not asked.
        """
        search = self._search
        every = (torch.nonzero(search.model == model)[:, 0] for model in range(len(search.belief.models)))
        ranked = [rows[torch.argsort(search.cost[rows])][:2] for rows in every]
        hopeless = search.options.hopeless
        far = search.cost.min() + (_FAR_BEHIND if hopeless is None else min(hopeless, _FAR_BEHIND))
        ranked = [rows for rows in ranked if bool(torch.isfinite(search.cost[rows[0]]) & (search.cost[rows[0]] < far))]
        if not ranked:
            return False
        best = torch.stack([rows[0] for rows in ranked])
        deeper = search.deeper(best)
        moved = (deeper != search.nuisances[best]).flatten(1).any(1)
        for row in torch.nonzero(moved)[:, 0].tolist():
            gels = torch.cat((search.gel[best[row]][None], self._near(best[row], _AWAY[0], 1)))
            search.send(ranked[row], gels, deeper[row])
            self._restarts[int(search.model[best[row]])] = 0
        return bool(moved.any())
