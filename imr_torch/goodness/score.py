"""Test for a gap: directed score tests on the residual of a fit, each in a few directions
orthogonal to those fitted.

A chi-square over all frames is nearly blind to a small effect, because it tests all directions at
once. A block tests the few directions in which something definite would show: each effect of the
library at a finite step, a generic stress law (:mod:`imr_torch.material.departures`), pressure pulses,
parameters that change in time or between designs, distortions of the output. The smallest p-value
over the blocks is calibrated against residuals drawn under the fitted model (Rao's score test;
parametric bootstrap: Davison & Hinkley, Bootstrap Methods and their Application, 1997, section
4.2).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.special import chdtri, chndtr
from torch import Tensor

from imr_torch.float64 import eye, linspace, ones, randn, tensor
from imr_torch.goodness.linear import Linearisation, predict_changes
from imr_torch.goodness.phases import noise_shares, phase_numbers
from imr_torch.material import Effect
from imr_torch.observe import ExperimentBatch
from imr_torch.random import generator
from imr_torch.types import Directions, DirectionsByName, ExperimentFrames, Values

LEVEL = 0.04
"""Chance of a gap being found where there is none."""
ADEQUATE = 0.05
"""P-value of the test at a fit with effects from which on that fit is adequate: the right effects fail it once in twenty."""

BOOTSTRAP = 2000
"""Simulated residuals behind a p value or an interval."""

LAW_STEPS = (
    ("law_stretch", 1e-3),
    ("law_stretch_squared", 3e-4),
    ("law_compression", 1e-3),
    ("law_compression_steep", 1e-5),
    ("law_velocity", 3e-3),
    ("law_velocity_squared", 1e-3),
    ("law_rate_squared", 1e-4),
)
"""Terms of the generic closure, and coefficients at which directions of ``STATE_LAW`` are taken."""
LEAST_LEFT = 1e-4
"""Part of a direction's square that must be left beside the fitted directions for it to be tested."""
EVERYTHING = "everything (chi-square)"
"""Name of the test of all residuals together, which only noise that is known allows."""
STATE_LAW = "generic stress law"
PULSES = "pressure pulses"
SHAPE = "shape of the output"
"""Names of generic blocks: of the generic closure, of pressure pulses, of the output's shape."""


@dataclass(frozen=True)
class Block:
    """Directions that are tested together.

    Args:
        name: what they stand for.
        directions: ``N x k`` tensor with orthonormal columns, beside the fitted directions; ``k =
            0`` if nothing is left.
        size: length of the longest direction before it was normalised: how many sd the effect would
            show at its step.
    """

    name: str
    directions: Float[Tensor, "rows rank"]
    size: float = math.nan


@dataclass(frozen=True)
class BlockResult:
    """The test of a block, a chi-square of ``rank`` degrees of freedom under the fitted model."""

    name: str
    rank: int
    p_value: float
    power: float


@dataclass(frozen=True)
class GapTest:
    """The result of all blocks together.

    Args:
        p_value: of the smallest block p-value, calibrated for the number of blocks.
        blocks: each block's own result, smallest p-value first.
        bias_sigma: root mean square of the residual beyond noise, in single-shot standard
            deviations; 0 if none. The noise of each phase counts as no more than the residuals
            leave room for (:func:`imr_torch.goodness.phases.noise_shares`).
        bias_radius: the same in R*.
    """

    p_value: float
    blocks: tuple[BlockResult, ...]
    bias_sigma: float
    bias_radius: float

    @property
    def found(self) -> bool:
        """Whether there is a gap at ``LEVEL``."""
        return self.p_value < LEVEL


def list_starts(effects: Sequence[Effect]) -> list[dict[str, float]]:
    """The parameters of each effect at each of its starts, one effect after the other."""
    return [
        dict(zip(effect.names, start, strict=True))
        for effect in effects
        for start in effect.starts
    ]


def effect_directions(effects: Sequence[Effect], line: Linearisation) -> DirectionsByName:
    """What each effect changes at each of its starts, whitened: name -> ``S x N``; zero for a start
    that fails.
    """
    rows = line.whiten(predict_changes(line, list_starts(effects)))
    rows = torch.where(rows.isfinite().all(1, keepdim=True), rows, 0.0)
    return split_by_effect(rows, effects)


def split_by_effect(rows: Directions, effects: Sequence[Effect]) -> DirectionsByName:
    """Rows of the starts of several effects, one effect after the other, by its name."""
    parts = rows.split([len(effect.starts) for effect in effects])
    return {effect.name: part for effect, part in zip(effects, parts, strict=True)}


def promising_starts(
    effect: Effect,
    rows: Float[Tensor, "starts rows"],
    line: Linearisation,
    *,
    small: float = 0.05,
    typical: tuple[float, float] = (0.5, 1.5),
) -> tuple[tuple[float, ...], ...]:
    """From where to fit an effect: next to its neutral value, and from larger ones.

    Where the data are sharp a start of typical size is far above the null fit, and may end there; a
    fit only descends, so one that starts beside the null fit ends below it. An effect whose slope
    vanishes at its neutral value is not seen from near it, so one more start, of the size that the
    residual asks for, suits an effect of one parameter. One with a shape (the frequency and phase
    of a sound field, say) has a minimum for each, and the most promising by this test need not be
    the best: all its starts are taken, but of two that change the curves in opposite ways
    (correlated by -.95) only the one that the residual asks for.

    Args:
        effect: the effect.
        rows: ``S x N`` tensor from :func:`effect_directions`.
        line: local sensitivities at the fit.
        small: amplitude of the first start over the effect's own: so near the null fit that a
            descent ends below that.
        typical: bounds of that of the second.
    """
    left = line.project_out(rows)
    square = left.square().sum(1).clamp_min(1e-300)
    amplitude = (left @ line.residual) / square
    gain = amplitude.clamp_min(0.0) * amplitude * square
    order = torch.argsort(-gain).tolist()
    best = order[0]
    other = next((i for i in order[1:2] if float(gain[i]) > 0.0), order[0])
    first, *shape = effect.starts[best]
    smallest = (small * first, *shape)
    if len({tuple(others) for _, *others in effect.starts}) > 1:
        unit = left / square.sqrt()[:, None]
        uphill = (amplitude < 0.0) & ((unit @ unit.mT).amin(1) < -0.95)
        kept = torch.nonzero(~uphill)[:, 0].tolist()
        return smallest, *(effect.starts[i] for i in kept)
    first, *shape = effect.starts[other]
    return smallest, (first * float(amplitude[other].clamp(*typical)), *shape)


def left_beside(rows: Directions, line: Linearisation) -> Directions:
    """What is left of whitened directions beside the fitted ones; those of which nothing is are
    dropped.
    """
    left = line.project_out(rows)
    return left[left.square().sum(1) > LEAST_LEFT * rows.square().sum(1).clamp_min(1e-300)]


def make_block(
    name: str, rows: Directions, line: Linearisation, *, rank: float = 1e-3
) -> Block:
    """A block from whitened directions ``k x N``: projected, then reduced to an orthonormal set,
    to which singular values below a share of ``rank`` of the largest add nothing.
    """
    left = left_beside(rows, line)
    if not len(left):
        return Block(name, line.residual.new_zeros(len(line.residual), 0))
    size = float(left.norm(dim=1).max())
    left = left / left.norm(dim=1, keepdim=True)
    u, s, _ = torch.linalg.svd(left.mT, full_matrices=False)
    return Block(name, u[:, s > rank * s[0]], size)


def generic_blocks(line: Linearisation) -> list[Block]:
    """Blocks that stand for no effect in particular (:func:`generic_rows`)."""
    return [make_block(name, rows, line) for name, rows in generic_rows(line).items()]


def generic_rows(line: Linearisation) -> DirectionsByName:
    """Whitened rows that stand for no effect: generic stress laws, pulses, drifting parameters,
    distorted output.
    """
    batch = line.batch
    experiments = len(batch.experiments)
    times = batch.times
    last = float(times[batch.mask].max())
    laws = [{name: step} for name, step in LAW_STEPS]
    changes = [*pulse_changes(batch), *laws]
    rows = line.whiten(predict_changes(line, changes).nan_to_num())
    pulses = rows[: -len(laws)]
    data = times.numel()
    gel = line.pad_rows(line.fitted[:data, : line.near.posterior.size].mT)
    early = line.pad_rows((times < 0.5 * last).flatten().to(gel))
    found = {
        STATE_LAW: rows[-len(laws) :],
        PULSES: pulses,
        "parameters early against late": gel * early,
        SHAPE: shape_rows(line),
    }
    if experiments > 1:
        one = eye(experiments)
        masks = line.pad_rows(one.repeat_interleave(times.shape[1], 1))
        found["parameters between designs"] = (masks[:, None] * gel).flatten(0, 1)
        found["pressure pulses in single experiments"] = (masks[:, None] * pulses).flatten(
            0, 1
        )
    return found


def pulse_changes(batch: ExperimentBatch, count: int = 8) -> list[dict[str, float]]:
    """Parameters of small pressure pulses side by side over the records."""
    last = float(batch.times[batch.mask].max())
    width = math.log(0.5 * last / count)
    centres = linspace(0.1, 0.9, count) * last
    return [
        {"pulse": 0.01, "pulse_time": t, "pulse_width": width} for t in centres.tolist()
    ]


def shape_rows(line: Linearisation) -> Float[Tensor, "3 rows"]:
    """``dR/dt``, ``t dR/dt`` and ``d2R/dt2`` of the prediction, by differences between frames.

    ``3 x N``.
    """
    times = line.batch.times
    slope = differentiate(line.prediction, times)
    return line.whiten(torch.stack((slope, times * slope, differentiate(slope, times))))


def differentiate(curves: ExperimentFrames, times: ExperimentFrames) -> ExperimentFrames:
    """Derivatives ``E x T`` of curves by time, by differences between frames."""
    slopes = [
        torch.gradient(r, spacing=(t,))[0] for r, t in zip(curves, times, strict=True)
    ]
    return torch.stack(slopes)


def gap_test(blocks: Sequence[Block], line: Linearisation, *, seed: int) -> GapTest:
    """Test all blocks, and everything at once by chi-square; calibrate the smallest p-value.

    Args:
        blocks: what is tested; a block with no direction left is skipped.
        line: local sensitivities at the fit.
        seed: of the residuals drawn under the fitted model.
    """
    tested = [b for b in blocks if b.directions.shape[1]]
    source = generator(seed)
    ratios = line.noise_ratios(BOOTSTRAP, generator=source)
    rows = torch.cat((line.residual[None], _drawn_residuals(line, ratios, source)))
    few = ratios[:500].square()  # noise laws over which the p-value of a block is averaged
    entries = [
        (
            b.name,
            b.size,
            b.directions.shape[1],
            (rows @ b.directions).square().sum(1),
            (few @ b.directions.square()).mean(1),
        )
        for b in tested
    ]
    # noise that was inferred from these residuals cannot judge their sum of squares
    if line.batch.noise_laws is None or not tested:
        # as many degrees of freedom as frames, since every fitted direction has a prior
        frames = int(line.batch.mask.sum())
        one = ones(1)
        entries.append((EVERYTHING, math.nan, frames, rows.square().sum(1), one))
    logs = torch.stack([log_survival(square, rank) for _, _, rank, square, _ in entries])
    smallest = logs.amin(0)
    threshold = float(smallest[1:].quantile(LEVEL).exp())
    results = [
        BlockResult(
            name,
            rank,
            float(log_survival(square[0] / scales, rank).exp().mean()),
            _detection_power(size, rank, threshold),
        )
        for name, size, rank, square, scales in entries
    ]
    count = int((smallest[1:] <= smallest[0]).sum())
    bonferroni = min(1.0, len(results) * min(result.p_value for result in results))
    # p-values that the bootstrap cannot resolve: Bonferroni's bound
    p_value = (
        (1 + count) / (1 + BOOTSTRAP) if count else min(bonferroni, 1.0 / (1 + BOOTSTRAP))
    )
    return GapTest(
        p_value, tuple(sorted(results, key=lambda r: r.p_value)), *_bias_beyond_noise(line)
    )


def log_survival(statistic: Values, rank: int) -> Values:
    """Log of the upper tail of chi-square."""
    tail = torch.special.gammaincc(tensor(0.5 * rank), 0.5 * statistic)
    # far out the leading term of the asymptotic series keeps the order of the blocks
    x = 0.5 * statistic
    a = 0.5 * rank
    far = (a - 1.0) * x.clamp_min(1e-300).log() - x - math.lgamma(a)
    return torch.where(tail > 1e-250, tail.clamp_min(1e-300).log(), far)


def _drawn_residuals(
    line: Linearisation, ratios: Tensor, source: torch.Generator, *, sure: float = 2.0
) -> Tensor:
    """Residuals drawn under the fitted model, ``B x N``.

    Where the noise was inferred from the residuals themselves, drawn ones get the mean square of
    those observed: under the model that says nothing of their direction, so the test holds whatever
    the scale of the noise. A mean square that is larger than the uncertainty of the scale allows is
    a misfit, and counts as no larger than that: ``sure`` standard deviations.
    """
    drawn = randn(ratios.shape, generator=source)
    laws = line.batch.noise_laws
    rows = line.project_out(drawn * ratios)
    if laws is None or not laws.of_residuals:
        return rows
    frames = float(line.batch.mask.sum())
    largest = frames * math.exp(2.0 * sure * laws.log_scale_sd)
    square = min(float(line.residual.square().sum()), largest)
    return rows * (square / rows.square().sum(1, keepdim=True)).sqrt()


def _detection_power(size: float, rank: int, level: float) -> float:
    """Chance that a block of this size in sd is found at a level: normal approximation of
    noncentral chi-square.
    """
    if math.isnan(size):
        return math.nan
    return 1.0 - float(chndtr(chdtri(rank, level), rank, size**2))


def _bias_beyond_noise(line: Linearisation) -> tuple[float, float]:
    """Root mean square of the residual beyond noise: in single-shot sd and in R*."""
    batch = line.batch
    frames = batch.mask.sum()
    residual = torch.where(batch.mask, batch.mean - line.prediction, 0.0)
    phase = torch.where(
        batch.mask, phase_numbers(batch.times, line.prediction, batch.mask), -1
    )
    own = noise_shares([batch.whiten(residual, line.sd).square()], phase) * (
        1.0 - line.fitted.shape[1] / len(line.residual)
    )
    # variance of the mean, less what the fit absorbs
    own = torch.where(batch.mask, own / batch.counts.clamp_min(1.0), 0.0)
    excess = ((residual / line.sd).square() - own).sum() / frames
    radius = (residual.square() - own * line.sd.square()).sum() / frames
    return float(excess.clamp_min(0.0).sqrt()), float(radius.clamp_min(0.0).sqrt())
