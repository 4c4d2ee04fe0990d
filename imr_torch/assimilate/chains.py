"""The state of a multistart search: position, cost and linearisation of each chain, and which
chains are active.

Steps of a search (:mod:`~imr_torch.assimilate.descent`, :mod:`~imr_torch.assimilate.multistart`,
:mod:`~imr_torch.assimilate.basins`, :mod:`~imr_torch.assimilate.polish`) take a state and return
another; none is changed in place.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from imr_torch.assimilate.curvature import MOST
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.masking import Masked
from imr_torch.assimilate.posterior import Neighbourhood, Posterior

_DAMPING = 1e-2


@dataclass(frozen=True)
class Chains:
    """``C`` descents, each towards a local minimum of the cost, the negative log of one posterior.

    Args:
        posterior: of one model.
        masked: the same without the frames next to collapses.
        point: ``C`` points, positions of the chains.
        seen: the prediction there.
        cost: nats; infinite where a bubble fails.
        aim: what a chain lowers: the cost, or that of the frames that are not masked.
        begun: the cost at the start.
        masking: whether a chain leaves the masked frames out.
        leading: whether a chain has a leader, whose solver steps all its bubbles take.
        leader: ``C`` points.
        damping: of Levenberg and Marquardt.
        scale: Cholesky factors of the gel's posterior covariance as the last linearisation has it.
        gradient: length of the gradient in posterior standard deviations.
        iterations: ``C`` integers.
        finished: ``C`` booleans.
        around: per chain its point and the points beside it, simulated; None where not done.
        equations: per chain the last linearisation.
        origin: per chain the points simulated for the last linearisation, if by the solver steps of
            its leader; else None.
        curvature: of the cost, beside that of Gauss and Newton
            (:mod:`imr_torch.assimilate.curvature`); zero where not known, and of no size where
            there are too many coordinates.
        restarts: how often chains were restarted.
        simulated: bubbles simulated for sensitivities so far; ``failed`` is how many of them
            failed.
        failed: see ``simulated``.
    """

    posterior: Posterior
    masked: Masked
    point: Point
    seen: Float[Tensor, "chains experiments frames"]
    cost: Float[Tensor, "chains"]
    aim: Float[Tensor, "chains"]
    begun: Float[Tensor, "chains"]
    masking: Bool[Tensor, "chains"]
    leading: Bool[Tensor, "chains"]
    leader: Point
    damping: Float[Tensor, "chains"]
    scale: Float[Tensor, "chains controls controls"]
    gradient: Float[Tensor, "chains"]
    iterations: Int[Tensor, "chains"]
    finished: Bool[Tensor, "chains"]
    around: tuple[Neighbourhood | None, ...]
    equations: tuple[NormalEquations | None, ...]
    origin: tuple[Neighbourhood | None, ...]
    curvature: Float[Tensor, "chains coordinates coordinates"]
    restarts: int = 0
    simulated: int = 0
    failed: int = 0

    @classmethod
    def at(cls, posterior: Posterior, point: Point, *, masking: bool) -> "Chains":
        """Chains that start at ``C`` points; those that cannot be simulated there are finished.

        Args:
            posterior: what they search.
            point: where they begin.
            masking: whether frames next to collapses are left out at first.
        """
        seen = posterior.predict(point)
        count = len(point.gel)
        cost = -posterior.log_joint(point, seen)
        masked = Masked.of(posterior)
        numbers = torch.zeros(count, dtype=torch.float64)
        joint = posterior.size + point.nuisances[0].numel()
        joint = joint if joint <= MOST else 0
        return cls(
            posterior=posterior,
            masked=masked,
            point=point,
            seen=seen,
            cost=cost,
            aim=cost,
            begun=cost,
            masking=torch.full((count,), masking and masked.useful),
            leading=torch.zeros(count, dtype=torch.bool),
            leader=point,
            damping=numbers + _DAMPING,
            scale=0.5 * torch.eye(posterior.size, dtype=torch.float64).repeat(count, 1, 1),
            gradient=numbers + torch.inf,
            iterations=torch.zeros(count, dtype=torch.long),
            finished=~torch.isfinite(cost),
            around=(None,) * count,
            equations=(None,) * count,
            origin=(None,) * count,
            curvature=torch.zeros(count, joint, joint, dtype=torch.float64),
        )

    def __len__(self) -> int:
        return len(self.cost)

    @property
    def active(self) -> Int[Tensor, "rows"]:
        """Indices of the chains that are not finished."""
        return torch.nonzero(~self.finished)[:, 0]

    @property
    def ranked(self) -> Int[Tensor, "rows"]:
        """Indices of all chains, lowest cost first."""
        return torch.argsort(self.cost)

    @property
    def lowest(self) -> float:
        """The lowest cost."""
        return float(self.cost.min())

    def put(self, rows: Int[Tensor, "rows"], **values: Any) -> "Chains":
        """The state with values of some chains replaced: a tensor, a :class:`Point`, or one value
        for all of them.
        """
        changed: dict[str, Any] = {}
        for name, value in values.items():
            old = getattr(self, name)
            if isinstance(old, Point):
                changed[name] = old.put(rows, value)
            elif isinstance(old, tuple):
                new = (
                    dict(zip(rows.tolist(), value, strict=True))
                    if value is not None
                    else dict.fromkeys(rows.tolist())
                )
                changed[name] = tuple(new.get(i, entry) for i, entry in enumerate(old))
            else:
                changed[name] = old.index_put((rows,), torch.as_tensor(value, dtype=old.dtype))
        return replace(self, **changed)

    def restarted(self, rows: Int[Tensor, "rows"], point: Point) -> "Chains":
        """With some chains restarted from other points."""
        seen = self.posterior.predict(point)
        cost = -self.posterior.log_joint(point, seen)
        return self.put(
            rows,
            point=point,
            seen=seen,
            cost=cost,
            finished=~torch.isfinite(cost),
            leading=False,
            masking=False,
            damping=_DAMPING,
            around=None,
            origin=None,
            curvature=0.0,
        )

    def near(self, rows: Int[Tensor, "rows"]) -> Neighbourhood:
        """The simulated points and neighbours of some chains."""
        known = [self.around[row] for row in rows.tolist()]
        return Neighbourhood.stack([n for n in known if n is not None])


def lowest_cost(searches: Sequence[Chains]) -> float:
    """The lowest cost of several searches, one a model."""
    return min(chains.lowest for chains in searches)
