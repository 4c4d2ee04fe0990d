"""The gap test at a fit that includes effects: what is left unexplained there, and in which
directions it was looked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from imr_torch.assimilate import ModelFit
from imr_torch.gap.lookalike import Likeness, likeness
from imr_torch.gap.refitted import refitted_directions
from imr_torch.goodness.linear import Linearisation, linearise_fit
from imr_torch.goodness.score import (
    GapTest,
    effect_directions,
    gap_test,
    generic_rows,
    make_block,
    promising_starts,
)
from imr_torch.material import Effect
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator
from imr_torch.types import Directions


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
        beside: the same beside a refit (:func:`imr_torch.gap.refitted.refitted_directions`).
        generic: rows of the generic blocks (:func:`imr_torch.goodness.score.generic_rows`).
    """

    test: GapTest
    starts: dict[str, tuple[tuple[float, ...], ...]]
    line: Linearisation
    directions: dict[str, Directions]
    effects: tuple[Effect, ...]
    beside: dict[str, Directions]
    generic: dict[str, Directions]

    def likeness(self, size: float, *, seed: int) -> Likeness:
        """What an unknown effect would look like here, of which a known one explains ``size``
        standard deviations.
        """
        return likeness(size, self.beside, self.generic, self.effects, self.line, seed=seed)


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
    others = tuple(effect for effect in effects if not set(effect.names) & set(fit.prior.names))
    directions = effect_directions(others, fit, batch, simulator, line)
    beside = refitted_directions(others, fit, batch, simulator, line, directions)
    generic = generic_rows(fit, batch, simulator, line)
    blocks = [make_block(name, rows, line) for name, rows in (*beside.items(), *generic.items())]
    starts = {effect.name: promising_starts(effect, beside[effect.name], line) for effect in others}
    return Adequacy(
        gap_test(blocks, line, seed=seed), starts, line, directions, others, beside, generic
    )
