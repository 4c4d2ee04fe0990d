"""How far the gap shrinks on unseen curves, and how far it would by chance.

A curve that was not fitted is predicted without what was selected and with it
(:mod:`imr_torch.gap.held_out`). Both residuals are judged after the same directions are removed:
all that the curve's own nuisances can make under either model, and its own gel where gels differ.
With whitened residual ``r``, single-shot variances and the projector ``P`` beside these directions,

    D = sum(|P r|^2 - tr P) / n,        S = 1 - D_effect / D_base,

so freedom earns nothing. A second figure fits what is the curve's own to the frames before the
first rebound's maximum alone and takes ``S`` over the frames after it.

What the procedure says where there is nothing to find is its placebo: a library of as many random
smooth errors of radius and of time, alike in all curves and of the size of the effects' priors,
from which as many are selected by the same rule. A gap counts as closed where ``S`` exceeds 95 % of
the placebos.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from scipy.special import chdtrc, ndtri, stdtrit
from torch import Tensor

from imr_torch.assimilate.slow_noise import BesideSlowNoise
from imr_torch.float64 import arange, eye, randn, tensor, zeros
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.held_out import Judged, judge_designs
from imr_torch.gap.hypotheses import EXPLAINS
from imr_torch.gap.model_error import smooth_errors
from imr_torch.goodness.linear import Linearisation
from imr_torch.goodness.score import ADEQUATE
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Progress, report_progress, within

TURN = 1.5
"""Reading of the phase clock at the first rebound's maximum."""
_DRAWS = 2000  # of the interval
_WIDEST = 2.0  # size of S beyond which the base leaves almost no gap to reduce
_KNOTS = arange(0.0, 5.0, 0.15)  # of a random function of the phase
_SMOOTH = 0.3  # its length on the phase clock


@dataclass(frozen=True)
class Shrinkage:
    """How far the gap shrinks on unseen curves.

    Args:
        share: 5, 50, 95 % of ``S``, by the scatter between curves (between phases of a single
            one); None where the directions that are removed leave no gap.
        later: the same over the frames after the first rebound's maximum, with what is the curve's
            own fitted before it.
        placebo: ``S`` of each random library, sorted.
        base_gap: ``D`` of the base model, in single-shot variances.
        base_p: that the base model's residuals beside the directions that are removed are noise.
        selected: what each curve's selection held without it.
        converged: whether every training fit did.

    >>> from imr_torch.gap.shrinkage import Shrinkage
    >>> found = Shrinkage((0.7, 0.9, 0.95), None, tuple(0.02 * i for i in range(20)), 4.0, 1e-9, (("clock",),), True)
    >>> found.placebo_high, found.word(adequacy=0.4)
    (0.361, 'closed')
    """

    share: tuple[float, float, float] | None
    later: tuple[float, float, float] | None
    placebo: tuple[float, ...]
    base_gap: float
    base_p: float
    selected: tuple[tuple[str, ...], ...]
    converged: bool

    @property
    def placebo_high(self) -> float:
        """95th percentile over random libraries."""
        return round(float(tensor(self.placebo).quantile(0.95)), 6)

    def word(self, adequacy: float) -> str:
        """``"closed"``, ``"partly closed"``, that and ``"not told from chance"`` where the interval
        reaches what random effects close, ``"not closed"`` or ``"no gap left"``.

        Closed needs more than half of the gap gone and more than random effects close, each with
        its lower bound, and a fit that leaves only noise on the fitted curves.

        Args:
            adequacy: p-value of the gap test at the fit with what was selected.
        """
        if self.share is None:
            return "no gap left"
        low, middle, _ = self.share
        if low > max(0.5, self.placebo_high) and adequacy >= ADEQUATE:
            return "closed"
        if min(low, middle - self.placebo_high) <= 0.0:
            return "not closed"
        return "partly closed" + ", not told from chance" * (low <= self.placebo_high)


def shrinkage(
    report: GapReport,
    simulator: Simulator,
    unseen: ExperimentBatch | None = None,
    *,
    placebos: int = 20,
    seed: int = 0,
    progress: Progress = None,
) -> Shrinkage | None:
    """Judge what a diagnosis selected on curves that neither fits nor selection saw.

    Args:
        report: a diagnosis that found a gap.
        simulator: makes the bubbles.
        unseen: designs that were held out before anything was fitted; without them those of the
            diagnosis are left out in turn.
        placebos: random libraries.
        seed: of starts, random functions and interval.
        progress: called with one line per step.

    Returns:
        None where nothing was selected beside differences between shots, or no curve can judge.
    """
    if not report.selected.effects:
        return None
    judged = judge_designs(
        report,
        simulator,
        unseen,
        seed=child(seed, "judge"),
        progress=within(progress, 0.0, 0.9),
    )
    if not judged:
        return None
    source = generator(child(seed, "interval"))
    excess = torch.stack([pair.excess_by_phase() for pair in judged])
    base_gap = float(excess[:, 0].sum())
    count = sum(len(pair.phase) for pair in judged)
    freedom = float(sum(pair.projector.trace() for pair in judged))
    squares = [(pair.projector @ pair.base.residual).square().sum() for pair in judged]
    base_p = float(chdtrc(freedom, float(sum(squares))))
    left = base_p < ADEQUATE and base_gap > 0.0
    later = [both for pair in judged if (both := pair.later_by_phase(TURN)) is not None]
    turned = left and later and float(torch.stack(later)[:, 0].sum()) > 0.0
    return Shrinkage(
        share=_interval(excess, source) if left else None,
        later=_interval(torch.stack(later), source) if turned else None,
        placebo=(
            _placebo(
                report, judged, placebos, child(seed, "placebo"), within(progress, 0.9, 1.0)
            )
            if left
            else ()
        ),
        base_gap=base_gap / count,
        base_p=base_p,
        selected=tuple(pair.effect.hypothesis.parts for pair in judged),
        converged=all(pair.base.converged and pair.effect.converged for pair in judged),
    )


def _interval(
    rows: Float[Tensor, "curves 2 phases"], source: torch.Generator
) -> tuple[float, float, float]:
    """5, 50, 95 % of ``1 - effect / base`` over curves, or over the phases of a single one, drawn
    anew; rows hold squares of the base and of the effect.

    One unit fewer than there are is drawn with replacement (Rao & Wu, J. Am. Stat. Assoc. 83,
    1988), and the scatter of so few curves is known badly: quantiles are as far from the middle as
    Student's t over the normal. A draw in which the base leaves no gap counts as -1 for the lower
    bound and as 1 for the upper; none counts as more than 2 in size.
    """
    units = rows.sum(2) if len(rows) > 1 else rows[0].mT
    units = units[(units != 0.0).any(1)]
    count = len(units)
    picked = torch.randint(count, (_DRAWS, max(count - 1, 1)), generator=source)
    weights = torch.nn.functional.one_hot(picked, count).sum(1).double()
    without, with_effect = (weights @ units).unbind(1)
    ratio = torch.where(
        without > 0.0, 1.0 - with_effect / without.clamp_min(1e-300), torch.nan
    )
    ratio = ratio.clamp(-_WIDEST, _WIDEST)
    low = float(ratio.nan_to_num(nan=-1.0).quantile(0.05))
    high = float(ratio.nan_to_num(nan=1.0).quantile(0.95))
    total = units.sum(0)
    middle = float((1.0 - total[1] / total[0]).clamp(-_WIDEST, _WIDEST))
    widened = float(stdtrit(max(len(rows) - 1, 1), 0.95) / ndtri(0.95))
    low = middle - widened * max(middle - low, 0.0)
    high = middle + widened * max(high - middle, 0.0)
    return max(low, -_WIDEST), middle, min(high, _WIDEST)


def _placebo(
    report: GapReport, judged: Sequence[Judged], count: int, seed: int, progress: Progress
) -> tuple[float, ...]:
    """``S`` of random libraries, sorted: the procedure where no candidate is the cause."""
    offered = len(report.trained.steps[0].hypotheses) - 1
    rounds = len(report.selected.effects)
    sizes = [rows.norm(dim=1).mean() for rows in report.trained.left.directions.values()]
    of_frame = float(torch.stack(sizes).median() / report.batch.mask.sum().sqrt())
    trainings = {id(pair.training): pair for pair in judged}
    before = float(sum(pair.excess_by_phase()[0].sum() for pair in judged))
    shares = []
    for number in range(count):
        source = generator(child(seed, number))
        weights = randn(offered, len(_KNOTS), generator=source)
        fitted = {
            key: _select_random(pair.training, weights, rounds, of_frame, pair.beside)
            for key, pair in trainings.items()
        }
        after = 0.0
        for pair in judged:
            gel, amplitudes = fitted[id(pair.training)]
            own = pair.base
            rows = own.line.whiten(_random_changes(own.line, weights))[
                :, : len(own.residual)
            ]
            change = own.by_gel @ gel[: own.by_gel.shape[1]] + amplitudes @ rows
            after += float(pair.excess(own.residual - change).sum())
        shares.append(max(-_WIDEST, min(_WIDEST, 1.0 - after / before)))
        done = number + 1
        report_progress(
            progress, f"placebo {done}/{count}", step="placebo", done=done, of=count
        )
    return tuple(sorted(shares))


def _random_changes(
    line: Linearisation, weights: Float[Tensor, "effects knots"]
) -> Float[Tensor, "effects experiments frames"]:
    """Changes of the curves by random smooth functions of the phase: errors of time, and of the
    radius, in turn.
    """
    errors = smooth_errors(line, _KNOTS, _SMOOTH)
    kinds = errors[torch.arange(1, len(weights) + 1) % 2]
    return torch.einsum("nk,nket->net", weights, kinds)


def _select_random(
    line: Linearisation,
    weights: Float[Tensor, "effects knots"],
    rounds: int,
    of_frame: float,
    beside: BesideSlowNoise | None,
) -> tuple[Float[Tensor, "fitted"], Float[Tensor, "effects"]]:
    """Random effects chosen one after the other by their evidence, first beside slow noise where
    parts are: what they shift everything fitted beside them, and their amplitudes; 0 where none was
    chosen.

    An amplitude has a normal prior, by which the effect changes the data by ``of_frame`` sd, times
    the root of the number of frames.
    """
    offered = len(weights)
    changes = _random_changes(line, weights)
    rows = line.whiten(changes)
    size = of_frame * float(line.batch.mask.sum().sqrt())
    scale = size / rows.norm(dim=1, keepdim=True).clamp_min(1e-300)
    columns = torch.cat((rows * scale, -eye(offered)), 1)
    padded = torch.nn.functional.pad
    here = replace(
        line,
        residual=padded(line.residual, (0, offered)),
        fitted=padded(line.fitted, (0, 0, 0, offered)),
    )
    smooth = beside and beside.whiten(changes * scale[..., None])
    chosen: list[int] = []
    for _ in range(rounds):
        gains = []  # of the rules, in their order
        if beside is not None and smooth is not None:
            gains.append(beside.log_evidence_with(smooth) - beside.log_evidence)
        left = here.project_out(columns)
        square = left.square().sum(1)
        gains.append(0.5 * (left @ here.residual).square() / square - 0.5 * square.log())
        for gain in gains:
            gain[chosen] = -math.inf
        enough = [gain for gain in gains if float(gain.max()) >= EXPLAINS]
        if not enough:
            break
        best = int(enough[0].argmax())
        chosen.append(best)
        here = replace(here, fitted=torch.cat((here.fitted, columns[best][:, None]), 1))
        if beside is not None and smooth is not None:
            beside = beside.with_column(smooth[:, best])
    shift = here.to_shift @ here.residual
    before = line.fitted.shape[1]
    amplitudes = zeros(offered)
    amplitudes[chosen] = shift[before:] * scale[chosen, 0]
    # noise that depends on the radius leaves a step at the fit itself
    return shift[:before] - line.to_shift @ line.residual, amplitudes
