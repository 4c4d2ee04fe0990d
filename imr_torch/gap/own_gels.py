"""Gels of their own from the fits of single curves: from there a fit finds them where one gel for
all curves is far off.

Where the gel differs much between curves, the fit of one gel has its collapses on the wrong side of
frames in all of them, and a search that begins there ends in a local minimum. Each curve by itself
is fitted well.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from imr_torch.assimilate import ModelFit, assimilate
from imr_torch.gap.hypotheses import Hypothesis, deviating, finish
from imr_torch.material import Belief
from imr_torch.observe import NUISANCES, ExperimentBatch, Scatter
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator

_APART = 0.5  # prior standard deviations between the starts of a curve's own fit


def fit_alone(
    fit: ModelFit, batch: ExperimentBatch, simulator: Simulator, *, seed: int
) -> tuple[ModelFit, ...]:
    """Each experiment by itself, from the fit to all and from points beside it."""
    belief = Belief((fit.prior,), torch.zeros(1, dtype=torch.float64))
    found = []
    for e, experiment in enumerate(batch.experiments):
        own = child(seed, "alone", experiment.label)
        beside = _APART * torch.randn(
            2, len(fit.mean), generator=generator(own), dtype=torch.float64
        )
        starts = torch.cat((fit.mean[None], fit.mean + beside))
        one = replace(batch, experiments=(experiment,), between={})
        nuisances = [fit.nuisances[e : e + 1]]
        alone = assimilate(
            belief, one, simulator, seed=own, starts=[starts], nuisances=nuisances, warn=False
        ).fits[0]
        found.append(
            alone
            if alone.certificate.converged
            else finish(alone, one, simulator, seed=child(own, "finish"))
        )
    return tuple(found)


def as_one_fit(
    fit: ModelFit, alone: Sequence[ModelFit], between: Mapping[str, Scatter]
) -> ModelFit:
    """A fit to all experiments, moved to where the gels of single ones are: a start, not a fit.

    Args:
        fit: the base model's, of one gel.
        alone: fit of each experiment by itself, of the same model.
        between: scatter of each parameter that differs (:func:`imr_torch.gap.hypotheses.scatters`).

    Returns:
        The fit with the mean gel, and with the nuisances of the experiments and the deviations of
        their gels.
    """
    gels = torch.stack([own.mean for own in alone])
    own = fit.prior.physical(gels)
    common = fit.prior.physical(gels.mean(0))
    places = [fit.prior.names.index(name) for name in between]
    each = zip(between.values(), places, strict=True)
    deviations = [scatter.deviation(own[:, i], common[i]) / scatter.relative for scatter, i in each]
    nuisances = torch.cat([own.nuisances[:, : len(NUISANCES)] for own in alone])
    return replace(
        fit, mean=gels.mean(0), nuisances=torch.cat((nuisances, torch.stack(deviations, 1)), 1)
    )


def with_gels_of(fit: ModelFit, gels: ModelFit, hypothesis: Hypothesis) -> ModelFit:
    """A fit with effects, moved to the gels of a fit without them: a start, not a fit.

    Args:
        fit: where all experiments have one gel.
        gels: where they differ, without effects.
        hypothesis: that of ``fit`` with gels that differ; its effects are of the same strength in
            all experiments.
    """
    mean = fit.mean.clone()
    mean[[fit.prior.names.index(name) for name in gels.prior.names]] = gels.mean
    return replace(fit, mean=mean, nuisances=deviating(gels, hypothesis))
