"""Information gain with every evidence by importance sampling from Gauss-Newton posteriors.

Nested Monte Carlo, ``mean_n log p(y_n | v_n) - log p(y_n)``, with inner samples from Gaussians
linearised at the optimum of each datum (Beck et al., CMAME 334, 2018): a finite number of them
leaves the value too high on average, for any proposal. Adaptive contrastive estimation (Foster et
al., AISTATS 2020) counts the datum's own gel among the inner samples and finds its proposals
without it, which leaves the value too low.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.design.drawing import Drawn, draw, mixture, model_weights, normal_controls
from imr_torch.design.estimator import InformationEstimator, check_at_least
from imr_torch.design.gain import InformationGain, Terms, summarise
from imr_torch.design.likelihood import Data, Linear, infer, log_likelihood
from imr_torch.design.refine import best_starts, refine
from imr_torch.design.response import Response, Shot, radii
from imr_torch.errors import InputDataError
from imr_torch.material import ModelBelief

_WIDER = 2.0  # posterior standard deviations of the wider part of a proposal
_BEHIND = 25.0  # nats below the datum's own model at which an evidence need not be sampled


@dataclass(frozen=True)
class _Sampled(InformationEstimator):
    """What :class:`ImportanceSampling` and :class:`AdaptiveContrastive` have in common.

    Args:
        draws: gels per constitutive model that data are made of.
        inner: draws behind each evidence, per datum and model.
        refinements: Gauss-Newton steps that place the proposal where no datum's own gel can be the
            start.
        defence: share of each datum's inner samples from a wider proposal; 0 makes linear-Gaussian
            models exact.
    """

    draws: int = 64
    inner: int = 32
    refinements: int = 5
    defence: float = 0.25

    def __post_init__(self) -> None:
        check_at_least(self, 2, "draws", "inner")
        check_at_least(self, 0, "refinements")
        if not 0.0 <= self.defence <= 0.5:
            raise InputDataError(
                f"{type(self).__name__}.defence is {self.defence}; expected a share in [0, 0.5]."
            )

    def _estimate(
        self, shot: Shot, source: torch.Generator, *, contrastive: bool
    ) -> InformationGain:
        drawn = draw(shot, normal_controls(shot, self.draws, source), source)
        own = [
            infer(drawn.data[rows], part, shot.plan)
            for rows, part in zip(drawn.rows, drawn.parts, strict=True)
        ]
        rival = torch.cat([linear.log_evidence for linear in own])
        found = [
            self._evidence(drawn, i, rival, shot, source, contrastive) for i in range(len(own))
        ]
        total = mixture([f.log for f in found], shot)
        terms = []
        bias = 0.0
        effective = 0.0
        for i, (weight, rows) in enumerate(zip(model_weights(shot), drawn.rows, strict=True)):
            log = found[i].log[rows]
            parameters = (
                own[i].log_likelihood - log - _noise_control(drawn.parts[i].controls, own[i])
            )
            terms.append(
                Terms(
                    weight,
                    parameters,
                    log - total[rows],
                    drawn.orders[i],
                    _gel_control(drawn.controls[i], own[i]),
                )
            )
            if len(log):
                shares = [
                    w * (f.log - total).exp()[rows]
                    for w, f in zip(model_weights(shot), found, strict=True)
                ]
                spread = torch.stack(
                    [
                        share.square() * f.variance[rows]
                        for share, f in zip(shares, found, strict=True)
                    ]
                ).sum(0)
                bias += 0.5 * weight * float(spread.mean())
                effective += weight * float(
                    (self.inner / (1.0 + self.inner * found[i].variance[rows])).mean()
                )
        return summarise(terms, bias=None if contrastive else bias, effective=effective)

    def _evidence(
        self,
        drawn: Drawn,
        model: int,
        rival: Tensor,
        shot: Shot,
        source: torch.Generator,
        contrastive: bool,
    ) -> "_Evidence":
        """Log evidence of all data under one model by importance sampling from Gauss-Newton
        posteriors.

        Args:
            drawn: gels and data.
            model: which model.
            rival: log evidence of each datum under its own model, linearised.
            shot: designs and how they are observed.
            source: of the samples.
            contrastive: whether the datum's own gel counts among its samples.
        """
        count = len(drawn.data)
        gels = drawn.parts[model]
        part = shot.belief.models[model]
        result = _Evidence(
            torch.full((count,), -math.inf, dtype=torch.float64),
            torch.zeros(count, dtype=torch.float64),
        )
        if len(gels) < 2:
            return result
        rows = torch.cat((torch.arange(count)[drawn.rows[model]], drawn.outside(model)))
        data = drawn.data[rows]
        own = len(gels)
        start = torch.arange(own)
        if contrastive:
            start = best_starts(data[:own], gels, shot, not_own=True)[0]
        if len(data) > own:
            start = torch.cat((start, best_starts(data[own:], gels, shot)[0]))
        at = refine(data, gels[start], shot, part, self.refinements)
        result.log[rows] = infer(data, at, shot.plan).log_evidence
        close = result.log[rows] > rival[rows] - _BEHIND
        close[:own] = True
        truth = gels.controls if contrastive else None
        log, variance = self._sample(data[close], at[close], truth, shot, part, source)
        result.log[rows[close]], result.variance[rows[close]] = log, variance
        return result

    def _sample(
        self,
        data: Data,
        at: Response,
        truth: Tensor | None,
        shot: Shot,
        part: ModelBelief,
        source: torch.Generator,
    ) -> tuple[Tensor, Tensor]:
        """Log mean of importance weights for each datum, and its relative variance.

        The proposal is a mixture, sampled in fixed proportion and weighted by its whole density
        (Owen & Zhou, J. Am. Stat. Assoc. 95, 2000): the Gauss-Newton posterior; a wider one, which
        bounds the weights of a curved posterior; and, where the datum's own gel counts among the
        samples, the belief, so that a proposal in the wrong place costs some nats at most.

        Args:
            data: ``n`` data.
            at: where each proposal is linearised; nuisances are taken from there.
            truth: controls of the gels of the first data, which count as a sample of theirs.
            shot: designs and how they are observed.
            part: the model.
            source: of the samples.
        """
        linear = infer(data, at, shot.plan)
        d = at.controls.shape[1]
        inner = self.inner
        wide = round(self.defence * inner)
        belief = 0 if truth is None else wide
        z = torch.randn(len(data), inner, d, generator=source, dtype=torch.float64)
        scale = torch.ones(inner, 1, dtype=torch.float64)
        scale[inner - wide :] = _WIDER
        v = (
            linear.mean[:, None]
            + torch.linalg.solve_triangular(linear.chol.mT, (scale * z).mT, upper=True).mT
        )
        v[:, inner - wide - belief : inner - wide] = z[:, inner - wide - belief : inner - wide]
        if truth is not None:
            v[: len(truth), 0] = truth
        away = ((v - linear.mean[:, None]) @ linear.chol).square().sum(-1)
        densities = torch.stack(
            (
                linear.information[:, None] - 0.5 * away,
                linear.information[:, None] - 0.5 * away / _WIDER**2 - d * math.log(_WIDER),
                -0.5 * v.square().sum(-1),
            )
        )
        shares = torch.tensor([inner - wide - belief, wide, belief], dtype=torch.float64) / inner
        log = _log_joint(data, v, at, shot, part) - torch.logsumexp(
            densities + shares.log()[:, None, None], 0
        )
        good = torch.isfinite(log)
        count = good.sum(1).clamp_min(1)
        mean = torch.logsumexp(log, 1) - count.log()
        relative = torch.where(good, (log - mean[:, None]).exp(), 1.0)
        return mean, (relative - 1.0).square().sum(1) / (count - 1).clamp_min(1) / count


@dataclass(frozen=True)
class ImportanceSampling(_Sampled):
    """Every evidence by importance sampling: says how much a design tells, above the truth by its
    ``bias`` on average.

    Args:
        draws: gels per constitutive model that data are made of.
        inner: draws behind each evidence, per datum and model.
        refinements: Gauss-Newton steps that place the proposal where no datum's own gel can be the
            start.
        defence: share of each datum's inner samples from a wider proposal; 0 makes linear-Gaussian
            models exact.

    >>> ImportanceSampling(draws=32, inner=64)
    ImportanceSampling(draws=32, inner=64, refinements=5, defence=0.25)
    """

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`~imr_torch.design.estimator.InformationEstimator`."""
        return self._estimate(shot, generator, contrastive=False)


@dataclass(frozen=True)
class AdaptiveContrastive(_Sampled):
    """The same with the datum's own gel among its inner samples: below the truth on average, and at
    most ``log(inner)``.

    Args:
        draws: gels per constitutive model that data are made of.
        inner: draws behind each evidence, per datum and model.
        refinements: Gauss-Newton steps that place the proposal.
        defence: share of each datum's inner samples from a wider proposal, and as many from the
            belief.

    >>> AdaptiveContrastive(draws=32, inner=64).inner
    64
    """

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`~imr_torch.design.estimator.InformationEstimator`."""
        return self._estimate(shot, generator, contrastive=True)


@dataclass(frozen=True)
class _Evidence:
    """Log evidence of every datum under one model, and the relative variance of its Monte Carlo
    mean; both ``n``.
    """

    log: Tensor
    variance: Tensor


def _noise_control(controls: Tensor, linear: Linear) -> Tensor:
    """What the datum's own noise adds to its log ratio in the linearised model, which has mean
    zero: ``n``.

    The log ratio of likelihood and linearised evidence has, over the noise and at a fixed gel
    ``v``, the mean ``1/2 log det(1 + G) - 1/2 (tr H - v^T H v)`` with ``H = G (1 + G)^-1``.
    """
    ratio = linear.log_likelihood - linear.log_evidence
    return ratio - linear.information - 0.5 * _excess(controls, linear.averaging)


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
    return -0.5 * _excess(controls, torch.cat((others, rest)))


def _excess(controls: Tensor, matrices: Tensor) -> Tensor:
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
