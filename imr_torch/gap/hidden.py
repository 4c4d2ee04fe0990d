"""How much would hide: for each effect the size that these data would have shown, and what that
size, unseen, would do to the parameters.

About a fit an effect of a usual size leaves ``L`` standard deviations beside everything fitted; a
test finds a signal of ``s L`` with 90 % where that is the root of the noncentrality of its
chi-square. What the fit absorbs of the same signal shifts the gel. Both are of first order in the
size. This is the answer to "can a clean fit be trusted?", and stands beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.special import chdtri, chndtrinc

from imr_torch.assimilate import ModelFit
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.diagnose import GapReport
from imr_torch.goodness.score import LEVEL
from imr_torch.material import Effect

FOUND = 0.9
"""Chance with which the size that is said would have been found."""
_PLAUSIBLE = 4.0  # usual sizes beyond which an effect is said not to be seen here


@dataclass(frozen=True)
class Hidden:
    """What of one effect these data would not show.

    Args:
        effect: its name.
        size: of its amplitude, either sign, SI, that would be found with 90 %; None where even four times its
            usual size would not.
        shift: parameter of the gel -> relative change by that size, unseen; by the usual size where
            there is none.

    >>> from imr_torch.gap.hidden import Hidden
    >>> Hidden("clock", 0.01, {"G": 0.06}).shift["G"]
    0.06
    """

    effect: str
    size: float | None
    shift: dict[str, float]


def hidden_effects(report: GapReport) -> tuple[Hidden, ...]:
    """What would hide at the fit that the verdict rests on, the largest shift first.

    Args:
        report: a diagnosis.
    """
    found = report.attribution if report.verdict in ("effect", "class") else None
    left = found.left if found else report.left
    fit = found.winner_fit if found else report.null
    rows = [_hidden(effect, left, fit, report.base.of_gel) for effect in left.effects]
    return tuple(sorted(rows, key=lambda row: -max(map(abs, row.shift.values()), default=0.0)))


def _hidden(effect: Effect, left: Adequacy, fit: ModelFit, gel: Sequence[str]) -> Hidden:
    """What would hide of one effect beside a fit: of the start that shows in the middle of all."""
    beside = left.line.project_out(left.beside[effect.name]).norm(dim=1)
    rows = left.directions[effect.name]
    known = torch.nonzero(beside > 0.0)[:, 0]
    blocks = [b for b in left.test.blocks if b.name == effect.name]
    if not len(known) or not blocks:
        return Hidden(effect.name, None, {})
    place = int(known[beside[known].argsort()[len(known) // 2]])
    # the noncentrality with which a test of this rank and level finds a signal with FOUND
    rank = blocks[0].rank
    least = chdtri(rank, LEVEL / len(left.test.blocks))
    needed = float(chndtrinc(least, rank, 1.0 - FOUND)) ** 0.5
    times = needed / float(beside[place])
    plausible = times <= _PLAUSIBLE
    shift = (times if plausible else 1.0) * (left.line.to_shift @ rows[place])[: len(fit.mean)]
    moved = torch.stack((fit.mean, fit.mean + shift))
    before, after = fit.prior.physical(fit.prior.unwhitened(moved))
    relative = (after / before - 1.0).tolist()
    names = [name for name in fit.prior.names if name in gel]
    return Hidden(
        effect.name,
        times * abs(effect.starts[place][0]) if plausible else None,
        {name: relative[fit.prior.names.index(name)] for name in names},
    )
