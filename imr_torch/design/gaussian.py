"""Information gain with Gauss-Newton pictures of the posterior: in closed form, or as proposals of importance samples.

For draws ``v_n`` of the belief with prediction ``f_n`` and sensitivity ``J_n``, whitened by noise and prior,

    I(theta; y | model) ~ mean_n 1/2 log det(1 + J_n^T J_n)                      (Long et al., CMAME 259, 2013)
    I(model; y)         ~ mean_n log p(y_n | m_n) - log sum_m p(m) p(y_n | m)

is the ``laplace`` method, with the Gaussian evidence linearised at the datum's own gel, or at the draw of another model
nearest to its own optimum; a belief that bends is drawn from its cloud, with its own precision about each draw in place of 1.
``importance`` keeps nested Monte Carlo, ``mean_n log p(y_n | v_n) - log p(y_n)``, and takes the inner samples from those
Gaussians (Beck et al., CMAME 334, 2018); a finite number of them leaves the value too high on average, for any proposal.
``adaptive`` counts the datum's own gel among the inner samples and finds its proposals without it, which leaves it too low
(adaptive contrastive estimation: Foster et al., AISTATS 2020).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.design.gain import Estimator, InformationGain, Terms, summarise
from imr_torch.design.likelihood import Data, Linear, infer, log_likelihood, observe
from imr_torch.design.response import Response, Shot, radii, respond
from imr_torch.material import ModelBelief

_LONGEST_STEP = 4.0  # standard deviations of the belief
_SHORTER = 0.3  # of a Gauss-Newton step, tried beside the whole one
_CLOSE = 0.1  # posterior standard deviations from the optimum
_WIDER = 2.0  # posterior standard deviations of the wider part of a proposal
_HOPELESS = 25.0  # nats below the datum's own model: the evidence then need not be sampled


@dataclass(frozen=True)
class _Drawn:
    """Gels of all models that could be simulated, and one datum of each.

    Args:
        parts: gels of each model.
        controls: ``draws x d`` tensor per model: all that were drawn, those that could be simulated first.
        data: of all gels, model after model.
        rows: which data are of each model.
    """

    parts: tuple[Response, ...]
    controls: tuple[Tensor, ...]
    data: Data
    rows: tuple[slice, ...]


def _controls(shot: Shot, draws: int, source: torch.Generator) -> list[Tensor]:
    """Draws of each model, ``draws x d``."""
    return [torch.randn(draws, len(part.names), generator=source, dtype=torch.float64) for part in shot.belief.models]


def _bent_controls(shot: Shot, draws: int, source: torch.Generator) -> list[Tensor]:
    """Draws of each model as of its cloud, if it has one."""
    drawn = _controls(shot, draws, source)
    for i, part in enumerate(shot.belief.models):
        if part.cloud is not None:
            rows = torch.randperm(len(part.cloud.controls), generator=source)
            rows = rows.repeat(-(-draws // len(rows)))[:draws]
            away = part.cloud.controls[rows] - part.mean
            drawn[i] = torch.linalg.solve_triangular(part.chol, away.mT, upper=False).mT
    return drawn


def _information(part: ModelBelief, gels: Response, picture: Linear) -> Tensor:
    """``1/2 log det(P + J^T J) - 1/2 log det P`` at each gel, with ``P`` the precision of the belief there: ``n``.

    The belief's own Gaussian has ``P = 1``. Where it bends, that Gaussian is far wider than the belief is anywhere, and would
    credit a design with what is known already.
    """
    if part.cloud is None:
        return picture.information
    at = part.mean + gels.controls @ part.chol.mT
    nearest = torch.cdist(at, part.cloud.controls, compute_mode="donot_use_mm_for_euclid_dist").argmin(1)
    before = part.chol.mT @ part.cloud.precisions[nearest] @ part.chol
    gained = picture.chol @ picture.chol.mT - torch.eye(before.shape[-1], dtype=before.dtype)
    return 0.5 * (torch.linalg.slogdet(before + gained).logabsdet - torch.linalg.slogdet(before).logabsdet)


def _respond(shot: Shot, controls: Sequence[Tensor]) -> list[Response]:
    """What the camera would see of the draws of each model."""
    return [respond(shot, part, v) for part, v in zip(shot.belief.models, controls, strict=True)]


def _observed(responses: Sequence[Response], shot: Shot, source: torch.Generator) -> _Drawn:
    """A datum of each gel that could be simulated."""
    parts, controls, data, rows, first = [], [], [], [], 0
    for every in responses:
        seen, v = every[every.good], every.controls
        controls.append(torch.cat((v[every.good], v[~every.good])))
        parts.append(seen)
        data.append(observe(seen, shot.plan, source))
        rows.append(slice(first, first + len(seen)))
        first += len(seen)
    together = Data(torch.cat([d.radius for d in data]), torch.cat([d.window for d in data]))
    return _Drawn(tuple(parts), tuple(controls), together, tuple(rows))


def _draw(shot: Shot, draws: int, source: torch.Generator) -> _Drawn:
    return _observed(_respond(shot, _controls(shot, draws, source)), shot, source)


def laplace(shot: Shot, estimator: Estimator, source: torch.Generator) -> InformationGain:
    """The gain from linearised posteriors and evidences alone."""
    drawn = _observed(_respond(shot, _bent_controls(shot, estimator.draws, source)), shot, source)
    own = [infer(drawn.data[rows], part, shot.plan) for rows, part in zip(drawn.rows, drawn.parts, strict=True)]
    logs = [_linear_evidence(drawn, i, own[i], shot) for i in range(len(own))]
    total = _mixture(logs, shot)
    terms = []
    for i, (weight, rows) in enumerate(zip(_weights(shot), drawn.rows, strict=True)):
        gained = _information(shot.belief.models[i], drawn.parts[i], own[i])
        terms.append(Terms(weight, gained, logs[i][rows] - total[rows], estimator.draws))
    return summarise(terms)


def importance(shot: Shot, estimator: Estimator, source: torch.Generator) -> InformationGain:
    """The gain with every evidence by importance sampling, for the methods ``importance`` and ``adaptive``."""
    drawn = _draw(shot, estimator.draws, source)
    own = [infer(drawn.data[rows], part, shot.plan) for rows, part in zip(drawn.rows, drawn.parts, strict=True)]
    rival = torch.cat([picture.log_evidence for picture in own])
    sampled = [_sampled_evidence(drawn, i, rival, shot, estimator, source) for i in range(len(own))]
    logs = [s.log for s in sampled]
    total = _mixture(logs, shot)
    terms, bias, effective = [], 0.0, 0.0
    for i, (weight, rows) in enumerate(zip(_weights(shot), drawn.rows, strict=True)):
        linear = own[i]
        parameters = linear.log_likelihood - logs[i][rows]
        steadied = parameters - _noise_control(drawn.parts[i].controls, linear)
        control = _gel_control(drawn.controls[i], linear)
        terms.append(Terms(weight, steadied, logs[i][rows] - total[rows], estimator.draws, control))
        if len(linear.mean):
            shares = [w * (log - total).exp()[rows] for w, log in zip(_weights(shot), logs, strict=True)]
            spread = sum(share.square() * s.variance[rows] for share, s in zip(shares, sampled, strict=True))
            bias += 0.5 * weight * float(torch.as_tensor(spread).mean())
            effective += weight * float((estimator.inner / (1.0 + estimator.inner * sampled[i].variance[rows])).mean())
    return summarise(terms, bias=bias if estimator.method == "importance" else None, effective=effective)


def _weights(shot: Shot) -> list[float]:
    return shot.belief.log_probabilities.exp().tolist()


def _mixture(logs: Sequence[Tensor], shot: Shot) -> Tensor:
    """Log evidence of each datum over all models."""
    return torch.logsumexp(torch.stack(list(logs)) + shot.belief.log_probabilities[:, None], dim=0)


def _noise_control(controls: Tensor, linear: Linear) -> Tensor:
    """What the datum's own noise adds to its log ratio in the linearised model, which has mean zero: ``n``.

    The log ratio of likelihood and linearised evidence has, over the noise and at a fixed gel ``v``, the mean
    ``1/2 log det(1 + G) - 1/2 (tr H - v^T H v)`` with ``H = G (1 + G)^-1``.
    """
    ratio = linear.log_likelihood - linear.log_evidence
    return ratio - linear.information - 0.5 * _excess(controls, linear.averaging)


def _gel_control(controls: Tensor, linear: Linear) -> Tensor:
    """Minus the part of that mean that varies with the gel, at the ``H`` of the *other* draws: mean zero over gels."""
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


def _linear_evidence(drawn: _Drawn, model: int, own: Linear, shot: Shot) -> Tensor:
    """Log evidence of all data under one model, linearised at their own gels or at the nearest draw."""
    if len(own.mean) == 0:
        return torch.full((len(drawn.data),), -math.inf, dtype=torch.float64)
    logs = torch.empty(len(drawn.data), dtype=torch.float64)
    logs[drawn.rows[model]] = own.log_evidence
    foreign = _outside(drawn, model)
    if len(foreign):
        logs[foreign] = _nearest(drawn.data[foreign], drawn.parts[model], shot)[1]
    return logs


def _outside(drawn: _Drawn, model: int) -> Tensor:
    """Rows of data that are of other models."""
    rows = torch.arange(len(drawn.data))
    return torch.cat((rows[: drawn.rows[model].start], rows[drawn.rows[model].stop :]))


def _nearest(data: Data, gels: Response, shot: Shot, *, not_own: bool = False) -> tuple[Tensor, Tensor]:
    """The gel whose linearised optimum is nearest to itself, for each datum, and the evidence linearised there.

    Args:
        data: ``n`` data.
        gels: candidates.
        shot: how they are observed.
        not_own: whether row ``i`` of the data is of row ``i`` of the gels, which then is no candidate.
    """
    logs, moves = [], []
    for k in range(len(gels)):
        picture = infer(data, gels[k : k + 1], shot.plan)
        move = (picture.mean - gels.controls[k]).norm(dim=-1)
        if not_own:
            move[k] = math.inf
        logs.append(picture.log_evidence)
        moves.append(move)
    nearest = torch.stack(moves).argmin(0)
    return nearest, torch.stack(logs).gather(0, nearest[None])[0]


@dataclass(frozen=True)
class _Sampled:
    """Log evidence of every datum under one model, and the relative variance of its Monte Carlo mean; both ``n``."""

    log: Tensor
    variance: Tensor


def _sampled_evidence(
    drawn: _Drawn, model: int, rival: Tensor, shot: Shot, estimator: Estimator, source: torch.Generator
) -> _Sampled:
    """Log evidence of all data under one model by importance sampling from Gauss-Newton posteriors.

    Args:
        drawn: gels and data.
        model: which model.
        rival: log evidence of each datum under its own model, linearised.
        shot: designs and how they are observed.
        estimator: numbers of samples.
        source: of the samples.
    """
    count, gels, part = len(drawn.data), drawn.parts[model], shot.belief.models[model]
    result = _Sampled(torch.full((count,), -math.inf, dtype=torch.float64), torch.zeros(count, dtype=torch.float64))
    if len(gels) < 2:
        return result
    rows, adaptive = torch.cat((torch.arange(count)[drawn.rows[model]], _outside(drawn, model))), estimator.method == "adaptive"
    data, own = drawn.data[rows], len(gels)
    start = torch.arange(own)
    if adaptive:
        start = _nearest(data[:own], gels, shot, not_own=True)[0]
    if len(data) > own:
        start = torch.cat((start, _nearest(data[own:], gels, shot)[0]))
    at = _refine(data, gels[start], shot, part, estimator.refinements)
    result.log[rows] = infer(data, at, shot.plan).log_evidence
    close = result.log[rows] > rival[rows] - _HOPELESS
    close[:own] = True
    truth = gels.controls if adaptive else None
    log, variance = _sample(data[close], at[close], truth, shot, part, estimator, source)
    result.log[rows[close]], result.variance[rows[close]] = log, variance
    return result


def _refine(data: Data, at: Response, shot: Shot, part: ModelBelief, iterations: int) -> Response:
    """Gauss-Newton steps towards the optimum of each datum: the better of two lengths, or shorter ones the next time."""
    length = torch.ones(len(data), 1, dtype=torch.float64)
    for _ in range(iterations):
        here = infer(data, at, shot.plan)
        step = here.mean - at.controls
        moving = torch.nonzero((step[:, None] @ here.chol).norm(dim=-1)[:, 0] > _CLOSE)[:, 0]
        if len(moving) == 0:
            break
        step = length * step * (_LONGEST_STEP / step.norm(dim=-1, keepdim=True).clamp_min(_LONGEST_STEP))
        value, better = _log_posterior(here, at), torch.zeros(len(data), dtype=torch.bool)
        tried = respond(shot, part, torch.cat([(at.controls + part_of * step)[moving] for part_of in (1.0, _SHORTER)]))
        for moved in (tried[: len(moving)], tried[len(moving) :]):
            rows = moving[moved.good]
            moved = moved[moved.good]
            there = _log_posterior(infer(data[rows], moved, shot.plan), moved)
            gains = there > value[rows]
            at, value[rows[gains]] = at.replaced(rows[gains], moved[gains]), there[gains]
            better[rows[gains]] = True
        length = torch.where(better[:, None], 1.0, _SHORTER**2 * length)
    return at


def _log_joint(data: Data, controls: Tensor, at: Response, shot: Shot, part: ModelBelief) -> Tensor:
    """Log density of each datum and of each of its gels (``n x k x d``), with the nuisances of ``at``; ``-inf`` if failed."""
    radius = radii(shot, part, controls)
    good = torch.isfinite(radius).flatten(2).all(-1)
    pairs = Data(data.radius[:, None], data.window[:, None])
    log = log_likelihood(pairs, torch.where(good[..., None, None], radius, 1.0), at.by_nuisance[:, None], shot.plan)
    return torch.where(good, log - 0.5 * controls.square().sum(-1), -math.inf)


def _log_posterior(linear: Linear, at: Response) -> Tensor:
    return linear.log_likelihood - 0.5 * at.controls.square().sum(-1)


def _sample(
    data: Data,
    at: Response,
    truth: Tensor | None,
    shot: Shot,
    part: ModelBelief,
    estimator: Estimator,
    source: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Log mean of importance weights for each datum, and its relative variance.

    The proposal is a mixture, sampled in fixed proportion and weighed by its whole density (Owen & Zhou, J. Am. Stat.
    Assoc. 95, 2000): the Gauss-Newton posterior; a wider one, which bounds the weights of a curved posterior; and, where
    the datum's own gel counts among the samples, the belief, so that a proposal in the wrong place costs some nats at most.

    Args:
        data: ``n`` data.
        at: where each proposal is linearised; nuisances are taken from there.
        truth: controls of the gels of the first data, which count as a sample of theirs.
        shot: designs and how they are observed.
        part: the model.
        estimator: number of samples and share of the other parts.
        source: of the samples.
    """
    picture, d, inner = infer(data, at, shot.plan), at.controls.shape[1], estimator.inner
    wide = round(estimator.defence * inner)
    belief = 0 if truth is None else wide
    z = torch.randn(len(data), inner, d, generator=source, dtype=torch.float64)
    scale = torch.ones(inner, 1, dtype=torch.float64)
    scale[inner - wide :] = _WIDER
    v = picture.mean[:, None] + torch.linalg.solve_triangular(picture.chol.mT, (scale * z).mT, upper=True).mT
    v[:, inner - wide - belief : inner - wide] = z[:, inner - wide - belief : inner - wide]
    if truth is not None:
        v[: len(truth), 0] = truth
    away = ((v - picture.mean[:, None]) @ picture.chol).square().sum(-1)
    densities = torch.stack(
        (
            picture.information[:, None] - 0.5 * away,
            picture.information[:, None] - 0.5 * away / _WIDER**2 - d * math.log(_WIDER),
            -0.5 * v.square().sum(-1),
        )
    )
    shares = torch.tensor([inner - wide - belief, wide, belief], dtype=torch.float64) / inner
    log = _log_joint(data, v, at, shot, part) - torch.logsumexp(densities + shares.log()[:, None, None], 0)
    good = torch.isfinite(log)
    count = good.sum(1).clamp_min(1)
    mean = torch.logsumexp(log, 1) - count.log()
    relative = torch.where(good, (log - mean[:, None]).exp(), 1.0)
    return mean, (relative - 1.0).square().sum(1) / (count - 1).clamp_min(1) / count
