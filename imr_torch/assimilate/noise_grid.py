"""All combinations of noise laws and smooth deviations about fitted points, with the marginal
likelihood of each: what :mod:`~imr_torch.assimilate.frame_noise` infers the noise from.

Gaussian processes by their state space: Hartikainen & Sarkka, IEEE MLSP 2010.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter

import torch
from torch import Tensor

from imr_torch.assimilate.matern import MATERN, matern_whitened
from imr_torch.assimilate.noise_law import (
    LocalNoise,
    best_scales,
    equations_of_columns,
    split_probability,
    sum_marginals,
)
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.float64 import ones, tensor, zeros
from imr_torch.observe import Noise, NoiseLaws
from imr_torch.observe.noise import steady_variance

_COLUMNS = ("slope", "drift", "floor", "edge", "jitter")  # of a law, in a table of laws


@dataclass(frozen=True)
class FrameNoisePrior:
    """Prior of the noise of single frames, and of what else a residual may hold.

    Args:
        law: the published proportion of ``slope`` to ``drift``, about which others are tried.
        balances: factors on the published ``slope`` and ``drift``, with their probabilities.
        edge: part in proportion to 1/R* at scale 1, R*, of noise that grows so, and neither with
            ``|R* - 1|`` nor with time; with its probability.
        floors: constant parts at scale 1, R*.
        level: prior median of the noise without its jitter, root mean square over all frames in R*,
            and the standard deviation of its logarithm, which matters where there are few frames.
        few: frames in all below which the noise is no less than ``law``: amounts read off a handful
            of frames may be several times too small by chance.
        least: smallest constant part, R*: bubbles are not computed more exactly than that.
        jitters: errors of the times of frames over their spacing, of noise whose level is the prior
            median, equally probable.
        exact: probability that there is none of that.
        amounts: standard deviation of the smooth deviation, over that of the noise.
        durations: lag at which its correlation has fallen to 1/e, t*; never less than 2.5 frames.
        none: probability that there is no smooth deviation; where residuals are taken as
            independent, that the model does not miss the curves.
        misfits: by how much it misses them in any frame, R*.
        own: probability that the noise of one curve differs from that of the others.
        own_sd: standard deviation of the logarithm of such a curve's factor.
        own_frames: frames that a curve needs for a factor of its own.
        frames: of a longer record every second, third, ... frame is used.
        kept: weight over the largest from which on a law is kept.
        behind: nats behind the best from which on a law is not tried again beside a factor of one
            curve; that moves them against each other by a few.
        missed: residuals about a fit over the scatter of repeats, from which on they hold more than
            that.

    >>> from imr_torch.assimilate import FrameNoisePrior
    >>> FrameNoisePrior().floors[0], FrameNoisePrior().durations
    (0.0005, (0.14, 0.3, 0.6, 1.2))
    """

    law: Noise = field(default_factory=Noise)
    balances: tuple[tuple[float, float, float], ...] = (
        (0.0, 1.0, 0.1),
        (3.0**-0.5, 3.0**0.5, 0.15),
        (1.0, 1.0, 0.5),
        (3.0**0.5, 3.0**-0.5, 0.15),
        (1.0, 0.0, 0.1),
    )
    edge: tuple[float, float] = (0.002, 0.1)
    floors: tuple[float, ...] = tuple(0.0005 * 2.0**k for k in range(8))
    level: tuple[float, float] = (0.004, 1.5)
    few: int = 40
    least: float = 0.0003
    jitters: tuple[float, ...] = (0.05, 0.15, 0.5, 1.5)
    exact: float = 0.8
    amounts: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    durations: tuple[float, ...] = (0.14, 0.3, 0.6, 1.2)
    none: float = 0.8
    misfits: tuple[float, ...] = tuple(0.0005 * 2.0 ** (k / 16.0) for k in range(161))
    own: float = 0.1
    own_sd: float = 0.7
    own_frames: int = 12
    frames: int = 400
    kept: float = 1e-4
    behind: float = 50.0
    missed: float = 1.1


@dataclass(frozen=True)
class FittedCurves:
    """The curves of one fit.

    Args:
        near: the fitted point.
        place: which of all curves of all fits they are.
        rows: frames that are used, ``E x T`` boolean tensor.
    """

    near: Neighbourhood
    place: slice
    rows: Tensor

    @classmethod
    def of(cls, fits: Sequence[Neighbourhood], frames: int) -> "tuple[FittedCurves, ...]":
        """Those of each fit; of longer records than ``frames`` every second, third, ... one."""
        ends = itertools.accumulate((len(near.centre) for near in fits), initial=0)
        found = []
        for near, (first, end) in zip(fits, itertools.pairwise(ends), strict=True):
            batch = near.posterior.batch
            stride = -(-int(batch.mask.sum(1).max()) // frames)
            rows = batch.mask & (torch.arange(batch.mask.shape[1]) % stride == 0)
            # shots that are more probably like the others than not; all, if none is
            alike = torch.tensor([e.weight > 0.5 for e in batch.curves])[:, None]
            rows = rows & alike if alike.any() else rows
            found.append(cls(near, slice(first, end), rows))
        return tuple(found)

    def noise_variance(self, values: Tensor, factors: Tensor) -> Tensor:
        """``J x E x T`` tensor, variance of the noise at scale 1, without its jitter."""
        laws, which = values[:, :4].unique(dim=0, return_inverse=True)
        parts = laws.T[..., None, None]
        times = self.near.posterior.batch.times
        variance = steady_variance(self.near.centre, times, *parts)
        return (variance * factors[self.place, None].square())[which]

    def whiten_columns(
        self, values: Tensor, factors: Tensor, level: Tensor, columns: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Columns ``C x E x T`` under each combination, ``J x C x E x T``, and half the log
        determinants, ``J x E``.
        """
        batch = self.near.posterior.batch
        jitter = values[:, 4, None, None] * batch.motions * factors[self.place, None]
        noise = self.noise_variance(values, factors) + jitter.square()
        smooth = values[:, 5].square() * level
        times = batch.times
        return matern_whitened(
            times, self.rows, noise, smooth, MATERN / values[:, 6], columns
        )

    @cached_property
    def columns(self) -> Tensor:
        """Residual of the mean of repeats and its sensitivities, ``C x E x T``, in units of one
        repeat's noise; 0 for frames that are not used.
        """
        scale = self.near.posterior.batch.counts.sqrt()
        return torch.where(self.rows, self.near.columns * scale, 0.0).nan_to_num()

    def describe_locally(
        self, values: Tensor, factors: Tensor, level: Tensor
    ) -> LocalNoise:
        """What the linearisation says of the data under each combination, at scale 1."""
        seen, log_det = self.whiten_columns(values, factors, level, self.columns)
        return LocalNoise(
            seen[:, 0].square().sum((1, 2)),
            log_det.sum(1),
            float(self.rows.sum()),
            equations_of_columns(seen, self.near.posterior.size),
            self.near.point,
        )


@dataclass(frozen=True)
class NoiseGrid:
    """All combinations of ``L`` laws and ``D`` deviations, ``J = L D`` in all, law by law.

    Args:
        curves: of each fit.
        prior: of the law.
        laws: ``L x 5`` tensor, columns :data:`_COLUMNS`; at scale 1.
        deviations: ``D x 2`` tensor: amount and duration of the smooth deviation; the first is none.
        log_prior: ``J`` tensor.
    """

    curves: tuple[FittedCurves, ...]
    prior: FrameNoisePrior
    laws: Tensor
    deviations: Tensor
    log_prior: Tensor

    @classmethod
    def of(cls, fits: Sequence[Neighbourhood], prior: FrameNoisePrior) -> "NoiseGrid":
        """The grid about fitted points."""
        curves = FittedCurves.of(fits, prior.frames)
        edge, share = prior.edge
        grown = [
            (prior.law.slope * slope, prior.law.drift * drift, 0.0, (1.0 - share) * weight)
            for slope, drift, weight in prior.balances
        ]
        laws = [
            (slope, drift, floor, edge, weight / len(prior.floors))
            for (slope, drift, edge, weight), floor in itertools.product(
                [*grown, (0.0, 0.0, edge, share)], prior.floors
            )
        ]
        shares = split_probability(prior.exact, len(prior.jitters))
        jitters = list(zip((0.0, *prior.jitters), shares, strict=True))
        of_laws, of_jitters, of_deviations = map(
            tensor, (laws, jitters, _deviations(fits, prior))
        )
        level = _mean_variance(
            curves, of_laws, ones(sum(len(near.centre) for near in fits))
        ).sqrt()
        own = level[:, None] / prior.level[0] * of_jitters[:, 0]
        laws = torch.cat(
            (of_laws[:, :4].repeat_interleave(len(jitters), 0), own.reshape(-1, 1)), 1
        )
        shares = (of_laws[:, 4:] * of_jitters[:, 1]).reshape(-1, 1) * of_deviations[:, 2]
        return cls(curves, prior, laws, of_deviations[:, :2], shares.log().flatten())

    @cached_property
    def values(self) -> Tensor:
        """``J x 7`` tensor of laws and deviations."""
        laws = self.laws.repeat_interleave(len(self.deviations), 0)
        return torch.cat((laws, self.deviations.repeat(len(self.laws), 1)), 1)

    def weigh_combinations(self, factors: Tensor, *, among: Tensor | None = None) -> Tensor:
        """``3 x J`` tensor: log weights of all combinations, or of those of some numbers, their
        scales integrated out, and log scales with standard deviations.
        """
        chosen = torch.arange(len(self.values)) if among is None else among
        values = self.values[chosen]
        level = _mean_variance(self.curves, self.laws, factors)
        level = level.repeat_interleave(len(self.deviations))[chosen]
        parts = []
        for some, its in zip(values.split(1500), level.split(1500), strict=True):
            local = [c.describe_locally(some, factors, its) for c in self.curves]
            scales, sds = best_scales(local)
            parts.append((scales, sds, sum_marginals(local, scales)))
        likely, widths, marginal = map(torch.cat, zip(*parts, strict=True))
        median, wide = self.prior.level
        ahead = math.log(median) - 0.5 * level.log() - likely
        both = widths.square() + wide**2
        log_scales = likely + widths.square() / both * ahead
        sds = widths * wide / both.sqrt()
        value = marginal + sds.log() - 0.5 * ahead.square() / both + self.log_prior[chosen]
        floors = values[:, 2]
        least = math.log(self.prior.least) - floors.log()
        too_small = log_scales < least
        if (
            too_small.all()
        ):  # only the error of the solver is left, which is nearly constant
            log_scales, too_small = least, floors < floors.max()
        value = torch.where(too_small, -torch.inf, value)
        return torch.stack((value - value.logsumexp(0), log_scales, sds))

    def compare_curves(self, best: int, factors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The noise of each curve over that of the others by one of the combinations, the standard
        deviation of its logarithm, and the nats for a factor of its own, more than 0 where it is to
        have one.
        """
        values = self.values[best : best + 1]
        level = _mean_variance(self.curves, values, factors)
        parts = []
        for c in self.curves:
            seen, _ = c.whiten_columns(values, factors, level, c.columns[:1])
            by_gel, by_nuisance = c.near.slopes
            fitted = by_gel.shape[-1] / len(by_gel) + by_nuisance.shape[-1]
            used = c.rows.sum(1)
            parts.append(
                (seen[0, 0].square().sum(-1), used, (used - fitted).clamp_min(1.0))
            )
        square, used, count = map(torch.cat, zip(*parts, strict=True))
        others = square.sum() - square, count.sum() - count
        log_factor = 0.5 * (square / count / (others[0] / others[1])).log()
        variance = 0.5 / count + 0.5 / others[1]
        wide = variance + self.prior.own_sd**2
        gain = (
            0.5 * log_factor.square() * (1.0 / variance - 1.0 / wide)
            - 0.5 * (wide / variance).log()
        )
        gain = torch.where(
            (used >= self.prior.own_frames) & (factors == 1.0), gain, -torch.inf
        )
        needed = math.log((1.0 - self.prior.own) / self.prior.own * len(square))
        return log_factor.exp(), variance.sqrt(), gain - needed

    def log_sd(self, law: Noise) -> Tensor:
        """Mean logarithm of a law over all frames that are used."""
        logs = []
        for c in self.curves:
            batch = c.near.posterior.batch
            sd = law.sd(c.near.centre, batch.times, batch.motions) * batch.noise_factors
            logs.append(sd[c.rows].log())
        return torch.cat(logs).mean()

    def add_misfit(
        self, law: Noise, laws: NoiseLaws, factors: Tensor
    ) -> tuple[Noise, NoiseLaws]:
        """The law and the laws if residuals are independent: beside the noise of single frames, an
        error of the model that is of one size in all frames.
        """
        tried = [law]
        for size in self.prior.misfits:
            tried.append(replace(law, floor=math.hypot(law.floor, size / law.scale)))
        amounts = law.scale * tensor([attrgetter(*_COLUMNS)(x) for x in tried])
        without_deviation = tensor([(0.0, 1.0)]).expand(len(tried), -1)
        values = torch.cat((amounts, without_deviation), 1)
        level = ones(len(tried))
        local = [c.describe_locally(values, factors, level) for c in self.curves]
        marginal = sum_marginals(local, zeros(len(tried)))  # at their own scales
        marginal += tensor(
            split_probability(self.prior.none, len(self.prior.misfits))
        ).log()
        shares = torch.softmax(marginal, 0)
        logs = torch.stack([self.log_sd(one) for one in tried])
        within = torch.softmax(marginal[1:], 0)
        middle = within @ logs[1:]
        spread = (within @ (logs[1:] - middle).square()).sqrt()
        best = 1 + int(within.argmax())
        missed = tried[best].scaled(math.exp(float(middle - logs[best])))
        central = law if float(shares[0]) > 0.5 else missed
        return central, NoiseLaws(
            (*laws.laws, missed),
            torch.cat((shares[0] * laws.weights, shares[1:].sum()[None])),
            torch.cat((laws.log_scale_sds, spread[None])),
        )

    def sum_deviations(self, found: Tensor) -> tuple[Noise, NoiseLaws]:
        """The central law, and all laws, each with the deviations summed over."""
        log_weights, log_scales, sds = found.reshape(3, len(self.laws), -1)
        totals = log_weights.logsumexp(1)
        kept = totals > totals.max() + math.log(self.prior.kept)
        within = torch.softmax(log_weights[kept], 1)
        centres = (within * log_scales[kept]).sum(1)
        apart = log_scales[kept] - centres[:, None]
        spreads = (within * (sds[kept].square() + apart.square())).sum(1)
        laws = [
            replace(
                self.prior.law,
                scale=math.exp(centre),
                **dict(zip(_COLUMNS, law, strict=True)),
            )
            for centre, law in zip(centres.tolist(), self.laws[kept].tolist(), strict=True)
        ]
        shares = torch.softmax(totals[kept], 0)
        logs = torch.stack([self.log_sd(law) for law in laws])
        middle = float(shares @ logs)
        if sum(int(c.rows.sum()) for c in self.curves) < self.prior.few:
            raised = math.exp(max(0.0, float(self.log_sd(self.prior.law)) - middle))
            laws = [law.scaled(raised) for law in laws]
        best = int(shares.argmax())
        central = laws[best].scaled(math.exp(middle - float(logs[best])))
        return central, NoiseLaws(tuple(laws), shares, spreads.sqrt())


def _mean_variance(
    curves: Sequence[FittedCurves], values: Tensor, factors: Tensor
) -> Tensor:
    """``J`` tensor, mean variance of the noise without its jitter over the frames that are used."""
    sums = [(c.noise_variance(values, factors) * c.rows).sum((1, 2)) for c in curves]
    return torch.stack(sums).sum(0) / sum(c.rows.sum() for c in curves)


def _deviations(
    fits: Sequence[Neighbourhood], prior: FrameNoisePrior
) -> list[tuple[float, float, float]]:
    """Amount and duration of every deviation that is tried, with its prior probability."""
    spacing = torch.cat(
        [e.times.diff() for near in fits for e in near.posterior.batch.curves]
    ).median()
    smooth = [
        (amount, max(lag, 2.5 * float(spacing)))
        for amount, lag in itertools.product(prior.amounts, prior.durations)
    ]
    shares = split_probability(prior.none, len(smooth))
    return [(*one, share) for one, share in zip([(0.0, 1.0), *smooth], shares, strict=True)]
