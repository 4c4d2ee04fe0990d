"""Nested Monte Carlo with draws of the belief itself: bounds of the information gain that rest on
no linearisation.

    I ~ mean_n log p(y_n | v_n) - log mean_l p(y_n | v_l).

:class:`NestedMonteCarlo` sums over fresh gels and is too high on average; :class:`PriorContrastive`
puts the datum's own gel among them and is too low, at most ``log L`` (Foster et al., AISTATS 2020).
All data share the inner samples, so the standard error has a part from those, by the delta method.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imr_torch.design.estimator import InformationEstimator, check_at_least
from imr_torch.design.gain import InformationGain, Terms, summarise
from imr_torch.design.likelihood import Data, log_likelihood, observe, pairwise
from imr_torch.design.response import Response, Shot, respond


@dataclass(frozen=True)
class Simulated:
    """Gels of one model that could be simulated.

    Args:
        gels: the gels.
        order: the numbers of all draws, those that could be simulated first.
    """

    gels: Response
    order: Int[Tensor, "drawn"]


def draw_gels(shot: Shot, counts: list[int], source: torch.Generator) -> list[Simulated]:
    """Gels of each model, without sensitivities."""
    parts = []
    for part, count in zip(shot.belief.models, counts, strict=True):
        v = torch.randn(count, len(part.names), generator=source, dtype=torch.float64)
        seen = respond(shot, part, v, gel=False)
        order = torch.cat((torch.nonzero(seen.good)[:, 0], torch.nonzero(~seen.good)[:, 0]))
        parts.append(Simulated(seen[seen.good], order))
    return parts


@dataclass(frozen=True)
class Outer:
    """Data of all models, the density of each given its own gel, which model each is of, and how
    much each counts.
    """

    data: Data
    likelihood: Float[Tensor, "data"]
    model: Int[Tensor, "data"]
    share: Float[Tensor, "data"]


def outer_data(
    parts: list[Simulated], weights: Float[Tensor, "models"], shot: Shot, source: torch.Generator
) -> Outer:
    """A datum of each gel.

    Args:
        parts: gels of each model.
        weights: what the data of each model count for together.
        shot: designs and how they are observed.
        source: of nuisances and noise.
    """
    gels = [part.gels for part in parts]
    data = [observe(seen, shot.plan, source) for seen in gels]
    likelihood = [
        log_likelihood(d, seen.radius, seen.by_nuisance, shot.plan)
        for d, seen in zip(data, gels, strict=True)
    ]
    model = torch.cat([torch.full((len(seen),), i) for i, seen in enumerate(gels)])
    share = torch.cat(
        [
            torch.full((len(seen),), float(w) / max(len(seen), 1))
            for seen, w in zip(gels, weights, strict=True)
        ]
    )
    every = Data(torch.cat([d.radius for d in data]), torch.cat([d.window for d in data]))
    return Outer(every, torch.cat(likelihood), model, share.to(torch.float64))


@dataclass(frozen=True)
class Evidence:
    """Inner sums of all data.

    Args:
        own: log evidence under the datum's own model.
        total: over all models.
        pulls: per model an ``m x 2`` tensor, what each inner sample takes from the mean gain about
            (parameters, model).
        effective: Kish effective number of inner samples.
    """

    own: Float[Tensor, "data"]
    total: Float[Tensor, "data"]
    pulls: list[Float[Tensor, "_ 2"]]
    effective: Float[Tensor, "data"]


def inner_sums(
    logs: list[Float[Tensor, "data _"]], log_weights: Float[Tensor, "models"], outer: Outer
) -> Evidence:
    """Sums over inner samples.

    Args:
        logs: per model an ``N x m`` tensor, log density of every datum given every inner sample.
        log_weights: log probability of each model.
        outer: the data.
    """
    each = torch.stack([_log_mean(block) for block in logs])
    total = torch.logsumexp(each + log_weights[:, None], 0)
    own = each.gather(0, outer.model[None])[0]
    pulls = []
    square = torch.zeros_like(total)
    for i, (block, weight) in enumerate(zip(logs, log_weights.tolist(), strict=True)):
        scaled = block - math.log(max(block.shape[1], 1))
        of_total = (scaled + weight - total[:, None]).exp()
        mine = torch.where(outer.model == i, outer.share, 0.0)
        of_own = (
            mine @ torch.where(outer.model[:, None] == i, scaled - own[:, None], -math.inf).exp()
        )
        pulls.append(torch.stack((of_own, outer.share @ of_total - of_own), 1))
        square = square + of_total.square().sum(1)
    return Evidence(own, total, pulls, 1.0 / square)


def _log_mean(block: Tensor) -> Tensor:
    if block.shape[1] == 0:
        return torch.full(block.shape[:1], -math.inf, dtype=block.dtype)
    return torch.logsumexp(block, 1) - math.log(block.shape[1])


def scaled_deviations(pulls: Float[Tensor, "inner 2"]) -> Float[Tensor, "inner 2"]:
    """Minus the deviations of ``m x 2`` pulls from their mean: the influence of inner samples on
    the gain.
    """
    count = len(pulls)
    return (
        (pulls.mean(0) - pulls) * (count / (count - 1)) ** 0.5
        if count > 1
        else torch.zeros_like(pulls)
    )


@dataclass(frozen=True)
class _Nested(InformationEstimator):
    """What :class:`NestedMonteCarlo` and :class:`PriorContrastive` have in common.

    Args:
        draws: gels per constitutive model that data are made of.
        inner: draws of the belief per model, shared by all data.
    """

    draws: int = 200
    inner: int = 1000

    def __post_init__(self) -> None:
        check_at_least(self, 2, "draws", "inner")

    def _estimate(
        self, shot: Shot, source: torch.Generator, *, contrastive: bool
    ) -> InformationGain:
        log_weights = shot.belief.log_probabilities
        weights = log_weights.exp()
        models = len(log_weights)
        parts = draw_gels(shot, [self.draws] * models, source)
        outer = outer_data(parts, weights, shot, source)
        inner = draw_gels(shot, [self.inner] * models, source)
        logs = [pairwise(outer.data, part.gels, shot.plan) for part in inner]
        if contrastive:
            for i, block in enumerate(logs):
                own = outer.model == i
                block[own, :1] = outer.likelihood[own, None]
        evidence = inner_sums(logs, log_weights, outer)
        shared = []
        for part, pulls in zip(inner, evidence.pulls, strict=True):
            influence = torch.zeros(self.inner, 2, dtype=torch.float64)
            first = 1 if contrastive else 0
            influence[part.order[first : len(pulls)]] = scaled_deviations(pulls[first:])
            shared.append(influence)
        terms = []
        for i, weight in enumerate(weights.tolist()):
            mine = outer.model == i
            about = outer.likelihood - evidence.own
            which = evidence.own - evidence.total
            terms.append(Terms(weight, about[mine], which[mine], parts[i].order))
        return summarise(
            terms, shared=torch.cat(shared), effective=float(outer.share @ evidence.effective)
        )


@dataclass(frozen=True)
class NestedMonteCarlo(_Nested):
    """Evidences from fresh draws of the belief: above the gain on average; what other estimators
    are checked against.

    Args:
        draws: gels per constitutive model that data are made of.
        inner: draws of the belief per model, shared by all data.

    >>> NestedMonteCarlo(inner=1)
    Traceback (most recent call last):
    imr_torch.errors.InputDataError: NestedMonteCarlo.inner is 1; at least 2 are needed for an error
    estimate.
    """

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`~imr_torch.design.estimator.InformationEstimator`."""
        return self._estimate(shot, generator, contrastive=False)


@dataclass(frozen=True)
class PriorContrastive(_Nested):
    """The same with the datum's own gel among the inner samples: below the gain on average, at most
    ``log(inner)`` a model.

    Args:
        draws: gels per constitutive model that data are made of.
        inner: draws of the belief per model, shared by all data but for one of each, which is its
            own gel.

    >>> PriorContrastive(draws=50).inner
    1000
    """

    def __call__(self, shot: Shot, generator: torch.Generator) -> InformationGain:
        """See :class:`~imr_torch.design.estimator.InformationEstimator`."""
        return self._estimate(shot, generator, contrastive=True)
