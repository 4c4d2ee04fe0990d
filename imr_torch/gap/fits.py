"""Fits of hypotheses: of the base model, of hypotheses with the same nuisances in one batch, and of
gels that differ between experiments.

Fits of effects start at the null fit, with the effect at each of its starts. Coarse bubbles
(:func:`imr_torch.simulate.coarser`) lead the way to each minimum and leave out what is far behind;
every fit that counts ends with the simulator that was given. Where the gel differs much between
experiments, the fit of one gel has its collapses on the wrong side of frames in all curves, and a
search that begins there ends in a local minimum. Each curve by itself is fitted well, so fits of
gels that differ start from those of single curves.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from imr_torch.assimilate import (
    Assimilation,
    ModelFit,
    Point,
    Posterior,
    SearchOptions,
    assimilate,
)
from imr_torch.assimilate.fit import NEARLY, ONE_MINIMUM, PROMISED
from imr_torch.assimilate.map_fit import assimilate_model
from imr_torch.assimilate.starts import draw_perturbation
from imr_torch.float64 import randn
from imr_torch.gap.hypotheses import Hypothesis, Inquiry, overdispersion, scatters
from imr_torch.material import Belief, even_belief
from imr_torch.observe import NUISANCES, ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator, coarser
from imr_torch.types import Progress, within

LEADING = 6
"""Fits of an attribution that get a second start by the simulator's own bubbles."""
_MANY = 6  # starts where fewer disagree
_AGAIN = 3  # starts beside a fit whose own disagree
_ROUGHLY = 0.03  # gradient at which a fit by coarse bubbles ends
# chi squared per degree of freedom of a fit whose collapses may lie on the wrong side of a frame
_FAR = 1.5
_TOO_COARSE = 200.0  # nats of error of the cost beyond which coarse bubbles lead nowhere
_APART = 0.5  # prior standard deviations between the starts of a curve's own fit
# all starts are descended from: two that begin close may agree on a minimum that is not the lowest
_EVERY_START = SearchOptions(drop_behind=50.0)


def fit_null(inquiry: Inquiry, *, seed: int, near: ModelFit | None = None) -> ModelFit:
    """The base model with nuisances, from several starts, with its certificate, which the caller
    must check.

    A fit that ran out of iterations, as Gauss-Newton may where a large gap leaves large residuals,
    is taken up again; where converged starts disagree, more of them are made. A fit of the same
    curves with other noise is a start, where it is given.
    """
    options = SearchOptions()
    search = partial(
        assimilate,
        even_belief((inquiry.base,)),
        inquiry.batch,
        inquiry.simulator,
        warn=False,
        progress=inquiry.progress,
    )
    if near is not None:
        begin = as_assimilation(near, inquiry.batch)
        moved = search(seed=seed, options=options, near=begin).fits[0]
        if moved.certificate.converged:
            return moved
    fit = search(seed=seed, options=options).fits[0]
    if fit.certificate.gradient >= options.gradient:
        fit = finish(inquiry, fit, Hypothesis(inquiry.base), seed=child(seed, "finish"))
    if fit.certificate.converged or fit.certificate.gradient >= options.gradient:
        return fit
    many = SearchOptions(starts=_MANY)
    return lower(fit, search(seed=child(seed, "again"), options=many).fits[0], many)


def lower(one: ModelFit, other: ModelFit, options: SearchOptions) -> ModelFit:
    """The fit that is or may become the lower, certified also if the other search found that
    minimum too.
    """
    low, high = sorted((one, other), key=_reach)
    return _certified(
        low, min(low.certificate.agreement, abs(high.cost - low.cost)), options
    )


def _reach(fit: ModelFit) -> float:
    """The cost that a fit has or may get down to."""
    return fit.cost - promised(fit) if math.isfinite(fit.certificate.gradient) else fit.cost


def _certified(fit: ModelFit, agreement: float, options: SearchOptions) -> ModelFit:
    """A fit with a certificate that counts agreement with other starts than its own, nats."""
    converged = (
        fit.certificate.gradient < options.gradient and agreement < options.agreement
    )
    return replace(
        fit, certificate=replace(fit.certificate, agreement=agreement, converged=converged)
    )


def fit_hypotheses(
    inquiry: Inquiry,
    hypotheses: Sequence[Hypothesis],
    null: ModelFit,
    *,
    seed: int,
    starts: Mapping[str, Sequence[Sequence[float]]] | None = None,
    options: SearchOptions | None = None,
    twice: int = LEADING,
) -> dict[str, ModelFit]:
    """Fit hypotheses that have the same nuisances in one batch, from the null fit.

    Where the gap is large, the null fit's collapses lie on the wrong side of frames, each a local
    minimum. Hypotheses are then also fitted by searches that begin without the frames next to
    collapses (:mod:`imr_torch.assimilate.multistart`), and the lower of the two fits counts, or one
    that has not converged and may get lower.

    Args:
        inquiry: the data and what makes the bubbles.
        hypotheses: what to fit.
        null: the fit without each one's last effect.
        seed: of the search.
        starts: name of a last effect -> values from which to start it; its own starts where not
            given.
        options: how to search.
        twice: fits of lowest cost by coarse bubbles that get a second start by the simulator's own;
            with 0 none is certified.

    Returns:
        Name of the hypothesis -> fit, whose certificate the caller must check.
    """
    if not hypotheses:
        return {}
    options = options or SearchOptions()
    batch = hypotheses[0].seen(inquiry.batch)
    far = overdispersion(null, batch) > _FAR
    search = partial(
        _descend,
        even_belief(h.belief for h in hypotheses),
        batch,
        inquiry.simulator,
        seed=seed,
        starts=[h.starts(null, starts or {}) for h in hypotheses],
        nuisances=[deviating(null, h) for h in hypotheses],
        twice=twice,
    )
    first = 0.5 if far else 1.0  # part of the time
    found = search(options=options, progress=within(inquiry.progress, 0.0, first))
    if far:
        lowest = min(options.rival, *(fit.cost for fit in found))
        again = replace(options, mask_collapses=True, rival=lowest)
        report = within(
            inquiry.progress, first, 1.0, name="without frames next to collapses"
        )
        masked = search(options=again, progress=report)
        found = [lower(*pair, options) for pair in zip(found, masked, strict=True)]
    return {h.name: fit for h, fit in zip(hypotheses, found, strict=True)}


def fit_from(
    inquiry: Inquiry,
    hypotheses: Sequence[Hypothesis],
    near: Mapping[str, ModelFit],
    *,
    seed: int,
    options: SearchOptions,
) -> dict[str, ModelFit]:
    """Fit hypotheses that have the same nuisances from earlier fits with other noise.

    Args:
        inquiry: the data and what makes the bubbles.
        hypotheses: what to fit.
        near: name of the hypothesis -> fit; starts are that and points beside it.
        seed: of the search.
        options: how to search.

    Returns:
        Name of the hypothesis -> fit, whose certificate the caller must check.
    """
    if not hypotheses:
        return {}
    batch = hypotheses[0].seen(inquiry.batch)
    known = tuple(near[h.name] for h in hypotheses)
    belief = even_belief(fit.prior for fit in known)
    found = assimilate(
        belief,
        batch,
        inquiry.simulator,
        near=Assimilation(belief, batch, known),
        seed=seed,
        options=options,
        warn=False,
        progress=inquiry.progress,
    )
    return {h.name: fit for h, fit in zip(hypotheses, found.fits, strict=True)}


def deviating(fit: ModelFit, hypothesis: Hypothesis) -> Tensor:
    """Nuisances ``E x w`` of a fit for another hypothesis: gels that it does not let differ begin
    alike.
    """
    known = fit.nuisances[:, : len(NUISANCES)]
    if not hypothesis.gels_differ:
        return known
    if fit.nuisances.shape[1] > len(NUISANCES):
        return fit.nuisances
    return torch.nn.functional.pad(known, (0, len(scatters(hypothesis.base))))


def _descend(
    belief: Belief,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    options: SearchOptions,
    starts: Sequence[Tensor],
    nuisances: Sequence[Tensor],
    twice: int,
    progress: Progress,
) -> list[ModelFit]:
    """Fits by coarse bubbles, then, of those not far behind, by the simulator's own from where
    these ended.

    The first of these, so many as are to be fitted ``twice``, get a second start beside that. The
    others have the agreement of their starts by coarse bubbles in their certificates, and none
    where no fit is made twice; where coarse bubbles have the simulator's cost, they stay as these
    left them. A fit that was left behind has the cost that the simulator gives it
    where it ended, and has not converged.
    """
    search = partial(assimilate, seed=seed, warn=False)
    from_starts = partial(search, starts=starts, nuisances=nuisances)
    coarse = coarser(simulator)
    same = coarse is simulator
    error = (
        0.0
        if same
        else _coarse_error(belief, batch, simulator, starts[0][:1], nuisances[0])
    )
    if same or error > _TOO_COARSE:
        fits = from_starts(
            belief, batch, simulator, options=options, progress=progress
        ).fits
        return list(fits)
    reach = None if options.drop_behind is None else options.drop_behind + error
    rough = replace(options, drop_behind=reach, gradient=max(options.gradient, _ROUGHLY))
    early = within(progress, 0.0, 0.75)
    found = from_starts(belief, batch, coarse, options=rough, progress=early).fits
    fits = [_seen_by(fit, batch, simulator) for fit in found]
    limit = min(*(fit.cost for fit in fits), options.rival) + (
        math.inf if reach is None else reach
    )
    near = [i for i, fit in enumerate(fits) if fit.cost - promised(fit) <= limit]
    near.sort(key=lambda i: fits[i].cost)
    own = replace(options, starts=2, mask_collapses=False)
    report = within(progress, 0.75, 0.87, name="near the best")
    others = near[twice:]
    if error < NEARLY:
        for i in others:
            fits[i] = replace(fits[i], certificate=found[i].certificate)
        others = []
    for places, again in ((near[:twice], True), (others, False)):
        if not places:
            continue
        chosen = tuple(fits[i] for i in places)
        kept = even_belief(fit.prior for fit in chosen)
        begin: dict[str, Any] = {"near": Assimilation(kept, batch, chosen)}
        if not again:
            gels = [fit.mean[None] for fit in chosen]
            begin = {"starts": gels, "nuisances": [fit.nuisances for fit in chosen]}
        ended = search(kept, batch, simulator, options=own, progress=report, **begin).fits
        report = within(progress, 0.87, 1.0, name="near the best")
        for i, fit in zip(places, ended, strict=True):
            agreement = found[i].certificate.agreement
            if again:
                agreement = max(agreement, fit.certificate.agreement)
            fits[i] = _certified(fit, agreement, own) if twice else fit
        own = replace(own, rival=min(options.rival, *(fits[i].cost for i in places)))
    return fits


def _coarse_error(
    belief: Belief,
    batch: ExperimentBatch,
    simulator: Simulator,
    gel: Tensor,
    nuisances: Tensor,
) -> float:
    """Error of the cost by coarse bubbles where the first model fits the data, at one gel
    (``1 x d``), nats.
    """
    posterior = Posterior(belief.models[0], batch, simulator)
    point = Point(gel, nuisances[None])
    fine = posterior.predict(point)[0]
    coarse = posterior.coarse.predict(point)[0]
    change = batch.whiten(fine - coarse, batch.sd(fine))
    return 0.5 * float(change.square().sum().nan_to_num(math.inf))


def _seen_by(fit: ModelFit, batch: ExperimentBatch, simulator: Simulator) -> ModelFit:
    """A fit by other bubbles with the cost and the prediction that a simulator gives it, as one
    that has not converged.
    """
    posterior = Posterior(fit.prior, batch, simulator)
    seen = posterior.predict(fit.point)
    cost = -float(posterior.log_joint(fit.point, seen))
    return replace(
        fit,
        cost=cost,
        prediction=seen,
        certificate=replace(fit.certificate, converged=False),
    )


def finish(
    inquiry: Inquiry, fit: ModelFit, hypothesis: Hypothesis, *, seed: int
) -> ModelFit:
    """Continue a fit that was cut short, from where it ended and from a point beside it.

    The second start may end in another local minimum. The agreement in the certificate is then that
    of the earlier starts, if they had nearly converged, or that of more starts beside it.
    """
    options = SearchOptions(starts=2)
    batch = hypothesis.seen(inquiry.batch)
    near = as_assimilation(fit, batch)
    search = partial(
        assimilate,
        near.prior,
        batch,
        inquiry.simulator,
        options=options,
        warn=False,
        progress=inquiry.progress,
    )
    ended = search(seed=seed, near=near).fits[0]
    if fit.certificate.gradient < NEARLY and abs(fit.cost - ended.cost) < ONE_MINIMUM:
        ended = _certified(
            ended, min(ended.certificate.agreement, fit.certificate.agreement), options
        )
    if ended.certificate.converged or ended.certificate.gradient >= options.gradient:
        return ended
    source = generator(child(seed, "beside"))
    away = SearchOptions().descent.restart
    starts = ended.mean + torch.stack(
        [draw_perturbation(ended.chol, source, away) for _ in range(_AGAIN)]
    )
    moved = [ended.nuisances_at(starts)]
    again = search(seed=child(seed, "again"), starts=[starts], nuisances=moved)
    return lower(ended, again.fits[0], options)


def as_assimilation(fit: ModelFit, batch: ExperimentBatch) -> Assimilation:
    """One fit as an assimilation, for functions that take one."""
    return Assimilation(even_belief((fit.prior,)), batch, (fit,))


def promised(fit: ModelFit) -> float:
    """Nats that a fit which has not converged may still gain, by its gradient."""
    return 0.0 if fit.certificate.converged else PROMISED * fit.certificate.gradient**2


def fit_alone(inquiry: Inquiry, fit: ModelFit, *, seed: int) -> tuple[ModelFit, ...]:
    """Each experiment by itself, from the fit to all and from points beside it.

    Args:
        inquiry: the data and what makes the bubbles.
        fit: to all experiments.
        seed: of the starts.
    """
    found = []
    for e, experiment in enumerate(inquiry.batch.experiments):
        seed_here = child(seed, "alone", experiment.label)
        beside = _APART * randn(2, len(fit.mean), generator=generator(seed_here))
        starts = torch.cat((fit.mean[None], fit.mean + beside))
        known = fit.nuisances[e : e + 1, : len(NUISANCES)]
        one = replace(inquiry.batch, experiments=(experiment,), between={})
        single = replace(inquiry, batch=one, progress=None)
        alone = assimilate_model(
            Posterior(fit.prior, one, inquiry.simulator),
            Point(starts, known.expand(len(starts), -1, -1)),
            seed=seed_here,
            options=_EVERY_START,
        )
        if not alone.certificate.converged:
            nothing = Hypothesis(inquiry.base)
            alone = finish(single, alone, nothing, seed=child(seed_here, "finish"))
        found.append(alone)
    return tuple(found)


def fit_differing(
    inquiry: Inquiry,
    hypothesis: Hypothesis,
    near: ModelFit,
    *,
    seed: int,
    options: SearchOptions,
) -> ModelFit:
    """The lower of the fits of gels that differ from two starts: the gels of single curves, and one
    gel.

    Args:
        inquiry: the data, with the base model's fit of each experiment by itself.
        hypothesis: with gels that differ.
        near: fit of the same with one gel.
        seed: of the searches.
        options: how to search.
    """
    silent = replace(inquiry, progress=None)
    search = partial(fit_hypotheses, silent, [hypothesis], seed=seed, twice=0)
    apart = start_apart(hypothesis, near, inquiry.alone)
    first = search(apart, options=options)[hypothesis.name]
    second = search(near, options=replace(options, rival=first.cost))[hypothesis.name]
    return lower(first, second, options)


def start_apart(
    hypothesis: Hypothesis, near: ModelFit, alone: Sequence[ModelFit]
) -> ModelFit:
    """A fit to all experiments, moved to where the gels of single ones are: a start, not a fit.

    Args:
        hypothesis: with gels that differ.
        near: fit of the same with one gel.
        alone: the base model's fit of each experiment by itself.
    """
    gels = torch.stack([fit.mean for fit in alone])
    prior = alone[0].prior
    common = prior.physical(gels.mean(0))
    deviations = []
    for name, scatter in scatters(hypothesis.base).items():
        place = prior.names.index(name)
        of_curves = prior.physical(gels)[:, place]
        deviations.append((of_curves.log() - common[place].log()) / scatter)
    mean = near.mean.clone()
    mean[[near.prior.names.index(name) for name in prior.names]] = gels.mean(0)
    nuisances = torch.cat([fit.nuisances[:, : len(NUISANCES)] for fit in alone])
    return replace(
        near, mean=mean, nuisances=torch.cat((nuisances, torch.stack(deviations, 1)), 1)
    )
