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
from torch import Tensor

from imr_torch.assimilate.gauss_newton import NormalEquations
from imr_torch.assimilate.matern import MATERN, matern_whitened
from imr_torch.assimilate.noise_law import LocalNoise, NoiseGrid, best_scales
from imr_torch.assimilate.noise_prior import NoisePrior
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.assimilate.spikes import bends
from imr_torch.observe import ExperimentBatch, Noise, NoiseLaws

_FRAMES = 400  # of a longer record every second, third, ... frame is used
_AT_ONCE = 1500  # combinations filtered side by side
_KEPT = 1e-4  # weight over the largest from which on a law is kept
_OWN_SD = 0.7  # prior standard deviation of the logarithm of one curve's own noise factor
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
        few: frames in all below which the noise is no less than ``law``: amounts read off a handful of frames may be several
            times too small by chance.
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
    few: int = 40
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

    >>> import torch
    >>> from imr_torch.assimilate import FrameNoise
    >>> from imr_torch.observe import Experiment, ExperimentBatch, Noise, NoiseLaws
    >>> times, one = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    >>> shots = tuple(Experiment(f"shot {k}", (400.0, 0.22), times, torch.ones(1, 3)) for k in range(2))
    >>> noise = FrameNoise(Noise(scale=1.2), NoiseLaws((Noise(scale=1.2),), one, 0.1 * one), (1.0, 3.0), (0.0, 0.2))
    >>> [e.noise_factor for e in noise.applied(ExperimentBatch(shots)).curves]
    [1.0, 3.0]
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

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import Posterior, SearchOptions, assimilate, infer_frame_noise
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, Noise, SimulatedLaboratory
    >>> simulator, design = PolytropicSimulator(), torch.tensor([400.0, 0.22], dtype=torch.float64)
    >>> gel = PARAMETERS.pack({"G": 8310.0, "mu": 0.093})
    >>> shot = SimulatedLaboratory(simulator, gel, noise=Noise(scale=2.0), repeats=1).shoot(design, seed=0)
    >>> batch, options = ExperimentBatch((shot,)), SearchOptions(raw_samples=16, starts=2)
    >>> fit = assimilate(wide_prior(["nhkv"]), batch, simulator, seed=0, options=options)["nhkv"]
    >>> found = infer_frame_noise(Posterior(fit.prior, batch, simulator).neighbourhood(fit.point))
    >>> low, middle, high = found.applied(batch).noise_interval(fit.prediction)  # R*, median frame
    >>> low < float(Noise(scale=2.0).sd(fit.prediction, batch.times).median()) < high
    True
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
        return cls(near, prior, values, torch.tensor(logs, dtype=torch.float64), kept, bends(batch, near.centre))

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
        centre = (share @ logs).mean()
        raised = 0.0
        if int(self.rows.sum()) < self.prior.few:
            raised = max(0.0, float(self.prior.law.sd(radius, batch.times)[self.rows].log().mean() - centre))
            laws_known = replace(laws_known, laws=tuple(replace(law, scale=law.scale * math.exp(raised)) for law in chosen))
        law = replace(chosen[best], scale=chosen[best].scale * math.exp(float(centre - logs[best].mean()) + raised))
        return FrameNoise(law, laws_known, tuple(factors.tolist()), tuple(factor_sds.tolist()))


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
