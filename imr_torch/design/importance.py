"""Information gain with every evidence by importance sampling from Gauss-Newton posteriors.

Nested Monte Carlo, ``mean_n log p(y_n | v_n) - log p(y_n)``, with inner samples from Gaussians
linearised at the optimum of each datum (Beck et al., CMAME 334, 2018): a finite number of them
leaves the value too high on average, for any proposal.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.design.drawing import (
    Drawn,
    draw_data,
    mixture_evidence,
    model_weights,
    normal_controls,
)
from imr_torch.design.estimator import InformationEstimator, check_at_least
from imr_torch.design.gain import InformationGain, Terms, summarise_terms
from imr_torch.design.likelihood import Data, Linear, infer_linear, log_likelihood
from imr_torch.design.refine import best_starts, refine_gels
from imr_torch.design.response import Response, Shot, radii
from imr_torch.errors import InputDataError
from imr_torch.material import ModelBelief
from imr_torch.types import DatasetValues


@dataclass(frozen=True)
class ImportanceSampling(InformationEstimator):
    """Every evidence by importance sampling: says how much a design tells, above the truth by its
    ``bias`` on average.

    Args:
        draws: gels per constitutive model that data are made of.
        inner: draws behind each evidence, per datum and model.
        refinements: Gauss-Newton steps that place the proposal where no datum's own gel can be the
            start.
        defence: share of each datum's inner samples from a wider proposal; 0 makes linear-Gaussian
            models exact.
        wider: its posterior standard deviations.
        behind: nats below the datum's own model at which an evidence is not sampled: it would not
            change the gain.

    >>> ImportanceSampling(draws=32, inner=64)
    ImportanceSampling(draws=32, inner=64, refinements=5, defence=0.25, wider=2.0, behind=25.0)
    """

    draws: int = 64
    inner: int = 32
    refinements: int = 5
    defence: float = 0.25
    wider: float = 2.0
    behind: float = 25.0

    def __post_init__(self) -> None:
        check_at_least(self, 2, "draws", "inner")
        check_at_least(self, 0, "refinements")
        if not 0.0 <= self.defence <= 0.5:
            raise InputDataError(
                f"{type(self).__name__}.defence is {self.defence}; expected a share in [0, 0.5]."
            )

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`~imr_torch.design.estimator.InformationEstimator`."""
        weights = model_weights(shot)
        controls = normal_controls(shot, [self.draws] * len(weights), generator)
        drawn = draw_data(shot, controls, generator)
        own = [
            infer_linear(drawn.data[rows], part, shot.plan)
            for rows, part in zip(drawn.rows, drawn.parts, strict=True)
        ]
        rival = torch.cat([linear.log_evidence for linear in own])
        found = [self._sample_evidence(drawn, i, rival, shot, generator) for i in range(len(own))]
        logs = torch.stack([log for log, _ in found])
        variances = torch.stack([variance for _, variance in found])
        total = mixture_evidence(list(logs), shot)
        shares = torch.tensor(weights, dtype=torch.float64)[:, None] * (logs - total).exp()
        spread = (shares.square() * variances).sum(0)
        terms = []
        bias = 0.0
        for i, (weight, rows) in enumerate(zip(weights, drawn.rows, strict=True)):
            log = logs[i, rows]
            about = own[i].log_likelihood - log - _noise_control(drawn.parts[i].controls, own[i])
            which = log - total[rows]
            control = _gel_control(drawn.controls[i], own[i])
            terms.append(Terms(weight, about, which, drawn.orders[i], control))
            if len(log):
                bias += 0.5 * weight * float(spread[rows].mean())
        return summarise_terms(terms, bias=bias)

    def _sample_evidence(
        self, drawn: Drawn, model: int, rival: Tensor, shot: Shot, source: torch.Generator
    ) -> tuple[DatasetValues, DatasetValues]:
        """Log evidence of all data under one model by importance sampling from Gauss-Newton
        posteriors, and the relative variance of its Monte Carlo mean.

        Args:
            drawn: gels and data.
            model: which model.
            rival: log evidence of each datum under its own model, linearised.
            shot: designs and how they are observed.
            source: of the samples.
        """
        count = len(drawn.data)
        gels = drawn.parts[model]
        part = shot.belief.models[model]
        log = torch.full((count,), -math.inf, dtype=torch.float64)
        variance = torch.zeros(count, dtype=torch.float64)
        own = len(gels)
        if own < 2:
            return log, variance
        others = drawn.rows_outside(model)
        rows = torch.cat((torch.arange(count)[drawn.rows[model]], others))
        data = drawn.data[rows]
        start = torch.cat((torch.arange(own), best_starts(drawn.data[others], gels, shot)))
        at = refine_gels(data, gels[start], shot, part, self.refinements)
        log[rows] = infer_linear(data, at, shot.plan).log_evidence
        close = log[rows] > rival[rows] - self.behind
        close[:own] = True
        kept = rows[close]
        log[kept], variance[kept] = self._average_weights(
            data[close], at[close], shot, part, source
        )
        return log, variance

    def _average_weights(
        self, data: Data, at: Response, shot: Shot, part: ModelBelief, source: torch.Generator
    ) -> tuple[DatasetValues, DatasetValues]:
        """Log mean of importance weights for each datum, and its relative variance.

        The proposal is a mixture, sampled in fixed proportion and weighted by its whole density
        (Owen & Zhou, J. Am. Stat. Assoc. 95, 2000): the Gauss-Newton posterior, and a wider one,
        which bounds the weights of a curved posterior.

        Args:
            data: ``n`` data.
            at: where each proposal is linearised; nuisances are taken from there.
            shot: designs and how they are observed.
            part: the model.
            source: of the samples.
        """
        linear = infer_linear(data, at, shot.plan)
        d = at.controls.shape[1]
        wide = round(self.defence * self.inner)
        z = torch.randn(len(data), self.inner, d, generator=source, dtype=torch.float64)
        z[:, self.inner - wide :] *= self.wider
        away = torch.linalg.solve_triangular(linear.chol.mT, z.mT, upper=True).mT
        v = linear.mean[:, None] + away
        square = z.square().sum(-1)
        widths = torch.tensor([1.0, self.wider], dtype=torch.float64)[:, None, None]
        shares = torch.tensor([self.inner - wide, wide], dtype=torch.float64) / self.inner
        densities = (
            shares.log()[:, None, None]
            + linear.information[:, None]
            - 0.5 * square / widths.square()
            - d * widths.log()
        )
        log = _log_joint(data, v, at, shot, part) - torch.logsumexp(densities, 0)
        good = torch.isfinite(log)
        count = good.sum(1).clamp_min(1)
        mean = torch.logsumexp(log, 1) - count.log()
        relative = torch.where(good, (log - mean[:, None]).exp(), 1.0)
        return mean, (relative - 1.0).square().sum(1) / (count - 1).clamp_min(1) / count


def _noise_control(controls: Tensor, linear: Linear) -> Tensor:
    """What the datum's own noise adds to its log ratio in the linearised model, which has mean
    zero: ``n``.

    The log ratio of likelihood and linearised evidence has, over the noise and at a fixed gel
    ``v``, the mean ``1/2 log det(1 + G) - 1/2 (tr H - v^T H v)`` with ``H = G (1 + G)^-1``.
    """
    ratio = linear.log_likelihood - linear.log_evidence
    return ratio - linear.information - 0.5 * _excess_square(controls, linear.averaging)


def _gel_control(controls: Tensor, linear: Linear) -> Tensor:
    """Minus the part of that mean that varies with the gel, at the ``H`` of the *other* draws: mean
    zero over gels.
    """
    count = len(linear.mean)
    if count < 2:
        return torch.zeros(len(controls), dtype=controls.dtype)
    total = linear.averaging.sum(0)
    others = (total - linear.averaging) / (count - 1)
    rest = (total / count).expand(len(controls) - count, -1, -1)
    return -0.5 * _excess_square(controls, torch.cat((others, rest)))


def _excess_square(controls: Tensor, matrices: Tensor) -> Tensor:
    """``v^T H v - tr H`` of each row."""
    square = (controls[:, None] @ matrices @ controls[..., None])[:, 0, 0]
    return square - matrices.diagonal(dim1=-2, dim2=-1).sum(-1)


def _log_joint(data: Data, controls: Tensor, at: Response, shot: Shot, part: ModelBelief) -> Tensor:
    """Log density of each datum and of each of its gels (``n x k x d``), with the nuisances of
    ``at``; ``-inf`` if failed.
    """
    radius = radii(shot, part, controls)
    good = torch.isfinite(radius).flatten(2).all(-1)
    pairs = Data(data.radius[:, None], data.window[:, None])
    log = log_likelihood(
        pairs, torch.where(good[..., None, None], radius, 1.0), at.by_nuisance[:, None], shot.plan
    )
    return torch.where(good, log - 0.5 * controls.square().sum(-1), -math.inf)
