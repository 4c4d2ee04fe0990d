"""The search for the designs of largest expected information gain, by Bayesian optimisation of its
estimates.

One design after the other is added to those found before, which are pending in the acquisition
(sequential greedy: within a factor ``1 - 1/e`` of the best joint gain where the gain is submodular,
Nemhauser, Wolsey & Fisher, Math. Program. 14, 1978). Where shots differ in cost, the gain over the
cost is maximised.
"""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import torch

from imr_torch.design.acquisition import ExpectedInformationGain
from imr_torch.design.gain import InformationGain, separate_errors
from imr_torch.design.optimizer import DesignOptimizer, Recommendation
from imr_torch.design.space import design_document
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.files import Document, drawn_numbers, without_nonfinite
from imr_torch.float64 import linspace, tensor, zeros
from imr_torch.random import child
from imr_torch.threads import one_torch_thread
from imr_torch.types import Designs, Progress, report_progress
from imr_torch.units import Surroundings


@dataclass(frozen=True)
class DesignSearch:
    """A finished search for the most informative design, or for one more beside those found before.

    Args:
        recommendation: the design to shoot; its mean is what it adds to the gain of the pending
            designs.
        designs: all evaluated designs.
        gains: their information gains, in the same order, each joint with the pending designs.
        optimizer: the optimizer, whose surrogate can be drawn.
        earlier: the searches for the designs before, of a search for several.

    >>> from imr_torch.design import Laplace
    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> gain = ExpectedInformationGain(reference_case("soft-pa").prior, PolytropicSimulator(), Laplace(draws=2, rivals=2))
    >>> search = search_design(gain, seed=0, evaluations=3, initial=2)
    >>> len(search.gains), bool((search.chosen[0] == search.recommendation.design).all())
    (3, True)
    """

    recommendation: Recommendation
    designs: Designs
    gains: tuple[InformationGain, ...]
    optimizer: DesignOptimizer
    earlier: tuple["DesignSearch", ...] = ()

    @property
    def chosen(self) -> Designs:
        """All designs to shoot, in the order found."""
        return torch.stack([step.recommendation.design for step in (*self.earlier, self)])

    @property
    def increments(self) -> tuple[float, ...]:
        """What each of the ``q`` designs adds to the gain of those before it, nats."""
        return tuple(step.recommendation.mean for step in (*self.earlier, self))

    @property
    def joint(self) -> float:
        """What the designs are expected to tell together, nats, beyond what was pending before the
        first.
        """
        return sum(self.increments)

    def to_dict(self, surroundings: Surroundings, *, points: int = 60) -> Document:
        """JSON-ready: the chosen design, at which ends of the space it lies, the evaluated ones with
        their gains, and the map of the surrogate's expected information gain (We, R_inf*, and rows
        of nats over We).

        Args:
            surroundings: the liquid side, which fixes Rmax of a Weber number.
            points: of the map, along each axis.
        """
        rows = []
        for (we, r), gain in zip(self.designs.tolist(), self.gains, strict=True):
            row = {"We": we, "R_inf*": r, "counted": gain.counted, "drawn": gain.drawn}
            if not gain.failed:
                row |= {"eig": gain.value, "sd": gain.variance**0.5}
                row |= {"parameters": gain.parameters, "model": gain.model}
            rows.append(row)
        bounds = self.optimizer.space.bounds.mT.tolist()
        weber, rest = (linspace(low, high, points) for low, high in bounds)
        model = self.optimizer.model()
        with torch.no_grad():
            nats = model.posterior(torch.cartesian_prod(weber, rest)).mean
        return {
            "design": design_document(self.recommendation.design, surroundings),
            "edges": self.optimizer.space.name_edges(self.recommendation.design),
            "evaluations": without_nonfinite(rows)[0],
            "map": {
                "We": weber.tolist(),
                "R_inf*": rest.tolist(),
                "nats": [drawn_numbers(row) for row in nats.reshape(points, points).mT],
            },
        }


@one_torch_thread()
def search_design(
    acquisition: ExpectedInformationGain,
    *,
    seed: int,
    q: int = 1,
    evaluations: int = 25,
    initial: int = 10,
    batch: int = 1,
    progress: Progress | None = None,
) -> DesignSearch:
    """Find the designs of largest expected information gain by Bayesian optimisation.

    The acquisition is left as it is; its pending designs count as shot. All evaluations share their
    draws and noise, which cancels from differences between designs: the surrogate is told the error
    of differences alone, and the recommendation's ``sd`` has the common error added.

    Args:
        acquisition: the information gain; its space is searched.
        seed: of the search, and of the draws in the place of the acquisition's own.
        q: designs that will be shot with the present belief, found one after the other, each with
            those before it pending.
        evaluations: designs evaluated for each.
        initial: of which space-filling.
        batch: designs asked for together after those; the surrogate is then asked less often.
        progress: called with one line per evaluation.

    Returns:
        The search for the last design, with those for the others in ``earlier``. Evaluations too
        many of whose bubbles failed are in it and were not told to the surrogate.

    Raises:
        InputDataError: for fewer evaluations than initial designs, an empty batch, or no design.
        ConvergenceError: if too many bubbles of the pending designs failed.

    >>> from imr_torch.design import Laplace
    >>> from imr_torch.material import reference_case
    >>> from imr_torch.simulate import PolytropicSimulator
    >>> gain = ExpectedInformationGain(reference_case("soft-pa").prior, PolytropicSimulator(), Laplace(draws=2, rivals=2))
    >>> search = search_design(gain, seed=0, q=2, evaluations=3, initial=2)
    >>> search.chosen.shape, len(search.increments)
    (torch.Size([2, 2]), 2)
    """
    if evaluations < initial:
        raise InputDataError(
            f"evaluations is {evaluations}, fewer than the {initial} initial designs; raise it."
        )
    for name, value in (("batch", batch), ("q", q)):
        if value < 1:
            raise InputDataError(f"{name} is {value}; expected at least 1.")
    steps: list[DesignSearch] = []
    for number in range(q):
        waiting = [] if acquisition.X_pending is None else [acquisition.X_pending]
        waiting += [step.recommendation.design[None] for step in steps]
        own = seed if number == 0 else child(seed, "further design", number)
        optimizer = DesignOptimizer(acquisition.space, seed=own, initial=initial)
        beside = copy(acquisition)
        beside.set_X_pending(torch.cat(waiting) if waiting else None)
        steps.append(_search_one(beside, optimizer, seed, evaluations, batch, progress))
    return replace(steps[-1], earlier=tuple(steps[:-1]))


def _tell_gains(
    untold: DesignOptimizer,
    designs: Designs,
    gains: Sequence[InformationGain],
    pending: InformationGain | None,
) -> tuple[DesignOptimizer, float]:
    """An optimizer that was told what designs add to the pending ones, per cost, and the variance
    that is common to all.

    Evaluations too many of whose bubbles failed are left out.
    """
    optimizer = copy(untold)
    counted = [i for i, gain in enumerate(gains) if math.isfinite(gain.value)]
    if not counted:
        return optimizer, 0.0
    kept = [gains[i] for i in counted]
    base = pending.value if pending else 0.0
    values = tensor([gain.value - base for gain in kept])
    errors = separate_errors(kept)
    # draws may agree exactly, and a known noise of 0 is none
    own = errors.own.clamp_min(1e-8)
    cost = optimizer.space.cost(designs[counted])
    optimizer.tell(designs[counted], (values / cost)[:, None], (own / cost**2)[:, None])
    return optimizer, errors.common


def _search_one(
    acquisition: ExpectedInformationGain,
    untold: DesignOptimizer,
    seed: int,
    evaluations: int,
    batch: int,
    progress: Progress | None,
) -> DesignSearch:
    """The search for one design.

    Args:
        acquisition: the gain, with all that is pending.
        untold: an optimizer that was told nothing; not changed.
        seed: of the draws.
        evaluations: designs to evaluate.
        batch: of which together, after the first.
        progress: called with one line per evaluation.
    """
    listed = acquisition.space.listed
    if listed is not None:
        evaluations = min(evaluations, len(listed))
    designs = zeros(0, 2)
    pending = None
    if acquisition.X_pending is not None:
        pending = acquisition.estimate(designs, seed=child(seed, "eig", 0))
        if pending.failed:
            raise ConvergenceError(
                f"{pending.counted} of {pending.drawn} draws could be simulated at the pending "
                f"designs {acquisition.X_pending.tolist()}; choose others."
            )
    gains: list[InformationGain] = []
    while len(gains) < evaluations:
        optimizer, _ = _tell_gains(untold, designs, gains, pending)
        failed = designs[[row for row, gain in enumerate(gains) if gain.failed]]
        count = min(batch if gains else optimizer.initial, evaluations - len(gains))
        for design in optimizer.ask(count, pending=failed):
            gain = acquisition.estimate(design[None], seed=child(seed, "eig", 0))
            designs = torch.cat((designs, design[None]))
            gains.append(gain)
            report_progress(
                progress,
                f"design {len(gains)}/{evaluations}: We {float(design[0]):6.1f}  R_inf* "
                f"{float(design[1]):.3f}  EIG {gain.value:.3f} +- {gain.variance**0.5:.3f} nats",
                step="design",
                done=len(gains),
                of=evaluations,
            )
    optimizer, common = _tell_gains(untold, designs, gains, pending)
    best = optimizer.recommend()
    cost = float(optimizer.space.cost(best.design[None]))
    # with the part that is common to all gains
    sd = math.sqrt((cost * best.sd) ** 2 + common)
    best = replace(best, mean=cost * best.mean, sd=sd)
    return DesignSearch(best, designs, tuple(gains), optimizer)
