"""The noise of single frames, inferred about a fit in such a way that a misfit of the model is not
taken for noise.

A misfit is smooth from frame to frame, but next to a collapse, where the radius itself bends within
a frame. So the residual of a fit is taken as the sum of four things: what the gel and the nuisances
can still move; a smooth deviation of unknown size and duration (a Gaussian process with Matern-3/2
covariance, of each curve its own); a deviation in proportion to how much the curve bends between
neighbouring frames; and noise that is independent between frames, whose law is wanted. All but the
last are integrated out. Where the model is right the posterior of the law is that of its residuals
(restricted maximum likelihood); where it is not, the smooth deviation takes the misfit up, and the
law is what the roughness of the curves says.

Where designs were repeated, the repeats decide: their deviations from their mean hold the camera's
noise alone.

The law is ``scale * sqrt((slope |R*-1| + drift t*)^2 + floor^2)`` with free proportions. One curve
whose noise is not that of the others gets a factor of its own. Gaussian processes by their state
space: Hartikainen & Sarkka, IEEE MLSP 2010.

Intervals of the gel are another question. Fits take frames as independent, with the law that is
most probable if residuals are nothing else, so that they pass through the curves also where the
model misses them. What residuals have in common makes their intervals too narrow then;
:attr:`FrameNoise.widened` says by how much. Where the model is right both laws are one.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from imr_torch.assimilate.matern import MATERN, matern_whitened
from imr_torch.assimilate.noise_law import (
    LocalNoise,
    best_scales,
    equations_of_columns,
    interval_factor,
    law_of_repeats,
)
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.assimilate.spikes import bends
from imr_torch.float64 import ones, tensor
from imr_torch.observe import CollapseTime, Experiment, ExperimentBatch, Noise, NoiseLaws


@dataclass(frozen=True)
class FrameNoisePrior:
    """Prior of the noise of single frames, and of what else a residual may hold.

    Args:
        law: the published proportion of ``slope`` to ``drift``, about which others are tried.
        balances: factors on the published ratio of ``slope`` to ``drift``, with their
            probabilities; 0 is noise that grows with time alone, infinity noise that grows with
            ``|R* - 1|`` alone.
        floors: constant parts at scale 1, R*.
        level: prior median of the noise, root mean square over all frames in R*, and the standard
            deviation of its logarithm, which matters where there are few frames.
        few: frames in all below which the noise is no less than ``law``: amounts read off a handful
            of frames may be several times too small by chance.
        least: smallest constant part, R*: bubbles are not computed more exactly than that.
        amounts: standard deviation of the smooth deviation, over that of the noise.
        durations: lag at which its correlation has fallen to 1/e, t*; never less than 2.5 frames.
        bends: deviations next to collapses, over the bend of the curve between neighbouring frames
            (at scale 1).
        none: probability that there is neither of these; a smooth one alone, one next to collapses
            alone and both are equally probable otherwise.
        own: probability that the noise of one curve differs from that of the others.
        own_sd: standard deviation of the logarithm of such a curve's factor.
        own_frames: frames that a curve needs for a factor of its own.
        frames: of a longer record every second, third, ... frame is used.
        kept: weight over the largest from which on a law is kept.
        missed: residuals about a fit over the scatter of repeats, from which on they hold more than
            that.

    >>> from imr_torch.assimilate.frame_noise import FrameNoisePrior
    >>> FrameNoisePrior().floors[0], FrameNoisePrior().durations
    (0.0005, (0.14, 0.3, 0.6, 1.2))
    """

    law: Noise = field(default_factory=Noise)
    balances: tuple[tuple[float, float], ...] = (
        (0.0, 0.1),
        (1.0 / 3.0, 0.15),
        (1.0, 0.5),
        (3.0, 0.15),
        (math.inf, 0.1),
    )
    floors: tuple[float, ...] = tuple(0.0005 * 2.0**k for k in range(8))
    level: tuple[float, float] = (0.004, 1.5)
    few: int = 40
    least: float = 0.0003
    amounts: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    durations: tuple[float, ...] = (0.14, 0.3, 0.6, 1.2)
    bends: tuple[float, ...] = (0.05, 0.2, 0.8)
    none: float = 0.7
    own: float = 0.1
    own_sd: float = 0.7
    own_frames: int = 12
    frames: int = 400
    kept: float = 1e-4
    missed: float = 1.1


@dataclass(frozen=True)
class FrameNoise:
    """The noise of single frames.

    Args:
        law: central law: the most probable one, at the posterior mean of its logarithm at the
            frames.
        laws: the posterior.
        factors: of each experiment, its noise over the law; 1 where it is that of the others.
        factor_sds: standard deviations of their logarithms.
        independent: the central law and the posterior if residuals are independent; as the two
            above when not given.
        widened: factor by which 90 % intervals of the gel by that law are to be wider, for what
            residuals have in common; near 1 where the model explains the curves.

    >>> import torch
    >>> from dataclasses import replace
    >>> from imr_torch.assimilate import FrameNoise
    >>> from imr_torch.observe import Experiment, ExperimentBatch, Noise, NoiseLaws
    >>> times, one = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    >>> shots = tuple(Experiment(f"shot {k}", (400.0, 0.22), times, torch.ones(1, 3)) for k in range(2))
    >>> noise = FrameNoise(Noise(scale=1.2), NoiseLaws((Noise(scale=1.2),), one, 0.1 * one), (1.0, 3.0), (0.0, 0.2))
    >>> [e.noise_factor for e in noise.applied(ExperimentBatch(shots)).curves]
    [1.0, 3.0]
    >>> replace(noise, widened=2.0).for_fits(widen=True).law.scale
    2.4
    """

    law: Noise
    laws: NoiseLaws
    factors: tuple[float, ...]
    factor_sds: tuple[float, ...]
    independent: tuple[Noise, NoiseLaws] | None = None
    widened: float = 1.0

    def for_fits(self, *, widen: bool) -> "FrameNoise":
        """The laws of independent residuals, enlarged if intervals are to be right.

        With those of single frames.
        """
        factor = self.widened if widen else 1.0
        law, laws = self.independent or (self.law, self.laws)
        enlarged = tuple(
            replace(one, scale=one.scale * factor, widened=factor) for one in (law, *laws.laws)
        )
        return replace(
            self, law=enlarged[0], laws=replace(laws, laws=enlarged[1:], frames=self.laws)
        )

    def of_curve(self, number: int) -> "FrameNoise":
        """The noise of one of the curves."""
        return replace(self, factors=(self.factors[number],), factor_sds=(self.factor_sds[number],))

    def applied(self, batch: ExperimentBatch) -> ExperimentBatch:
        """A batch of the same curves, perhaps with collapse times beside them, with this noise."""
        factors = iter(zip(self.factors, self.factor_sds, strict=True))
        experiments: list[Experiment | CollapseTime] = []
        for experiment in batch.experiments:
            if isinstance(experiment, Experiment):
                factor, sd = next(factors)
                experiments.append(replace(experiment, noise_factor=factor, noise_factor_sd=sd))
            else:
                experiments.append(experiment)
        return replace(batch, experiments=tuple(experiments), noise=self.law, noise_laws=self.laws)


def infer_frame_noise(
    near: Neighbourhood | Sequence[Neighbourhood], prior: FrameNoisePrior | None = None
) -> FrameNoise:
    """The posterior of the noise law about a fit, or about several fits with gels of their own and
    one noise.

    Args:
        near: each fitted point with its local sensitivities; its batch holds curves only.
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
    fits = (near,) if isinstance(near, Neighbourhood) else tuple(near)
    prior = prior or FrameNoisePrior()
    curves = [e for one in fits for e in one.posterior.batch.curves]
    if all(e.repeats > 1 for e in curves):
        law, laws = law_of_repeats([one.posterior.batch for one in fits], prior.law)
        alike = (1.0,) * len(curves), (0.0,) * len(curves)
        return FrameNoise(law, laws, *alike, *_of_all_residuals(fits, law, prior.missed))
    grid = _Grid.of(fits, prior)
    factors = ones(len(curves))
    sds = torch.zeros_like(factors)
    found = grid.weigh_combinations(factors)
    for _ in curves[1:]:
        other = grid.find_outlier(found, factors)
        if other is None:
            break
        experiment, log_factor, sd = other
        factors[experiment] *= math.exp(log_factor)
        sds[experiment] = sd
        found = grid.weigh_combinations(factors)
    return grid.conclude_noise(found, factors, sds)


@dataclass(frozen=True)
class _Curves:
    """The curves of one fit.

    Args:
        near: the fitted point.
        place: which of all curves of all fits they are.
        rows: frames that are used, ``E x T`` boolean tensor.
        bend: ``E x T`` tensor, how far each frame lies off the cubic through its neighbours, in the
            fitted curve.
    """

    near: Neighbourhood
    place: slice
    rows: Tensor
    bend: Tensor

    @classmethod
    def of(cls, fits: Sequence[Neighbourhood], frames: int) -> "tuple[_Curves, ...]":
        """Those of each fit; of longer records than ``frames`` every second, third, ... one."""
        ends = itertools.accumulate((len(near.centre) for near in fits), initial=0)
        found = []
        for near, (first, end) in zip(fits, itertools.pairwise(ends), strict=True):
            batch = near.posterior.batch
            stride = -(-int(batch.mask.sum(1).max()) // frames)
            rows = batch.mask & (torch.arange(batch.mask.shape[1]) % stride == 0)
            # shots that are more probably like the others than not; all, if none is
            alike = torch.tensor([e.weight > 0.5 for e in batch.curves])[:, None]
            rows = rows & alike if bool(alike.any()) else rows
            found.append(cls(near, slice(first, end), rows, bends(batch, near.centre)))
        return tuple(found)

    def noise_variance(self, values: Tensor, factors: Tensor) -> Tensor:
        """``J x E x T`` tensor, variance of the noise at scale 1, without that of deviations."""
        slope, drift, floor = (values[:, i, None, None] for i in range(3))
        grown = slope * (self.near.centre - 1.0).abs() + drift * self.near.posterior.batch.times
        return (grown.square() + floor.square()) * factors[self.place, None].square()

    def whiten_columns(
        self, values: Tensor, factors: Tensor, level: Tensor, columns: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Columns ``C x E x T`` under each combination, ``J x C x E x T``, and half the log
        determinants, ``J x E``.
        """
        noise = (
            self.noise_variance(values, factors) + (values[:, 5, None, None] * self.bend).square()
        )
        smooth = values[:, 3].square() * level
        times = self.near.posterior.batch.times
        return matern_whitened(times, self.rows, noise, smooth, MATERN / values[:, 4], columns)

    @property
    def residual(self) -> Tensor:
        """``E x T`` tensor, of the mean of repeats, in units of one repeat's noise.

        0 for frames that are not used.
        """
        batch = self.near.posterior.batch
        return torch.where(self.rows, (batch.mean - self.near.centre) * batch.counts.sqrt(), 0.0)

    def describe_locally(self, values: Tensor, factors: Tensor, level: Tensor) -> LocalNoise:
        """What the linearisation says of the data under each combination, at scale 1."""
        by_gel, by_nuisance = (x.movedim(-1, 0) for x in self.near.slopes)
        slopes = torch.cat((by_gel, by_nuisance)) * self.near.posterior.batch.counts.sqrt()
        slopes = torch.where(self.rows, slopes, 0.0).nan_to_num()
        columns = torch.cat((self.residual[None], slopes))
        seen, log_det = self.whiten_columns(values, factors, level, columns)
        return LocalNoise(
            seen[:, 0].square().sum((1, 2)),
            log_det.sum(1),
            float(self.rows.sum()),
            equations_of_columns(seen, len(by_gel)),
            self.near.point,
        )


@dataclass(frozen=True)
class _Grid:
    """All combinations of ``L`` laws and ``D`` deviations, ``J = L D`` in all, law by law.

    Args:
        curves: of each fit.
        prior: of the law.
        laws: ``L x 3`` tensor: slope, drift, floor; at scale 1.
        deviations: ``D x 3`` tensor: amount and duration of the smooth deviation, bend; the first
            is none.
        log_prior: ``J`` tensor.
    """

    curves: tuple[_Curves, ...]
    prior: FrameNoisePrior
    laws: Tensor
    deviations: Tensor
    log_prior: Tensor

    @classmethod
    def of(cls, fits: Sequence[Neighbourhood], prior: FrameNoisePrior) -> "_Grid":
        """The grid about fitted points."""
        laws = [
            (*_balance_law(prior.law, balance), floor, weight)
            for (balance, weight), floor in itertools.product(prior.balances, prior.floors)
        ]
        of_laws, of_deviations = (tensor(rows) for rows in (laws, _deviations(fits, prior)))
        shares = of_laws[:, 3:] * of_deviations[:, 3] / len(prior.floors)
        curves = _Curves.of(fits, prior.frames)
        return cls(curves, prior, of_laws[:, :3], of_deviations[:, :3], shares.log().flatten())

    @cached_property
    def values(self) -> Tensor:
        """``J x 6`` tensor of laws and deviations."""
        laws = self.laws.repeat_interleave(len(self.deviations), 0)
        return torch.cat((laws, self.deviations.repeat(len(self.laws), 1)), 1)

    def mean_variance(self, factors: Tensor) -> Tensor:
        """``J`` tensor, mean variance of the noise over the frames that are used."""
        sums = [(c.noise_variance(self.values, factors) * c.rows).sum((1, 2)) for c in self.curves]
        return torch.stack(sums).sum(0) / sum(c.rows.sum() for c in self.curves)

    def weigh_combinations(self, factors: Tensor, *, at_once: int = 1500) -> Tensor:
        """``3 x J`` tensor: log weights of all combinations, their scales integrated out, and log
        scales with standard deviations; so many are filtered side by side.
        """
        level = self.mean_variance(factors)
        parts = []
        for some, its in zip(self.values.split(at_once), level.split(at_once), strict=True):
            local = [c.describe_locally(some, factors, its) for c in self.curves]
            scales, sds = best_scales(local)
            value = torch.stack([one.marginal(scales[:, None])[:, 0] for one in local]).sum(0)
            parts.append((scales, sds, value))
        likely, widths, marginal = map(torch.cat, zip(*parts, strict=True))
        median, wide = self.prior.level
        ahead = math.log(median) - 0.5 * level.log() - likely
        both = widths.square() + wide**2
        log_scales = likely + widths.square() / both * ahead
        sds = widths * wide / both.sqrt()
        value = marginal + sds.log() - 0.5 * ahead.square() / both + self.log_prior
        floors = self.values[:, 2]
        least = math.log(self.prior.least) - floors.log()
        too_small = log_scales < least
        if bool(too_small.all()):  # only the error of the solver is left, which is nearly constant
            log_scales, too_small = least, floors < floors.max()
        value = torch.where(too_small, -torch.inf, value)
        return torch.stack((value - value.logsumexp(0), log_scales, sds))

    def find_outlier(self, found: Tensor, factors: Tensor) -> tuple[int, float, float] | None:
        """The curve whose noise most clearly differs from that of the others: number, log factor
        and its sd.
        """
        best = int(found[0].argmax())
        values = self.values[best : best + 1]
        level = self.mean_variance(factors)[best : best + 1]
        parts = []
        for c in self.curves:
            seen, _ = c.whiten_columns(values, factors, level, c.residual[None])
            by_gel, by_nuisance = c.near.slopes
            fitted = by_gel.shape[-1] / len(by_gel) + by_nuisance.shape[-1]
            used = c.rows.sum(1)
            parts.append((seen[0, 0].square().sum(-1), used, (used - fitted).clamp_min(1.0)))
        square, used, count = map(torch.cat, zip(*parts, strict=True))
        others = square.sum() - square, count.sum() - count
        log_factor = 0.5 * (square / count / (others[0] / others[1])).log()
        variance = 0.5 / count + 0.5 / others[1]
        wide = variance + self.prior.own_sd**2
        gain = (
            0.5 * log_factor.square() * (1.0 / variance - 1.0 / wide)
            - 0.5 * (wide / variance).log()
        )
        gain = torch.where((used >= self.prior.own_frames) & (factors == 1.0), gain, -torch.inf)
        first = int(gain.argmax())
        if float(gain[first]) < math.log((1.0 - self.prior.own) / self.prior.own * len(square)):
            return None
        return first, float(log_factor[first]), math.sqrt(float(variance[first]))

    def log_sd(self, law: Noise) -> Tensor:
        """Mean logarithm of a law over all frames that are used."""
        return torch.cat(
            [law.sd(c.near.centre, c.near.posterior.batch.times)[c.rows].log() for c in self.curves]
        ).mean()

    def conclude_noise(self, found: Tensor, factors: Tensor, factor_sds: Tensor) -> FrameNoise:
        """What is known of the noise of frames, of that of independent residuals, and what the rest
        does to intervals.
        """
        law, laws = self.sum_deviations(found, slice(None))
        independent = self.sum_deviations(found, slice(1))
        widened = interval_factor([c.near for c in self.curves], independent[0])
        return FrameNoise(
            law, laws, tuple(factors.tolist()), tuple(factor_sds.tolist()), independent, widened
        )

    def sum_deviations(self, found: Tensor, deviations: slice) -> tuple[Noise, NoiseLaws]:
        """The central law, and all laws, each with some of the deviations summed over."""
        log_weights, log_scales, sds = found.reshape(3, len(self.laws), -1)[..., deviations]
        totals = log_weights.logsumexp(1)
        kept = totals > totals.max() + math.log(self.prior.kept)
        within = torch.softmax(log_weights[kept], 1)
        centres = (within * log_scales[kept]).sum(1)
        apart = log_scales[kept] - centres[:, None]
        spreads = (within * (sds[kept].square() + apart.square())).sum(1)
        laws = [
            replace(self.prior.law, scale=math.exp(centre), slope=slope, drift=drift, floor=floor)
            for centre, (slope, drift, floor) in zip(
                centres.tolist(), self.laws[kept].tolist(), strict=True
            )
        ]
        shares = torch.softmax(totals[kept], 0)
        logs = torch.stack([self.log_sd(law) for law in laws])
        middle = float(shares @ logs)
        if sum(int(c.rows.sum()) for c in self.curves) < self.prior.few:
            raised = math.exp(max(0.0, float(self.log_sd(self.prior.law)) - middle))
            laws = [replace(law, scale=law.scale * raised) for law in laws]
        best = int(shares.argmax())
        central = replace(laws[best], scale=laws[best].scale * math.exp(middle - float(logs[best])))
        return central, NoiseLaws(tuple(laws), shares, spreads.sqrt())


def _of_all_residuals(
    fits: Sequence[Neighbourhood], law: Noise, missed: float
) -> tuple[tuple[Noise, NoiseLaws] | None, float]:
    """The law of independent residuals where a fit leaves more than ``missed`` times the scatter of
    repeats, and the factor for intervals.
    """
    whole, _ = best_scales([LocalNoise.of(near, (law,)) for near in fits])
    if math.exp(float(whole)) < missed * law.scale:
        return None, 1.0
    white = replace(law, correlation_time=0.0)
    log_scale, sd = best_scales([LocalNoise.of(near, (white,)) for near in fits])
    independent = replace(white, scale=math.exp(float(log_scale)))
    laws = NoiseLaws((independent,), ones(1), sd, of_residuals=False)
    return (independent, laws), interval_factor(fits, independent)


def _deviations(
    fits: Sequence[Neighbourhood], prior: FrameNoisePrior
) -> list[tuple[float, float, float, float]]:
    """Amount, duration and bend of every deviation that is tried, with its prior probability."""
    spacing = torch.cat(
        [e.times.diff() for near in fits for e in near.posterior.batch.curves]
    ).median()
    smooth = [
        (amount, max(lag, 2.5 * float(spacing)))
        for amount, lag in itertools.product(prior.amounts, prior.durations)
    ]
    third = (1.0 - prior.none) / 3.0
    found = []
    for (amount, lag), bend in itertools.product([(0.0, 1.0), *smooth], [0.0, *prior.bends]):
        alike = (len(smooth) if amount else 1) * (len(prior.bends) if bend else 1)
        share = third / alike if amount or bend else prior.none
        found.append((amount, lag, bend, share))
    return found


def _balance_law(law: Noise, balance: float) -> tuple[float, float]:
    """Slope and drift whose ratio is ``balance`` times that of a law."""
    if math.isinf(balance):
        return law.slope, 0.0
    if balance == 0.0:
        return 0.0, law.drift
    return law.slope * math.sqrt(balance), law.drift / math.sqrt(balance)
