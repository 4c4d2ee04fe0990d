"""The noise of single frames, inferred about a fit in such a way that a misfit of the model is not taken for noise.

A misfit is smooth from frame to frame, but next to a collapse, where the radius itself bends within a frame. So the residual of
a fit is taken as the sum of four things: what the gel and the nuisances can still move; a smooth deviation of unknown size and
duration (a Gaussian process with Matern-3/2 covariance, of each curve its own); a deviation in proportion to how much the curve
bends between neighbouring frames; and noise that is independent between frames, whose law is wanted. All but the last are
integrated out. Where the model is right the posterior of the law is that of its residuals (restricted maximum likelihood);
where it is not, the smooth deviation takes the misfit up, and the law is what the roughness of the curves says.

Where designs were repeated, the repeats decide: their deviations from their mean hold the camera's noise alone.

The law is ``scale * sqrt((slope |R*-1| + drift t*)^2 + floor^2)`` with free proportions. One curve whose noise is not that of
the others gets a factor of its own. Gaussian processes by their state space: Hartikainen & Sarkka, IEEE MLSP 2010.
"""

import math
from dataclasses import dataclass, field, replace
from itertools import product

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.noise_law import LocalNoise, NoiseGrid, best_scales
from imr_torch.assimilate.noise_prior import NoisePrior
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.observe import ExperimentBatch, Noise, NoiseLaws

MATERN = 2.146193
"""Rate of a Matern-3/2 covariance times the lag at which it has fallen to 1/e."""

_FRAMES = 400  # of a longer record every second, third, ... frame is used
_AT_ONCE = 1500  # combinations filtered side by side
_KEPT = 1e-4  # weight over the largest from which on a law is kept
_OWN_SD = 0.7  # prior standard deviation of the logarithm of one curve's own noise factor
_SPIKE = 8.0 * 1.482602  # times the median distance of a frame from its neighbours, beyond which it is spoilt
_AROUND = 10  # frames on either side that say what is usual
_SPIKES = 0.05  # share of the frames of a curve that may be
_FEWEST = 12  # frames that a curve needs for a factor of its own


@dataclass(frozen=True)
class FrameNoisePrior:
    """Prior of the noise of single frames, and of what else a residual may hold.

    Args:
        law: the published proportion of ``slope`` to ``drift``, about which others are tried.
        balances: factors on the published ratio of ``slope`` to ``drift``, with their probabilities; 0 is noise that grows with
            time alone, infinity noise that grows with ``|R* - 1|`` alone.
        floors: constant parts at scale 1, R*.
        level: prior median of the noise, root mean square over all frames in R*, and the standard deviation of its logarithm,
            which matters where there are few frames.
        least: smallest constant part, R*: bubbles are not computed more exactly than that.
        amounts: standard deviation of the smooth deviation, over that of the noise.
        durations: lag at which its correlation has fallen to 1/e, t*; never less than 2.5 frames.
        bends: deviations next to collapses, over the bend of the curve between neighbouring frames (at scale 1).
        none: probability that there is neither of these; a smooth one alone, one next to collapses alone and both are equally
            probable otherwise.
        own: probability that the noise of one curve differs from that of the others.

    >>> from imr_torch.assimilate.frame_noise import FrameNoisePrior
    >>> FrameNoisePrior().floors[0], FrameNoisePrior().durations
    (0.0005, (0.14, 0.3, 0.6, 1.2))
    """

    law: Noise = field(default_factory=Noise)
    balances: tuple[tuple[float, float], ...] = ((0.0, 0.1), (1.0 / 3.0, 0.15), (1.0, 0.5), (3.0, 0.15), (math.inf, 0.1))
    floors: tuple[float, ...] = tuple(0.0005 * 2.0**k for k in range(8))
    level: tuple[float, float] = (0.004, 1.5)
    least: float = 0.0003
    amounts: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    durations: tuple[float, ...] = (0.14, 0.3, 0.6, 1.2)
    bends: tuple[float, ...] = (0.05, 0.2, 0.8)
    none: float = 0.7
    own: float = 0.1


@dataclass(frozen=True)
class FrameNoise:
    """The noise of single frames.

    Args:
        law: central law: the most probable one, at the posterior mean of its logarithm at the frames.
        laws: the posterior.
        factors: of each experiment, its noise over the law; 1 where it is that of the others.
        factor_sds: standard deviations of their logarithms.
    """

    law: Noise
    laws: NoiseLaws
    factors: tuple[float, ...]
    factor_sds: tuple[float, ...]

    def applied(self, batch: ExperimentBatch) -> ExperimentBatch:
        """A batch of the same curves with this noise."""
        experiments = tuple(
            replace(e, noise_factor=factor, noise_factor_sd=sd)
            for e, factor, sd in zip(batch.curves, self.factors, self.factor_sds, strict=True)
        )
        return replace(batch, experiments=experiments, noise=self.law, noise_laws=self.laws)


def infer_frame_noise(near: Neighbourhood, prior: FrameNoisePrior | None = None) -> FrameNoise:
    """The posterior of the noise law about a fit.

    Args:
        near: the fitted point with its local sensitivities; its batch holds curves only.
        prior: of the law.
    """
    prior, batch = prior or FrameNoisePrior(), near.posterior.batch
    if all(e.repeats > 1 for e in batch.curves):
        return _of_repeats(batch, prior.law)
    grid = _Grid.of(near, prior)
    factors = torch.ones(len(near.centre), dtype=torch.float64)
    sds = torch.zeros_like(factors)
    found = grid.posterior(factors)
    while len(factors) > 1 and bool((factors == 1.0).sum() > 1):
        other = grid.outlier(found, factors, prior.own)
        if other is None:
            break
        experiment, log_factor, sd = other
        factors[experiment] *= math.exp(log_factor)
        sds[experiment] = sd
        found = grid.posterior(factors)
    return grid.concluded(found, factors, sds)


def _of_repeats(batch: ExperimentBatch, law: Noise) -> FrameNoise:
    """The most probable law of the deviations of repeats from their mean, independent or correlated between frames."""
    grid = NoiseGrid.of(NoisePrior(law))
    if any(e.has_gaps for e in batch.curves):
        grid = grid[grid.times == 0.0]
    square, normaliser = (x.sum(-1) for x in grid.terms(batch, batch.mean))
    repeats = sum(float((e.counts - 1).sum()) for e in batch.curves)
    value = -0.5 * repeats * square.log() - repeats / float(batch.sizes.sum()) * normaliser + grid.log_prior
    best = int(value.argmax())
    found = replace(
        grid.law,
        scale=math.sqrt(float(square[best]) / repeats),
        floor=float(grid.floors[best]),
        correlation_time=float(grid.times[best]),
    )
    one, count = torch.ones(1, dtype=torch.float64), len(batch.curves)
    laws = NoiseLaws((found,), one, one / math.sqrt(2.0 * repeats), of_residuals=False)
    return FrameNoise(found, laws, (1.0,) * count, (0.0,) * count)


@dataclass(frozen=True)
class _Found:
    """Log weights of all combinations, and their log scales with standard deviations: ``J`` tensors."""

    log_weights: Tensor
    log_scales: Tensor
    sds: Tensor


@dataclass(frozen=True)
class _Grid:
    """All combinations of laws and deviations: ``J`` rows of ``values``.

    Args:
        near: the fitted point.
        prior: of the law.
        values: ``J x 6`` tensor: slope, drift, floor, amount and duration of the smooth deviation, bend; at scale 1.
        log_prior: ``J`` tensor.
        rows: frames that are used, ``E x T`` boolean tensor.
        bend: ``E x T`` tensor, how far each frame lies off the cubic through its neighbours, in the fitted curve.
    """

    near: Neighbourhood
    prior: FrameNoisePrior
    values: Tensor
    log_prior: Tensor
    rows: Tensor
    bend: Tensor

    @classmethod
    def of(cls, near: Neighbourhood, prior: FrameNoisePrior) -> "_Grid":
        """The grid about one point."""
        batch, rows, logs = near.posterior.batch, [], []
        spacing = torch.cat([e.times.diff() for e in batch.curves]).median()
        smooth = [(a, max(d, 2.5 * float(spacing))) for a, d in product(prior.amounts, prior.durations)]
        third = (1.0 - prior.none) / 3.0
        deviations = [(0.0, 1.0, 0.0, prior.none)]
        deviations += [(amount, duration, 0.0, third / len(smooth)) for amount, duration in smooth]
        deviations += [(0.0, 1.0, bend, third / len(prior.bends)) for bend in prior.bends]
        both = third / (len(smooth) * len(prior.bends))
        deviations += [(*one, bend, both) for one, bend in product(smooth, prior.bends)]
        for (balance, weight), floor, (*deviation, share) in product(prior.balances, prior.floors, deviations):
            rows.append((*_balanced(prior.law, balance), floor, *deviation))
            logs.append(math.log(weight * share / len(prior.floors)))
        values = torch.tensor(rows, dtype=torch.float64)
        kept = _thinned(batch.mask)
        return cls(near, prior, values, torch.tensor(logs, dtype=torch.float64), kept, _bends(batch, near.centre))

    def variance(self, values: Tensor) -> Tensor:
        """``J x E x T`` tensor, variance of the noise at scale 1, without that of deviations."""
        slope, drift, floor = (values[:, i, None, None] for i in range(3))
        batch, radius = self.near.posterior.batch, self.near.centre
        return (slope * (radius - 1.0).abs() + drift * batch.times).square() + floor.square()

    def mean_square(self, values: Tensor, factors: Tensor) -> Tensor:
        """``J`` tensor, mean of that over the frames that are used."""
        return (self.variance(values) * factors[:, None].square() * self.rows).sum((1, 2)) / self.rows.sum()

    def whitened(self, values: Tensor, factors: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Columns ``C x E x T`` under each combination, ``J x C x E x T``, and half the log determinants, ``J x E``."""
        noise = self.variance(values) * factors[:, None].square()
        noise = noise + (values[:, 5, None, None] * self.bend).square()
        smooth = values[:, 3].square() * self.mean_square(values, factors)
        return matern_whitened(self.near.posterior.batch.times, self.rows, noise, smooth, MATERN / values[:, 4], columns)

    def local(self, factors: Tensor) -> LocalNoise:
        """What the linearisation says of the data under each combination, at scale 1."""
        near, batch = self.near, self.near.posterior.batch
        by_gel, by_nuisance = (x.movedim(-1, 0) for x in near.slopes)
        columns = torch.cat(((batch.mean - near.centre)[None], by_gel, by_nuisance)) * batch.counts.sqrt()
        columns = torch.where(self.rows, columns, 0.0).nan_to_num()
        parts = []
        for some in self.values.split(_AT_ONCE):
            seen, log_det = self.whitened(some, factors, columns)
            residual, gel, nuisance = (x.movedim(1, -1) for x in seen.split((1, len(by_gel), len(by_nuisance)), 1))
            parts.append(
                (
                    residual.square().sum((1, 2, 3)),
                    log_det.sum(1),
                    -(gel.mT @ residual)[..., 0].sum(1),
                    -(nuisance.mT @ residual)[..., 0],
                    (gel.mT @ gel).sum(1),
                    nuisance.mT @ nuisance,
                    nuisance.mT @ gel,
                )
            )
        square, normaliser, *blocks = (torch.cat(x) for x in zip(*parts, strict=True))
        point = (near.point.gel, near.point.nuisances)
        return LocalNoise(square, normaliser, float(self.rows.sum()), NormalEquations(*blocks), point)

    def posterior(self, factors: Tensor) -> _Found:
        """Weights of all combinations, their scales integrated out."""
        local = self.local(factors)
        likely, widths = best_scales([local])
        median, wide = self.prior.level
        ahead = math.log(median) - 0.5 * self.mean_square(self.values, factors).log() - likely
        both = widths.square() + wide**2
        log_scales, sds = likely + widths.square() / both * ahead, widths * wide / both.sqrt()
        value = local.marginal(likely[:, None])[:, 0] + sds.log() - 0.5 * ahead.square() / both + self.log_prior
        too_small = log_scales + self.values[:, 2].log() < math.log(self.prior.least)
        if not bool(too_small.all()):
            value = torch.where(too_small, -torch.inf, value)
        return _Found(value - value.logsumexp(0), log_scales, sds)

    def outlier(self, found: _Found, factors: Tensor, chance: float) -> tuple[int, float, float] | None:
        """The experiment whose noise most clearly differs from that of the others: number, log factor and its sd."""
        batch, best = self.near.posterior.batch, int(found.log_weights.argmax())
        residual = torch.where(self.rows, batch.mean - self.near.centre, 0.0) * batch.counts.sqrt()
        seen, _ = self.whitened(self.values[best : best + 1], factors, residual[None])
        square = seen[0, 0].square().sum(-1)
        by_gel, by_nuisance = self.near.slopes
        fitted = by_gel.shape[-1] / len(square) + by_nuisance.shape[-1]
        count = (self.rows.sum(1) - fitted).clamp_min(1.0)
        others = square.sum() - square, count.sum() - count
        log_factor = 0.5 * (square / count / (others[0] / others[1])).log()
        variance = 0.5 / count + 0.5 / others[1]
        wide = variance + _OWN_SD**2
        gain = 0.5 * log_factor.square() * (1.0 / variance - 1.0 / wide) - 0.5 * (wide / variance).log()
        gain = torch.where((self.rows.sum(1) >= _FEWEST) & (factors == 1.0), gain, -torch.inf)
        first = int(gain.argmax())
        if float(gain[first]) < math.log((1.0 - chance) / chance * len(square)):
            return None
        return first, float(log_factor[first]), math.sqrt(float(variance[first]))

    def concluded(self, found: _Found, factors: Tensor, factor_sds: Tensor) -> FrameNoise:
        """Laws alike in all but their deviations together, and the central one."""
        laws, weights, sds = [], [], []
        keys, group = self.values[:, :3].unique(dim=0, return_inverse=True)
        for number, (slope, drift, floor) in enumerate(keys.tolist()):
            own = (group == number) & torch.isfinite(found.log_weights)
            if not bool(own.any()):
                continue
            total = float(found.log_weights[own].logsumexp(0))
            share = torch.softmax(found.log_weights[own], 0)
            centre = float(share @ found.log_scales[own])
            spread = float(share @ (found.sds[own].square() + (found.log_scales[own] - centre).square()))
            laws.append(replace(self.prior.law, scale=math.exp(centre), slope=slope, drift=drift, floor=floor))
            weights.append(total)
            sds.append(math.sqrt(spread))
        shares = torch.softmax(torch.tensor(weights, dtype=torch.float64), 0)
        kept = torch.nonzero(shares > _KEPT * shares.max())[:, 0].tolist()
        chosen = tuple(laws[i] for i in kept)
        share = shares[kept] / shares[kept].sum()
        laws_known = NoiseLaws(chosen, share, torch.tensor(sds, dtype=torch.float64)[kept])
        batch, radius = self.near.posterior.batch, self.near.centre
        logs = torch.stack([law.sd(radius, batch.times)[self.rows].log() for law in chosen])
        best = int(share.argmax())
        shift = float((share @ logs - logs[best]).mean())
        law = replace(chosen[best], scale=chosen[best].scale * math.exp(shift))
        return FrameNoise(law, laws_known, tuple(factors.tolist()), tuple(factor_sds.tolist()))


def without_spikes(near: Neighbourhood) -> Bool[Tensor, "experiments frames"]:
    """Frames without those that single errors of the camera have spoilt.

    A frame is left out where the residual stands off the cubic through its neighbours by more than eight times what is usual
    (in R* about that time, and over the law of the batch in the whole curve), by more than the fitted curve bends there, and
    farther than any other frame; then the next one is looked for.

    Args:
        near: a fitted point; its batch holds curves of one repeat.
    """
    batch = near.posterior.batch
    law, bends, kept = batch.sd(near.centre), _bends(batch, near.centre), batch.mask.clone()
    for row in range(len(kept)):
        most = max(1, int(_SPIKES * float(batch.mask[row].sum())))
        for _ in range(most):
            frames = torch.nonzero(kept[row])[:, 0]
            if len(frames) < _FEWEST:
                break
            residual = (batch.mean - near.centre)[row, frames].unfold(0, 5, 1)
            weights = lagrange_weights(batch.times[row, frames].unfold(0, 5, 1))
            off = (weights * residual).sum(1).abs()
            over_law = off / (weights * law[row, frames].unfold(0, 5, 1)).norm(dim=1)
            own = torch.minimum(off / _running_median(off), over_law / over_law.median().clamp_min(1e-300))
            own = torch.where(off > bends[row, frames][2:-2], own, 0.0)
            worst = int(own.argmax())
            if float(own[worst]) < _SPIKE:
                break
            kept[row, frames[worst + 2]] = False
    return kept


def _running_median(values: Tensor) -> Tensor:
    """Median of each value and ten on either side, as many as there are at the ends; never zero."""
    padded = torch.nn.functional.pad(values, (_AROUND, _AROUND), value=math.nan)
    return padded.unfold(0, 2 * _AROUND + 1, 1).nanmedian(1).values.clamp_min(1e-300)


def _balanced(law: Noise, balance: float) -> tuple[float, float]:
    """Slope and drift whose ratio is ``balance`` times that of a law."""
    if math.isinf(balance):
        return law.slope, 0.0
    if balance == 0.0:
        return 0.0, law.drift
    return law.slope * math.sqrt(balance), law.drift / math.sqrt(balance)


def _thinned(mask: Tensor) -> Tensor:
    """Frames that are used: all of short records."""
    stride = -(-int(mask.sum(1).max()) // _FRAMES)
    return mask & (torch.arange(mask.shape[1]) % stride == 0)


def _bends(batch: ExperimentBatch, radius: Tensor) -> Tensor:
    """How far a frame lies off the cubic through two neighbours on either side, the largest of three frames: ``E x T``."""
    bends = torch.zeros_like(radius)
    for row, (times, curve, mask) in enumerate(zip(batch.times, radius, batch.mask, strict=True)):
        count = int(mask.sum())
        if count < 5:
            continue
        t, r = times[:count].unfold(0, 5, 1), curve[:count].unfold(0, 5, 1)
        off = (lagrange_weights(t) * r).sum(1).abs()
        padded = torch.cat((off[:1].expand(3), off, off[-1:].expand(3)))
        bends[row, :count] = padded.unfold(0, 3, 1).amax(1)
    return bends


def lagrange_weights(times: Float[Tensor, "windows 5"]) -> Float[Tensor, "windows 5"]:
    """Weights of the frames of each window: 1 for the centre, minus Lagrange's basis at its time for the neighbours."""
    weights, centre = torch.ones_like(times), times.shape[1] // 2
    others = [i for i in range(times.shape[1]) if i != centre]
    for i in others:
        factors = [(times[:, centre] - times[:, j]) / (times[:, i] - times[:, j]) for j in others if j != i]
        weights[:, i] = -torch.stack(factors).prod(0)
    return weights


def matern_whitened(
    times: Float[Tensor, "experiments frames"],
    mask: Bool[Tensor, "experiments frames"],
    noise: Float[Tensor, "laws experiments frames"],
    smooth: Float[Tensor, "laws"],
    rates: Float[Tensor, "laws"],
    columns: Float[Tensor, "columns experiments frames"],
) -> tuple[Float[Tensor, "laws columns experiments frames"], Float[Tensor, "laws experiments"]]:
    """Columns whitened under independent noise and a smooth Gaussian process, by Kalman filters side by side.

    Args:
        times: dimensionless, increasing.
        mask: frames that count.
        noise: variance of the independent noise.
        smooth: variance of the process, whose covariance is ``(1 + x) exp(-x)`` of it, ``x`` the rate times the lag.
        rates: of the process.
        columns: what is whitened.

    Returns:
        The whitened columns, 0 where the mask is not set, and half the log determinants of the covariances.
    """
    count, experiments, frames = noise.shape
    variance, rate = (x[:, None].expand(count, experiments) for x in (smooth, rates))
    bent = variance * rate.square()  # of the process's derivative
    value = torch.zeros(count, len(columns), experiments, dtype=torch.float64)
    slope = torch.zeros_like(value)
    p00, p01, p11 = variance, torch.zeros_like(variance), bent
    seen = torch.zeros(count, len(columns), experiments, frames, dtype=torch.float64)
    log_det = torch.zeros_like(variance)
    gaps = torch.nn.functional.pad(times.diff(dim=1), (1, 0))
    for k in range(frames):
        if k:
            x = rate * gaps[:, k]
            decay = torch.exp(-x)
            a00, a01 = decay * (1.0 + x), decay * gaps[:, k]
            a10, a11 = -decay * rate * x, decay * (1.0 - x)
            value, slope = (
                a00[:, None] * value + a01[:, None] * slope,
                a10[:, None] * value + a11[:, None] * slope,
            )
            q00, q11 = p00 - variance, p11 - bent  # what the last frame told, carried on to this one
            p00, p01, p11 = (
                variance + a00 * a00 * q00 + 2.0 * a00 * a01 * p01 + a01 * a01 * q11,
                a00 * a10 * q00 + (a00 * a11 + a01 * a10) * p01 + a01 * a11 * q11,
                bent + a10 * a10 * q00 + 2.0 * a10 * a11 * p01 + a11 * a11 * q11,
            )
        used = mask[:, k]
        total = p00 + noise[:, :, k]
        innovation = columns[None, :, :, k] - value
        seen[..., k] = torch.where(used, innovation * total.rsqrt()[:, None], 0.0)
        log_det = log_det + torch.where(used, 0.5 * total.log(), 0.0)
        g0, g1 = torch.where(used, p00 / total, 0.0), torch.where(used, p01 / total, 0.0)
        value, slope = value + g0[:, None] * innovation, slope + g1[:, None] * innovation
        p00, p01, p11 = p00 - g0 * p00, p01 - g0 * p01, p11 - g1 * p01
    return seen, log_det
