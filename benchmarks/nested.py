"""Nested Monte Carlo with draws of the belief itself: bounds of the information gain that rest on
no linearisation.

    I ~ mean_n log p(y_n | v_n) - log mean_l p(y_n | v_l).

:class:`NestedMonteCarlo` sums over fresh gels and is too high on average; :class:`PriorContrastive`
puts the datum's own gel among them and is too low, at most ``log L`` (Foster et al., AISTATS 2020).

All data share the inner samples. The influence of a draw is the derivative of the estimate with
respect to the draw's weight, wherever the draw is used (the infinitesimal jackknife, Jaeckel 1972).
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from imr_torch.design.gain import (
    InformationEstimator,
    InformationGain,
    mean_deviations,
    with_influence,
)
from imr_torch.design.likelihood import Data, Gels, linearise_data, simulate_gels
from imr_torch.design.response import Plan, Response, Shot
from imr_torch.errors import check_at_least
from imr_torch.float64 import ones, randn, zeros


def log_likelihood(
    data: Data,
    radius: Tensor,
    by_nuisance: Tensor,
    plan: Plan,
) -> Tensor:
    """Log density of data given gels that show ``radius``.

    All shapes ``... x q x T`` broadcast, the result is ``...``.
    """
    log, equations = linearise_data(
        data, radius, radius[..., None][..., :0], by_nuisance, plan
    )
    still = by_nuisance.new_zeros(by_nuisance.shape[-3], by_nuisance.shape[-1])
    return log + equations.with_prior(still[0, :0], still).log_nuisance_integral


def pairwise_log_likelihood(
    data: Data, gels: Response, plan: Plan, *, block: int = 4_000_000
) -> Tensor:
    """``n x m`` log densities of every datum given every gel, ``block`` numbers at once."""
    per_row = gels.radius.numel() * (1 + gels.by_nuisance.shape[-1])
    rows = max(1, block // max(1, per_row))
    blocks = [data[i : i + rows] for i in range(0, max(1, len(data)), rows)]
    return torch.cat(
        [
            log_likelihood(
                Data(b.radius[:, None], b.window[:, None]),
                gels.radius,
                gels.by_nuisance,
                plan,
            )
            for b in blocks
        ]
    )


@dataclass(frozen=True)
class NestedMonteCarlo(InformationEstimator):
    """Evidences from fresh draws of the belief: above the gain on average; what other estimators
    are checked against.

    Args:
        draws: gels per constitutive model that data are made of.
        inner: draws of the belief per model, shared by all data.

    >>> NestedMonteCarlo(inner=1)
    Traceback (most recent call last):
    imr_torch.errors.InputDataError: NestedMonteCarlo.inner is 1; expected at least 2.
    """

    draws: int = 200
    inner: int = 1000
    contrastive: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_at_least(self, 2, "draws", "inner")

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`~imr_torch.design.gain.InformationEstimator`."""

        def draw_gels(count: int) -> Gels:
            controls = [
                randn(count, len(part.names), generator=generator)
                for part in shot.belief.models
            ]
            return simulate_gels(shot, controls, gel=False)

        gels = draw_gels(self.draws)
        data = gels.observe(shot, generator)
        log_weights = shot.belief.log_probabilities
        return _estimate_gain(
            gels,
            data,
            draw_gels(self.inner),
            log_weights,
            shot.plan,
            contrastive=self.contrastive,
        )


@dataclass(frozen=True)
class PriorContrastive(NestedMonteCarlo):
    """The same with the datum's own gel among the inner samples: below the gain on average, at most
    ``log(inner)`` a model.

    Args:
        draws: gels per constitutive model that data are made of.
        inner: draws of the belief per model, shared by all data but for one of each, which is its
            own gel.

    >>> PriorContrastive(draws=50).inner
    1000
    """

    contrastive: ClassVar[bool] = True


def _estimate_gain(
    gels: Gels,
    data: Data,
    inner: Gels,
    log_weights: Tensor,
    plan: Plan,
    *,
    contrastive: bool = False,
) -> InformationGain:
    """The gain, from mean likelihoods over gels.

    Args:
        gels: gels that data were made of.
        data: one of each.
        inner: gels that evidences are summed over.
        log_weights: log probability of each model.
        plan: how the data were observed.
        contrastive: whether a datum's own gel takes the place of the first inner gel of its model.
    """
    rows = gels.rows
    likelihoods = [
        log_likelihood(data[own], part.radius, part.by_nuisance, plan)
        for own, part in zip(rows, gels.parts, strict=True)
    ]
    blocks = [pairwise_log_likelihood(data, part, plan) for part in inner.parts]
    if contrastive:
        for block, own, likelihood in zip(blocks, rows, likelihoods, strict=True):
            block[own, :1] = likelihood[:, None]
    models = len(blocks)

    def mean_gains(*weights: Tensor) -> Tensor:
        """About parameters and model, by the weights of data and of inner gels, each 1."""
        logs = [
            torch.logsumexp(block + w.log(), 1) - math.log(max(len(w), 1))
            for block, w in zip(blocks, weights[-models:], strict=True)
        ]
        total = torch.logsumexp(torch.stack(logs) + log_weights[:, None], 0)
        both = zeros(2)
        for i, some in enumerate(rows):
            own = logs[i][some]
            mean = torch.stack((likelihoods[i] - own, own - total[some])) @ weights[i]
            both = both + mean * log_weights[i].exp() / max(len(own), 1)
        return both

    samples = [gels, inner]
    parts = [part for sample in samples for part in sample.parts]
    weights = tuple(ones(len(part)) for part in parts)
    slopes = torch.autograd.functional.jacobian(mean_gains, weights)
    influence = []
    for place, order in enumerate(order for sample in samples for order in sample.orders):
        # a datum's own gel is in the place of this one
        first = int(contrastive and place >= models)
        own = slopes[place].mT[first:]
        found = zeros(len(order), 2)
        found[order[first : first + len(own)]] = mean_deviations(len(own) * own)
        influence.append(found)
    parameters, model = mean_gains(*weights).tolist()
    asked = sum(map(len, gels.orders))
    gain = InformationGain(parameters, model, 0.0, len(data), asked)
    return with_influence(gain, torch.cat(influence))
