"""What a stepwise selection may add to a hypothesis, the fits of it, and what it drops again.

An addition is an effect, or that curves differ (``gel_scatter``: the gel, and with it how strong
each effect is). Fits are rough until one is to be a step; that one is taken to its minimum.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from imr_torch.assimilate import ModelFit, SearchOptions
from imr_torch.gap.adequacy import Adequacy
from imr_torch.gap.attribute import Inquiry, near_values
from imr_torch.gap.hypotheses import (
    EXPLAINS,
    GEL_SCATTER,
    Hypothesis,
    finish,
    fit_hypotheses,
    laplace_evidence,
    lower,
    promised,
    scatters,
)
from imr_torch.gap.own_gels import as_one_fit, fit_alone, with_gels_of
from imr_torch.material import Effect
from imr_torch.observe import NUISANCES, ExperimentBatch
from imr_torch.random import child

_CANDIDATES = 6  # effects that are fitted in a later step
_BEATEN = 2  # of these, at most, ones that were beaten in the step before
_TRIED = 2  # of these, additions that are taken to their minimum until one converges
_FIT = SearchOptions(starts=2, iterations=12, drop_behind=6.0, basin_rounds=0)
_FIT_GELS = replace(_FIT, iterations=30)
_FINISH = SearchOptions(starts=2, iterations=15, basin_rounds=0)
_CLEAR = 10.0  # standard deviations from nothing at which a part is kept: some 50 nats

Fitted = tuple[Hypothesis, ModelFit]
"""A hypothesis and its fit."""

Fits = dict[frozenset[str], ModelFit]
"""Parts of a hypothesis -> its fit."""

Step = tuple[Hypothesis, ModelFit, list[Fitted]]
"""A hypothesis and its fit, and the other additions that were fitted, that of largest evidence first."""


@dataclass(frozen=True)
class Here:
    """Where the selection stands.

    Args:
        chosen: the hypothesis.
        fit: its fit.
        left: the gap test there; None of the base model.
        beaten: what was not chosen in its place though it explained something, best first.
    """

    chosen: Hypothesis
    fit: ModelFit
    left: Adequacy | None = None
    beaten: tuple[Fitted, ...] = ()


def fit_gels(
    inquiry: Inquiry, null: ModelFit, alone: Sequence[ModelFit] | None, *, seed: int
) -> Fits:
    """The base model with gels that differ, from the gel of all curves and from those of single
    ones; none if they may not.

    Args:
        inquiry: base model and data.
        null: the base model's fit.
        alone: its fit of each experiment by itself; made here if not given.
        seed: of the fits.
    """
    hypothesis = Hypothesis(inquiry.base, own_gels=True)
    if not _may_differ(inquiry.batch):
        return {}
    alone = alone or fit_alone(null, inquiry.batch, inquiry.simulator, seed=child(seed, "alone"))
    apart = as_one_fit(null, alone, scatters(inquiry.base, null.prior))
    search = partial(
        fit_hypotheses, batch=inquiry.batch, simulator=inquiry.simulator, seed=seed, twice=0
    )
    return {frozenset({GEL_SCATTER}): _from_both(search, hypothesis, apart, null)}


def _from_both(
    search: Callable[..., dict[str, ModelFit]], hypothesis: Hypothesis, one: ModelFit, two: ModelFit
) -> ModelFit:
    """The lower of the fits from two starts; the second is given up where it cannot get there."""
    first = search([hypothesis], one, options=_FIT_GELS)[hypothesis.name]
    second = search([hypothesis], two, options=replace(_FIT_GELS, rival=first.cost))[
        hypothesis.name
    ]
    return lower(first, second, _FIT_GELS)


def next_step(
    inquiry: Inquiry, here: Here, fits: Fits, seen: set[frozenset[str]], *, seed: int
) -> tuple[Step | None, list[str]]:
    """The next step, whose fit has converged; None if nothing is gained. Then what did not
    converge.

    The minimum is sought once, after superfluous effects are gone.
    """
    had = laplace_evidence(here.fit)
    failed = list[str]()
    additions = _additions(inquiry, here, fits, seed=seed)
    for added in additions[:_TRIED]:
        if laplace_evidence(added[1]) + promised(added[1]) < had + EXPLAINS:
            break
        chosen, rough = _without_superfluous(
            inquiry, added_by(here.chosen, added[0]), *added, seed=seed
        )
        if frozenset(chosen.parts) in seen:
            break
        fit = finished(rough, chosen, inquiry, seed)
        if not fit.certificate.converged:
            failed.append(chosen.name)
            continue
        needed = EXPLAINS if len(chosen.parts) > len(here.chosen.parts) else 0.0
        others = [other for other in additions if other is not added]
        return ((chosen, fit, others) if laplace_evidence(fit) >= had + needed else None), failed
    return None, failed


def longer_by_one(inquiry: Inquiry, chosen: Hypothesis) -> list[Hypothesis]:
    """What a hypothesis can be made by one addition: an effect, or gels that differ."""
    longer = [
        replace(chosen, effects=(*chosen.effects, effect))
        for effect in inquiry.beside(chosen.effects)
    ]
    if not chosen.own_gels and _may_differ(inquiry.batch):
        longer.append(replace(chosen, own_gels=True))
    return longer


def _may_differ(batch: ExperimentBatch) -> bool:
    """Whether gels can be asked to differ between experiments: repeats may be of different gels
    themselves.
    """
    return len(batch.experiments) > 1 and all(
        experiment.repeats == 1 for experiment in batch.experiments
    )


def _additions(inquiry: Inquiry, here: Here, fits: Fits, *, seed: int) -> list[Fitted]:
    """The hypotheses with one addition and their fits, not finished, largest evidence first.

    None if none can be fitted.
    """
    longer = longer_by_one(inquiry, here.chosen)
    left = here.left
    missing = [h for h in longer if frozenset(h.parts) not in fits]
    of_effects = [h for h in missing if h.own_gels is here.chosen.own_gels]
    starts = {} if left is None else dict(left.starts)
    starts |= {effect.name: near_values(here.fit, effect) for effect in here.chosen.effects}
    beaten = _beaten(here)
    starts |= {effect.name: near_values(fit, effect) for effect, fit in beaten}
    search = partial(
        fit_hypotheses,
        batch=inquiry.batch,
        simulator=inquiry.simulator,
        seed=seed,
        starts=starts,
        twice=0,
    )
    found = dict[str, ModelFit]()
    if len(longer) - len(missing) <= _CANDIDATES:  # no attribution was made of these
        ranked = [effect.name for effect, _ in beaten] + (
            [] if left is None else [block.name for block in left.test.blocks]
        )
        last = [h.effects[-1].name for h in of_effects]
        order = sorted(
            range(len(last)),
            key=lambda i: ranked.index(last[i]) if last[i] in ranked else len(ranked),
        )
        found = search([of_effects[i] for i in order[:_CANDIDATES]], here.fit, options=_FIT)
    for h in missing:
        if (
            h.own_gels and not here.chosen.own_gels
        ):  # from the gel of the step, and from gels that differ without effects
            apart = with_gels_of(here.fit, fits[frozenset({GEL_SCATTER})], h)
            found[h.name] = _from_both(search, h, apart, here.fit)
    fits |= {frozenset(name.split("+")): own for name, own in found.items()}
    known = [(h, fits[frozenset(h.parts)]) for h in longer if frozenset(h.parts) in fits]
    return sorted(known, key=lambda addition: -laplace_evidence(addition[1]))


def _beaten(here: Here) -> list[tuple[Effect, ModelFit]]:
    """Effects that came next to the one that was chosen, and the fits with them in its place.

    A score test at the fit that was chosen does not see an effect whose strength or time is far
    from nothing there.
    """
    found = list[tuple[Effect, ModelFit]]()
    for hypothesis, fit in here.beaten:
        new = [effect for effect in hypothesis.effects if effect not in here.chosen.effects]
        found += [(new[0], fit)] if len(new) == 1 else []
    return found[:_BEATEN]


def _without_superfluous(
    inquiry: Inquiry, added: str, chosen: Hypothesis, fit: ModelFit, *, seed: int
) -> Fitted:
    """A hypothesis less the parts without which the evidence is nearly as large, the least needed
    first; never what was added.

    A part that is many standard deviations from nothing is kept without a fit.
    """
    while len(chosen.parts) > 1:
        tried = [
            _without(chosen, part)
            for part in chosen.parts
            if part != added and _distance(fit, chosen, part) < _CLEAR
        ]
        if not tried:
            break
        starts = {effect.name: near_values(fit, effect) for effect in chosen.effects}
        search = partial(
            fit_hypotheses,
            batch=inquiry.batch,
            simulator=inquiry.simulator,
            seed=seed,
            starts=starts,
            twice=0,
        )
        found = search(tried, fit, options=replace(_FIT, rival=fit.cost))
        best = max(tried, key=lambda h: laplace_evidence(found[h.name]))
        if laplace_evidence(found[best.name]) < laplace_evidence(fit) - EXPLAINS:
            break
        chosen = best
        fit = found[best.name]
    return chosen, fit


def _without(chosen: Hypothesis, part: str) -> Hypothesis:
    """A hypothesis less one of its parts."""
    if part == GEL_SCATTER:
        return replace(chosen, own_gels=False)
    return replace(
        chosen, effects=tuple(effect for effect in chosen.effects if effect.name != part)
    )


def _distance(fit: ModelFit, chosen: Hypothesis, part: str) -> float:
    """Standard deviations of a part from nothing: an effect's fitted amplitude from zero, or all
    deviations of gels together.

    That of an effect is by the slope of its prior's transform at the fit, with the deviations of
    curves held.
    """
    if part == GEL_SCATTER:
        own = torch.zeros_like(fit.nuisances)
        own[:, len(NUISANCES) :] = fit.nuisances[:, len(NUISANCES) :]
        return float((fit.nuisance_chol.mT @ own[..., None]).norm())
    (effect,) = (effect for effect in chosen.effects if effect.name == part)
    place = fit.prior.names.index(effect.names[0])
    marginal = fit.prior.marginals[place]
    at = fit.mean[place]
    sd = sds_of_strengths(fit)[place]
    return float(marginal.to_physical(at).abs() / (sd * marginal.log_slope(at).exp()))


def sds_of_strengths(fit: ModelFit) -> Tensor:
    """Posterior standard deviations of the controls with the deviations of curves held, ``d``
    tensor.
    """
    hessian = fit.nuisance_chol @ fit.nuisance_chol.mT
    common = slice(len(NUISANCES))
    cross = -hessian @ fit.nuisance_response
    held = torch.linalg.solve(hessian[:, common, common], cross[:, common])
    gained = (cross.mT @ -fit.nuisance_response - cross[:, common].mT @ held).sum(0)
    return torch.linalg.inv(torch.cholesky_inverse(fit.chol) + gained).diagonal().sqrt()


def finished(fit: ModelFit, chosen: Hypothesis, inquiry: Inquiry, seed: int) -> ModelFit:
    """A fit taken to its minimum if it is not there."""
    if fit.certificate.converged:
        return fit
    return finish(
        fit,
        chosen.seen(inquiry.batch),
        inquiry.simulator,
        seed=child(seed, "finish"),
        options=_FINISH,
    )


def added_by(before: Hypothesis, after: Hypothesis) -> str:
    """What a hypothesis has that another has not."""
    return "+".join(name for name in after.parts if name not in before.parts)
