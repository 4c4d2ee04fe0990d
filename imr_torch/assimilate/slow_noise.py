"""Evidence for smooth deviations from a model: noise of the camera that lasts several frames, or an
unknown effect.

Noise differs from shot to shot; an effect of the gel, of the contents or of the set-up moves all
shots alike at the same phase of their first cycle. Both are Gaussian processes with Matern-3/2
covariance beside the noise of single frames, the first independent between shots, the second common
to them, in part or whole. Of a single shot they are the same.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import MultivariateNormal

from imr_torch.assimilate.gauss_newton import half_log_det
from imr_torch.assimilate.matern import MATERN, matern_whitened
from imr_torch.assimilate.posterior import Neighbourhood
from imr_torch.float64 import eye, tensor
from imr_torch.observe import collapse_time
from imr_torch.types import LawValues

AMOUNTS = (0.001, 0.002, 0.004, 0.008, 0.016)
"""Standard deviations of slow noise in R* that are tried."""

LawColumns = Float[Tensor, "laws columns frames"]
"""Curves, whitened by each law: one column a curve, frames of all shots after one another."""


@dataclass(frozen=True)
class SmoothDeviations:
    """Log evidence, nats, over no smooth deviation, gel and nuisances integrated out.

    Args:
        own: of deviations that each shot has for itself, as noise of the camera that lasts several
            frames.
        common: of deviations that are alike in all shots, as an effect that the model lacks.
    """

    own: float
    common: float


def smooth_deviations(
    near: Neighbourhood,
    *,
    amounts: Sequence[float] = AMOUNTS,
    durations: Sequence[float] = (0.14, 0.24, 0.4),
    shares: Sequence[float] = (0.5, 0.9),
    most_frames: int = 900,
) -> SmoothDeviations:
    """Evidence for smooth deviations about a fit, to first order.

    Args:
        near: a fitted point with its local sensitivities; the noise of its batch is that of single
            frames.
        amounts: standard deviations of a deviation in R*, equally probable.
        durations: lags in t* at which its correlation has fallen to 1/e, equally probable; repeats
            of public records differ by deviations that last .14 to .4.
        shares: of its variance that is common to all shots, equally probable, where it is.
        most_frames: frames in all; of more, every second, third, ... is used. Time grows with their
            cube.
    """
    batch = near.posterior.batch
    used = batch.mask & (
        torch.arange(batch.mask.shape[1]) % -(-int(batch.mask.sum()) // most_frames) == 0
    )
    shot = torch.arange(len(used))[:, None].expand_as(used)[used]
    times = batch.times[used]
    phases = _cycle_phases(near)[used]
    noise = (batch.sd(near.centre).square() / batch.counts)[used]
    columns = near.jacobian[:, used].mT
    observed = (batch.mean - near.centre)[used] + columns @ near.coordinates
    # by gel and nuisances, and single frames
    explained = columns @ columns.mT + torch.diag(noise)
    same = (shot[:, None] == shot).to(noise)

    def evidence_of(amount: float, duration: float, share: float) -> Tensor:
        lags = (MATERN * ((x[:, None] - x).abs() / duration) for x in (times, phases))
        own, common = ((1.0 + lag) * torch.exp(-lag) for lag in lags)
        smooth = amount**2 * ((1.0 - share) * same * own + share * common)
        mean = torch.zeros_like(observed)
        law = MultivariateNormal(mean, explained + smooth, validate_args=False)
        return law.log_prob(observed)

    none = evidence_of(0.0, 1.0, 0.0)

    def mean_evidence(shares: Sequence[float]) -> float:
        values = torch.stack(
            [evidence_of(*values) for values in product(amounts, durations, shares)]
        )
        return float(values.logsumexp(0) - math.log(len(values)) - none)

    return SmoothDeviations(mean_evidence((0.0,)), mean_evidence(shares))


@dataclass(frozen=True)
class BesideSlowNoise:
    """A fit beside smooth deviations that each shot has for itself, of an amount and a duration
    that are unknown: a hypothesis that leaves less needs less of them.

    Args:
        near: a point with its local sensitivities; the noise of its batch is that of single frames.
        laws: amount in R* and duration in t* of the deviations, equally probable.
        residual: whitened under each law; of the linearised model at the prior means.
        fitted: changes by everything that is fitted, whitened, each per prior standard deviation.
        log_norm: log density of a residual of zero, nats, with the probability of the law.
    """

    near: Neighbourhood
    laws: Float[Tensor, "laws 2"]
    residual: Float[Tensor, "laws frames"]
    fitted: LawColumns
    log_norm: LawValues

    @classmethod
    def about(
        cls,
        near: Neighbourhood,
        *,
        amounts: Sequence[float] = AMOUNTS,
        durations: Sequence[float] = (0.14, 0.3, 0.6),
    ) -> "BesideSlowNoise":
        """Deviations of these standard deviations in R*, whose correlation has fallen to 1/e at
        these lags in t*.
        """
        columns = near.jacobian
        observed = near.posterior.batch.mean - near.centre
        observed = observed + torch.tensordot(near.coordinates, columns, 1)
        laws = tensor(list(product(amounts, durations)))
        rows, half_log_dets = _whiten(near, laws, torch.cat((columns, observed[None])))
        count = int(near.posterior.batch.mask.sum())
        constant = 0.5 * count * math.log(2.0 * math.pi) + math.log(len(laws))
        return cls(near, laws, rows[:, -1], rows[:, :-1], -half_log_dets - constant)

    @classmethod
    def at_mode(
        cls, near: Neighbourhood, *, steps: int = 6, gain: float = 0.3
    ) -> "BesideSlowNoise":
        """About the most probable point beside such deviations, by Gauss-Newton steps.

        A linear extrapolation from where other noise led can promise an evidence that no bubble
        has.

        Args:
            near: where it begins.
            steps: at most.
            gain: nats below which a step is the last one.
        """
        here = cls.about(near)
        for _ in range(steps):
            law = int(here._of_laws.argmax())
            step = (here._inverse_root[law].mT @ here._moments[law])[
                :, 0
            ] - here.near.coordinates
            for length in (1.0, 0.3, 0.1):
                point = near.posterior.point_at(here.near.coordinates + length * step)
                further = cls.about(near.posterior.neighbourhood(point))
                gained = float(further._joint[law] - here._joint[law])
                if gained > 0.0:  # not where bubbles fail
                    break
            else:
                break
            here = further
            if gained < gain:
                break
        return here

    def whiten(self, columns: Float[Tensor, "columns experiments frames"]) -> LawColumns:
        """Curves in R* under each law."""
        return _whiten(self.near, self.laws, columns)[0]

    @cached_property
    def log_evidence(self) -> float:
        """Nats, everything that is fitted and the deviations integrated out."""
        return float(self._of_laws.logsumexp(0))

    def log_evidence_with(self, columns: LawColumns) -> Float[Tensor, "columns"]:
        """The same with one thing more that is fitted, per prior standard deviation: one value for
        each column.
        """
        overlap = self._inverse_root @ (self.fitted @ columns.mT)
        alone = columns.square().sum(2) - overlap.square().sum(1)
        moment = (columns @ self.residual[..., None])[..., 0]
        moment = moment - (overlap.mT @ self._moments)[..., 0]
        gain = 0.5 * moment.square() / (1.0 + alone) - 0.5 * alone.log1p()
        return (self._of_laws[:, None] + gain).logsumexp(0)

    def with_column(self, column: Float[Tensor, "laws frames"]) -> "BesideSlowNoise":
        """With one thing more that is fitted."""
        return replace(self, fitted=torch.cat((self.fitted, column[:, None]), 1))

    @cached_property
    def _inverse_root(self) -> Tensor:
        """Inverse Cholesky factors of the posterior precision of what is fitted."""
        precision = eye(self.fitted.shape[1]) + self.fitted @ self.fitted.mT
        return torch.linalg.inv(torch.linalg.cholesky(precision))

    @cached_property
    def _moments(self) -> Tensor:
        return self._inverse_root @ (self.fitted @ self.residual[..., None])

    @property
    def _joint(self) -> LawValues:
        """Log density of the data and of everything that is fitted at the point itself."""
        coordinates = self.near.coordinates
        left = self.residual - coordinates @ self.fitted
        return self.log_norm - 0.5 * left.square().sum(1) - 0.5 * coordinates.square().sum()

    @cached_property
    def _of_laws(self) -> LawValues:
        explained = self._moments.square().sum((1, 2)) - self.residual.square().sum(1)
        roots = half_log_det(self._inverse_root)
        return self.log_norm + 0.5 * explained + roots


def _whiten(
    near: Neighbourhood,
    laws: Float[Tensor, "laws 2"],
    columns: Float[Tensor, "columns experiments frames"],
) -> tuple[LawColumns, LawValues]:
    """Curves under each law, and half the log determinants."""
    batch = near.posterior.batch
    noise = batch.sd(near.centre).square() / batch.counts
    rows, half_log_dets = matern_whitened(
        batch.times,
        batch.mask,
        noise.expand(len(laws), *noise.shape),
        laws[:, 0].square(),
        MATERN / laws[:, 1],
        torch.where(batch.mask, columns, 0.0),
    )
    return rows.flatten(2), half_log_dets.sum(1)


def _cycle_phases(near: Neighbourhood) -> Tensor:
    """Times by the length of the first cycle, over its mean in all shots: ``E x T``; times where a
    shot has no collapse.
    """
    batch = near.posterior.batch
    rows = zip(batch.times, near.centre, batch.mask, strict=True)
    ends = [collapse_time(t[m], r[m], 1) for t, r, m in rows]
    if not all(math.isfinite(end) for end in ends):
        return batch.times
    lengths = tensor(ends)
    return batch.times * (lengths.mean() / lengths)[:, None]
