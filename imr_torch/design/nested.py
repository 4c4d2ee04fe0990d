"""Nested Monte Carlo with draws of the belief itself: the published estimator, and a bracket from fresh inner samples.

    I ~ mean_n log p(y_n | v_n) - log mean_l p(y_n | v_l).

``paper`` sums over the data's own gels (Huan & Marzouk, J. Comput. Phys. 232, 2013; arXiv 2409.00011, eq. of the NMC
estimator): one of them made the datum, so the value never exceeds ``log N``. ``nested`` sums over fresh gels and is too high
on average; ``contrastive`` puts the datum's own gel among them and is too low, at most ``log L`` (Foster et al., AISTATS
2020). All data share the inner samples, so the standard error has a part from those, by the delta method.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.design.gain import Estimator, InformationGain, Terms, summarise
from imr_torch.design.likelihood import Data, log_likelihood, observe, pairwise
from imr_torch.design.response import Response, Shot, respond

_IMPROBABLE = 1e-2  # models below this probability were not simulated in the published search


def _draw(shot: Shot, counts: list[int], source: torch.Generator) -> list[Response]:
    """Gels of each model that could be simulated."""
    parts = []
    for part, count in zip(shot.belief.models, counts, strict=True):
        v = torch.randn(count, len(part.names), generator=source, dtype=torch.float64)
        seen = respond(shot, part, v, gel=False)
        parts.append(seen[seen.good])
    return parts


@dataclass(frozen=True)
class _Evidence:
    """Inner sums of all data.

    Args:
        own: ``N`` tensor, log evidence under the datum's own model.
        total: ``N`` tensor, over all models.
        pull: per model an ``m`` tensor, what each inner sample takes from the mean over all data.
        effective: ``N`` tensor, Kish effective number of inner samples.
    """

    own: Tensor
    total: Tensor
    pull: list[Tensor]
    effective: Tensor


def _evidence(logs: list[Tensor], log_weights: Tensor, model: Tensor, share: Tensor) -> _Evidence:
    """Sums over inner samples, one block ``N x m`` of log densities per model, with each model's log weight.

    Args:
        logs: log density of every datum given every inner sample of a model.
        log_weights: log probability of each model.
        model: ``N`` tensor, which model each datum is of.
        share: ``N`` tensor, weight of each datum in the gain.
    """
    each = torch.stack([_log_mean(block) for block in logs])
    total = torch.logsumexp(each + log_weights[:, None], 0)
    scale = [w - math.log(max(block.shape[1], 1)) for block, w in zip(logs, log_weights.tolist(), strict=True)]
    parts = [(block + w - total[:, None]).exp() for block, w in zip(logs, scale, strict=True)]
    square = torch.cat(parts, 1).square().sum(1)
    return _Evidence(each.gather(0, model[None])[0], total, [share @ part for part in parts], 1.0 / square)


def _log_mean(block: Tensor) -> Tensor:
    if block.shape[1] == 0:
        return torch.full(block.shape[:1], -math.inf, dtype=block.dtype)
    return torch.logsumexp(block, 1) - math.log(block.shape[1])


@dataclass(frozen=True)
class _Outer:
    """Data of all models, the density of each given its own gel, and how much each counts."""

    data: Data
    likelihood: Tensor
    model: Tensor
    share: Tensor


def _outer(parts: list[Response], weights: Tensor, shot: Shot, source: torch.Generator) -> _Outer:
    data = [observe(part, shot.plan, source) for part in parts]
    likelihood = [log_likelihood(d, part.radius, part.by_nuisance, shot.plan) for d, part in zip(data, parts, strict=True)]
    model = torch.cat([torch.full((len(part),), i) for i, part in enumerate(parts)])
    share = torch.cat([torch.full((len(part),), float(w) / max(len(part), 1)) for part, w in zip(parts, weights, strict=True)])
    every = Data(torch.cat([d.radius for d in data]), torch.cat([d.window for d in data]))
    return _Outer(every, torch.cat(likelihood), model, share.to(torch.float64))


def _gain(outer: _Outer, evidence: _Evidence, weights: Tensor, drawn: list[int], shared: float) -> InformationGain:
    about = outer.likelihood - evidence.own
    which = evidence.own - evidence.total
    terms = [
        Terms(float(w), about[outer.model == i], which[outer.model == i], drawn[i]) for i, w in enumerate(weights.tolist())
    ]
    effective = float(outer.share @ evidence.effective)
    return summarise(terms, shared=shared, effective=effective)


def nested(shot: Shot, estimator: Estimator, source: torch.Generator) -> InformationGain:
    """The gain from fresh inner samples of the belief, for the methods ``nested`` and ``contrastive``."""
    log_weights = shot.belief.log_probabilities
    weights, models = log_weights.exp(), len(log_weights)
    drawn = [estimator.draws] * models
    outer = _outer(_draw(shot, drawn, source), weights, shot, source)
    inner = _draw(shot, [estimator.inner] * models, source)
    logs = [pairwise(outer.data, part, shot.plan) for part in inner]
    if estimator.method == "contrastive":
        for i, block in enumerate(logs):
            own = outer.model == i
            block[own, :1] = outer.likelihood[own, None]
    evidence = _evidence(logs, log_weights, outer.model, outer.share)
    fresh = [pull[1:] if estimator.method == "contrastive" else pull for pull in evidence.pull]
    shared = sum(len(pull) * float(pull.var()) for pull in fresh if len(pull) > 1)
    return _gain(outer, evidence, weights, drawn, shared)


def paper(shot: Shot, estimator: Estimator, source: torch.Generator) -> InformationGain:
    """The published estimator: draws in proportion to the models' probabilities, used for data and evidence alike."""
    probable = shot.belief.log_probabilities.exp() > _IMPROBABLE
    count = estimator.draws * len(shot.belief.models)
    wanted = (count * shot.belief.log_probabilities.exp()).round()
    drawn = torch.where(probable, wanted, 0.0).long().tolist()
    parts = _draw(shot, drawn, source)
    sizes = torch.tensor([float(len(part)) for part in parts], dtype=torch.float64)
    weights = sizes / sizes.sum().clamp_min(1.0)
    outer = _outer(parts, weights, shot, source)
    logs = [pairwise(outer.data, part, shot.plan) for part in parts]
    evidence = _evidence(logs, weights.log(), outer.model, outer.share)
    gain = _gain(outer, evidence, weights, drawn, 0.0)
    influence = outer.share * (outer.likelihood - evidence.total) - torch.cat(evidence.pull)
    variance = sum(float(rows.var()) * len(rows) for i in range(len(parts)) if len(rows := influence[outer.model == i]) > 1)
    return InformationGain(gain.parameters, gain.model, variance, gain.counted, gain.drawn, None, gain.effective)
