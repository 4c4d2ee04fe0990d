"""The gap test at a fit that includes effects: what is left unexplained there, in which directions
it was looked for, and what remains of each effect beside a refit of the gel.

A refit of the gel compensates most of what an effect does, since it shifts the collapses back.
Projecting the fitted directions off a change of tens of standard deviations compensates to first
order only, and the second-order part, which a refit would not leave, is as large as what remains.
So the gel (with the nuisances) is moved by the linear refit that compensates the change, the effect
is simulated beside it, and the rest is taken from there, twice if it gets smaller. A change of
hundreds of standard deviations (a strong stiffening) still leaves several times what a real refit
does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.float64 import full
from imr_torch.goodness.linear import Linearisation, linearise_fit, predict_changes
from imr_torch.goodness.score import (
    Block,
    GapTest,
    effect_directions,
    gap_test,
    generic_rows,
    list_starts,
    log_survival,
    make_block,
    promising_starts,
    split_by_effect,
)
from imr_torch.material import Effect
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator
from imr_torch.types import DirectionsByName, Values

_ROUNDS = 2
_FARTHEST_GEL = 1.0
"""Prior standard deviations of a move of the gel: farther gels cost much and are uninformative."""
_FARTHEST_NUISANCE = 15.0
"""The same of a nuisance."""


@dataclass(frozen=True)
class Adequacy:
    """The gap test at a fit, with the directions that it is made of.

    Args:
        test: the gap test there.
        starts: from where each effect that the fit does not hold would start.
        line: local sensitivities at the fit.
        directions: what each of those effects changes there
            (:func:`imr_torch.goodness.score.effect_directions`).
        effects: those effects.
        beside: the same beside a refit (:func:`refitted_directions`).
        generic: rows of the generic blocks (:func:`imr_torch.goodness.score.generic_rows`).
    """

    test: GapTest
    starts: dict[str, tuple[tuple[float, ...], ...]]
    line: Linearisation
    directions: DirectionsByName
    effects: tuple[Effect, ...]
    beside: DirectionsByName
    generic: DirectionsByName


def adequacy_test(
    fit: ModelFit,
    effects: Sequence[Effect],
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
) -> Adequacy:
    """The gap test at a fit, of effects that it does not hold and of the generic blocks."""
    line = linearise_fit(fit, batch, simulator)
    others = tuple(
        effect for effect in effects if not set(effect.names) & set(fit.prior.names)
    )
    directions = effect_directions(others, line)
    beside = refitted_directions(others, line, directions)
    generic = generic_rows(line)
    blocks = [
        make_block(name, rows, line) for name, rows in (*beside.items(), *generic.items())
    ]
    starts = {
        effect.name: promising_starts(effect, beside[effect.name], line)
        for effect in others
    }
    return Adequacy(
        gap_test(blocks, line, seed=seed), starts, line, directions, others, beside, generic
    )


def refitted_directions(
    effects: Sequence[Effect],
    line: Linearisation,
    directions: DirectionsByName,
) -> DirectionsByName:
    """Directions whose part beside the fitted ones is what a refit leaves of each effect.

    Args:
        effects: what was changed.
        line: local sensitivities at the fit.
        directions: name -> ``S x N``, whitened changes at each start
            (:func:`imr_torch.goodness.score.effect_directions`).

    Returns:
        Name -> ``S x N``; the first-order rows where the moved gel is far off, cannot be simulated,
        or leaves more.
    """
    changes = list_starts(effects)
    if not changes:
        return {}
    rows = torch.cat([directions[effect.name] for effect in effects])
    left = line.project_out(rows).norm(dim=1)
    farthest = full((line.fitted.shape[1],), _FARTHEST_NUISANCE)
    farthest[: line.near.posterior.size] = _FARTHEST_GEL
    # a start that failed would only fail again, slowly
    under_way = (left > 0.0).nonzero()[:, 0]
    for _ in range(_ROUNDS):
        shift = rows[under_way] @ line.to_shift.mT
        near = (shift.abs() <= farthest).all(1)
        under_way = under_way[near]
        shift = shift[near]
        if not len(under_way):
            break
        moved = predict_changes(line, [changes[i] for i in under_way.tolist()], -shift)
        beside = line.whiten(moved) + line.explained_rows(shift)
        now = line.project_out(beside).norm(dim=1)
        smaller = now < left[under_way]  # not where a solve failed: NaN is not smaller
        under_way = under_way[smaller]
        rows[under_way], left[under_way] = beside[smaller], now[smaller]
    return split_by_effect(rows, effects)


def log_p_values(
    blocks: Sequence[Block], rows: Float[Tensor, "*batch rows"]
) -> list[Values]:
    """Log p-values of residuals by each block that has a direction left.

    Args:
        blocks: what is tested.
        rows: ``... x N`` tensor, residuals beside the fitted directions.
    """
    return [
        log_survival((rows @ block.directions).square().sum(-1), block.directions.shape[1])
        for block in blocks
        if block.directions.shape[1]
    ]
