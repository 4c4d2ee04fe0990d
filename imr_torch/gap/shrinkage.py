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
from scipy.special import chdtrc
from torch import Tensor

from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.held_out import HeldOut, Judged, judge_designs
from imr_torch.gap.hypotheses import EXPLAINS
from imr_torch.goodness.linear import Linearisation
from imr_torch.goodness.phases import PHASES, noise_shares, phase_clock, phase_numbers
from imr_torch.goodness.score import ADEQUATE
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

TURN = 1.5
"""Reading of the phase clock at the first rebound's maximum."""
_DRAWS = 2000  # of the interval
_MANY = 5  # curves from which on they are drawn anew; of fewer, the phases of each
_WIDEST = 2.0  # size of S beyond which the base leaves almost no gap to reduce
_KNOTS = torch.arange(0.0, 5.0, 0.15, dtype=torch.float64)  # of a random function of the phase
_SMOOTH = 0.3  # its length on the phase clock


@dataclass(frozen=True)
class Shrinkage:
    """How far the gap shrinks on unseen curves.

    Args:
        share: 5, 50, 95 % of ``S``, by the scatter between curves (between phases of a curve where
            there are fewer than five); None where the directions that are removed leave no gap.
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
        return round(float(torch.tensor(self.placebo, dtype=torch.float64).quantile(0.95)), 6)

    def word(self, adequacy: float) -> str:
        """``"closed"``, ``"partly closed"``, ``"not closed"`` or ``"no gap left"``.

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
        return "partly closed" if low > 0.0 and middle > self.placebo_high else "not closed"


def shrinkage(
    report: GapReport,
    simulator: Simulator,
    unseen: ExperimentBatch | None = None,
    *,
    placebos: int = 20,
    seed: int = 0,
    progress: Progress | None = None,
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
    judged = judge_designs(report, simulator, unseen, seed=child(seed, "judge"), progress=progress)
    if not judged:
        return None
    pairs = [_compared(pair) for pair in judged]
    source = generator(child(seed, "interval"))
    base_gap = float(torch.cat([pair.base for pair in pairs]).sum())
    count = sum(pair.frames for pair in pairs)
    base_p = float(
        chdtrc(sum(pair.freedom for pair in pairs), sum(pair.base_square for pair in pairs))
    )
    left = base_p < ADEQUATE and base_gap > 0.0
    later = [pair.later for pair in pairs if pair.later is not None]
    later_base = [base for base, _ in later]
    later_effect = [effect for _, effect in later]
    return Shrinkage(
        share=_interval([p.base for p in pairs], [p.effect for p in pairs], source)
        if left
        else None,
        later=_interval(later_base, later_effect, source)
        if left and later and float(torch.cat(later_base).sum()) > 0.0
        else None,
        placebo=_placebo(report, pairs, placebos, child(seed, "placebo")) if left else (),
        base_gap=base_gap / count,
        base_p=base_p,
        selected=tuple(pair.effect.hypothesis.parts for pair in judged),
        converged=all(pair.base.converged and pair.effect.converged for pair in judged),
    )


@dataclass(frozen=True)
class _Compared:
    """A design judged: the projector beside the directions that are removed, the squares that noise
    leaves in each frame, and squares beyond these by phase, without and with what was selected:
    all frames, and those after the turn.
    """

    pair: Judged
    beside: Tensor
    expected: Tensor
    base: Tensor
    effect: Tensor
    later: tuple[Tensor, Tensor] | None

    @property
    def frames(self) -> int:
        """How many frames the design has."""
        return len(self.expected)

    @property
    def base_square(self) -> float:
        """Squared residual of the base model beside the directions that are removed."""
        return float((self.beside @ self.pair.base.residual).square().sum())

    @property
    def freedom(self) -> float:
        """Degrees of freedom of that square."""
        return float(self.beside.diagonal().sum())

    def excess(self, residual: Tensor) -> Float[Tensor, "frames"]:
        """Squares of a residual beyond noise, in single-shot variances."""
        counts = self.pair.base.line.batch.counts[0]
        return ((self.beside @ residual).square() - self.expected) / counts


def _compared(pair: Judged) -> _Compared:
    phase = _phases(pair.base)
    beside = beside_nuisances(pair)
    held = (pair.base, pair.effect)
    share = noise_shares([one.residual.square() for one in held], phase)
    counts = pair.base.line.batch.counts[0]
    nothing = torch.zeros(0, dtype=torch.float64)
    found = _Compared(pair, beside, share * beside.square().sum(1), nothing, nothing, None)
    base, effect = (_by_phase(found.excess(one.residual), phase) for one in held)
    early = _clock(pair.base) <= TURN
    later = None
    if bool(early.any()) and not bool(early.all()):
        both = [_later(one, early, share) / counts[~early] for one in held]
        later = (_by_phase(both[0], phase[~early]), _by_phase(both[1], phase[~early]))
    return replace(found, base=base, effect=effect, later=later)


def beside_nuisances(pair: Judged) -> Float[Tensor, "frames frames"]:
    """Projector beside all that is the curve's own under either model."""
    directions = torch.cat((pair.base.by_nuisance, pair.effect.by_nuisance), 1)
    basis, size, _ = torch.linalg.svd(directions, full_matrices=False)
    kept = basis[:, size > 1e-6 * size[:1]]
    return torch.eye(len(directions), dtype=torch.float64) - kept @ kept.mT


def _later(own: HeldOut, early: Tensor, share: Tensor) -> Tensor:
    """Squares beyond noise after the turn, with what is the curve's own fitted before it."""
    centred = own.residual + own.by_nuisance @ own.nuisances
    before = own.by_nuisance[early]
    precision = torch.eye(before.shape[1], dtype=torch.float64) + before.mT @ before
    fitted = torch.linalg.solve(precision, before.mT @ centred[early])
    after = own.by_nuisance[~early]
    expected = share[~early] + (after @ torch.linalg.inv(precision) * after).sum(1)
    return (centred[~early] - after @ fitted).square() - expected


def _phases(own: HeldOut) -> Tensor:
    batch = own.line.batch
    return phase_numbers(batch.times, batch.mean, batch.mask)[0]


def _clock(own: HeldOut) -> Tensor:
    batch = own.line.batch
    return phase_clock(batch.times, batch.mean, batch.mask)[0]


def _by_phase(squares: Tensor, phase: Tensor) -> Tensor:
    return torch.zeros(len(PHASES), dtype=torch.float64).index_add(0, phase, squares)


def _interval(
    base: Sequence[Tensor], effect: Sequence[Tensor], source: torch.Generator
) -> tuple[float, float, float]:
    """5, 50, 95 % of ``1 - sum(effect) / sum(base)`` over curves, or over phases of few curves,
    drawn anew.

    One unit fewer than there are is drawn with replacement (Rao & Wu, J. Am. Stat. Assoc. 83,
    1988). A draw in which the base leaves no gap counts as -1 for the lower bound and as 1 for the
    upper; none counts as more than 2 in size.
    """
    rows = torch.stack([torch.stack(list(pair)) for pair in zip(base, effect, strict=True)])
    units = rows.sum(2) if len(rows) >= _MANY else rows.movedim(1, 2).flatten(0, 1)
    units = units[(units != 0.0).any(1)]
    count = len(units)
    picked = torch.randint(count, (_DRAWS, max(count - 1, 1)), generator=source)
    weights = torch.nn.functional.one_hot(picked, count).sum(1).to(torch.float64)
    without, with_effect = (weights @ units).unbind(1)
    ratio = torch.where(without > 0.0, 1.0 - with_effect / without.clamp_min(1e-300), torch.nan)
    ratio = ratio.clamp(-_WIDEST, _WIDEST)
    low = float(ratio.nan_to_num(nan=-1.0).quantile(0.05))
    high = float(ratio.nan_to_num(nan=1.0).quantile(0.95))
    total = units.sum(0)
    middle = float((1.0 - total[1] / total[0]).clamp(-_WIDEST, _WIDEST))
    return min(low, middle), middle, max(high, middle)


def _placebo(
    report: GapReport, compared: Sequence[_Compared], count: int, seed: int
) -> tuple[float, ...]:
    """``S`` of random libraries, sorted: the procedure where no candidate is the cause."""
    directions = report.left.directions
    first = report.steps[0]
    offered = len(first.hypotheses) - 1
    rounds = len(report.selected.effects)
    sizes = [rows.norm(dim=1).mean() for rows in directions.values() if len(rows)]
    typical = float(torch.stack(sizes).median()) if sizes else 1.0
    whole = int(report.batch.mask.sum())
    shares = []
    for number in range(count):
        source = generator(child(seed, number))
        weights = torch.randn(offered, len(_KNOTS), generator=source, dtype=torch.float64)
        in_time = torch.arange(offered) % 2 == 0
        before = 0.0
        after = 0.0
        known = dict[int, tuple[list[int], Tensor, Tensor]]()
        for one in compared:
            pair = one.pair
            key = id(pair.training)
            if key not in known:
                frames = int(pair.training.batch.mask.sum())
                size = typical * math.sqrt(frames / whole)
                rows = _random_rows(pair.training, weights, in_time)
                scale = size / rows.norm(dim=1, keepdim=True).clamp_min(1e-300)
                chosen, shift = _select_rows(rows * scale, pair.training, rounds)
                known[key] = chosen, shift, scale[:, 0]
            chosen, shift, scale_each = known[key]
            change = _predicted_change(pair, chosen, shift, scale_each, weights, in_time)
            before += float(one.base.sum())
            after += float(one.excess(pair.base.residual - change).sum())
        shares.append(max(-_WIDEST, min(_WIDEST, 1.0 - after / before)))
    return tuple(sorted(shares))


def _random_rows(
    line: Linearisation, weights: Float[Tensor, "effects knots"], in_time: Tensor
) -> Float[Tensor, "effects rows"]:
    """Whitened changes by random smooth functions of the phase: errors of the radius, or of time."""
    batch: ExperimentBatch = line.batch
    clock = phase_clock(batch.times, line.prediction, batch.mask)
    bumps = (-0.5 * ((clock[..., None] - _KNOTS) / _SMOOTH).square()).exp()
    smooth = torch.einsum("etk,nk->net", bumps, weights)
    slope = torch.stack(
        [
            torch.gradient(r, spacing=(t,))[0]
            for r, t in zip(line.prediction, batch.times, strict=True)
        ]
    )
    return line.whiten(torch.where(in_time[:, None, None], smooth * slope, smooth))


def _select_rows(
    rows: Float[Tensor, "effects rows"], line: Linearisation, rounds: int
) -> tuple[list[int], Float[Tensor, "fitted"]]:
    """Random effects chosen one after the other by their evidence, and the shift of everything
    fitted with them, their amplitudes last; amplitudes have a standard normal prior.
    """
    chosen: list[int] = []
    here = line
    for _ in range(rounds):
        left = here.project(_padded(rows, here))
        square = left.square().sum(1)
        gain = 0.5 * (left @ here.residual).square() / (1.0 + square) - 0.5 * torch.log1p(square)
        gain[chosen] = -math.inf
        best = int(gain.argmax())
        if float(gain[best]) < EXPLAINS:
            break
        chosen.append(best)
        here = _with_row(here, _padded(rows[best : best + 1], here)[0])
    return chosen, here.to_shift @ here.residual


def _padded(rows: Tensor, line: Linearisation) -> Tensor:
    return torch.nn.functional.pad(rows, (0, len(line.residual) - rows.shape[-1]))


def _with_row(line: Linearisation, row: Tensor) -> Linearisation:
    """A linearisation with one more fitted amplitude, its prior a row more."""
    fitted = torch.cat((line.fitted, row[:, None]), 1)
    prior = torch.zeros(1, fitted.shape[1], dtype=torch.float64)
    prior[0, -1] = -1.0
    residual = torch.cat((line.residual, torch.zeros(1, dtype=torch.float64)))
    return replace(line, residual=residual, fitted=torch.cat((fitted, prior)))


def _predicted_change(
    pair: Judged,
    chosen: Sequence[int],
    shift: Tensor,
    scale: Tensor,
    weights: Tensor,
    in_time: Tensor,
) -> Tensor:
    """What the random effects that were chosen change in the prediction of a held-out curve, with
    the gel that is refitted beside them.
    """
    own = pair.base
    data = len(own.residual)
    change = own.by_gel @ shift[: own.by_gel.shape[1]]
    if chosen:
        rows = _random_rows(own.line, weights[chosen], in_time[chosen])[:, :data]
        change = change + (shift[-len(chosen) :] * scale[chosen]) @ rows
    return change
