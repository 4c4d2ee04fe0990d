"""Fits in which the gel differs between experiments, found from the fits of single curves.

Where the gel differs much, the fit of one gel has its collapses on the wrong side of frames in all
curves, and a search that begins there ends in a local minimum. Each curve by itself is fitted well.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch

from imr_torch.assimilate import ModelFit, Point, Posterior, SearchOptions
from imr_torch.assimilate.map_fit import assimilate_model
from imr_torch.float64 import randn
from imr_torch.gap.hypotheses import (
    Hypothesis,
    Inquiry,
    finish,
    fit_hypotheses,
    lower,
    scatters,
)
from imr_torch.observe import NUISANCES
from imr_torch.random import child, generator

_APART = 0.5  # prior standard deviations between the starts of a curve's own fit
# all starts are descended from: two that begin close may agree on a minimum that is not the lowest
_EVERY_START = SearchOptions(drop_behind=50.0)


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
        one = replace(inquiry.batch, experiments=(experiment,), between={})
        single = replace(inquiry, batch=one, progress=None)
        alone = assimilate_model(
            Posterior(fit.prior, one, inquiry.simulator),
            Point(starts, fit.nuisances[e : e + 1, : len(NUISANCES)]),
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


def start_apart(hypothesis: Hypothesis, near: ModelFit, alone: Sequence[ModelFit]) -> ModelFit:
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
        deviations.append(scatter.deviation(of_curves, common[place]) / scatter.relative)
    mean = near.mean.clone()
    mean[[near.prior.names.index(name) for name in prior.names]] = gels.mean(0)
    nuisances = torch.cat([fit.nuisances[:, : len(NUISANCES)] for fit in alone])
    return replace(near, mean=mean, nuisances=torch.cat((nuisances, torch.stack(deviations, 1)), 1))


def gels_of(fit: ModelFit, hypothesis: Hypothesis) -> dict[str, list[float]]:
    """Parameter of the gel -> its value in each experiment of a fit with gels that differ, SI.

    Empty where they do not differ.
    """
    deviations = fit.nuisances[:, len(NUISANCES) :]
    if not hypothesis.gels_differ:
        return {}
    common = dict(zip(fit.prior.names, fit.prior.physical(fit.mean), strict=True))
    between = scatters(hypothesis.base).items()
    return {
        name: scatter.moved(common[name], scatter.relative * column).tolist()
        for (name, scatter), column in zip(between, deviations.unbind(1), strict=True)
    }
