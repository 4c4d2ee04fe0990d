"""Repeated fits of models for which a posterior draw has a lower cost than the fitted minimum.

Starts that agree do not exclude another, lower minimum: where frames lie next to a collapse, the
nuisances of one experiment may have a second minimum that no start came near. Posterior draws,
whose nuisances are fitted anew for each gel, may find it. The weights of draws only suggest it,
since they depend on a few draws of the nuisances; decisive is the cost of the most probable draws,
at their own most probable nuisances. Another mode far from all draws is not detected here, but by
disagreement of the starts in the fit's certificate.
"""

import math

import torch

from imr_torch.assimilate.fit import ModelFit
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.map_fit import assimilate_model
from imr_torch.assimilate.options import SearchOptions, WeighingOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.starts import draw_perturbation
from imr_torch.random import child, generator
from imr_torch.types import Progress


def find_lower_draw(
    fit: ModelFit, best: float, posterior: Posterior, options: WeighingOptions
) -> Point | None:
    """The lowest of the most probable draws if its cost is below the fit's own minimum.

    Args:
        fit: a model with its draws.
        best: the lowest cost of all models, nats; a model that is far behind is left out.
        posterior: of the model; bubbles are made only where the weights suggest another minimum.
        options: by how much, and how many draws are looked at.
    """
    assert fit.sample is not None
    log_target = fit.sample.as_fitted.log_target
    # of the optimum, whose nuisances its Gaussian integrates out
    at_optimum = (
        -fit.cost
        - 0.5 * fit.nuisance_log_det
        - 0.5 * len(fit.mean) * math.log(2.0 * math.pi)
    )
    ahead = float(log_target.max()) - at_optimum
    if fit.far_behind(best) or ahead <= options.lower_draw * math.sqrt(len(fit.nuisances)):
        return None
    likeliest = log_target.argsort(descending=True)[: options.likeliest]
    point = Point(fit.sample.controls[likeliest], fit.sample.nuisances[likeliest])
    for _ in range(options.nuisance_steps if len(posterior.uncertain) else 0):
        point = Point(point.gel, posterior.fit_nuisances(point)[0])
    highest = posterior.log_joint(point).max(0)
    return (
        point[highest.indices]
        if -float(highest.values) < fit.cost - options.lower_minimum
        else None
    )


def fit_lower_minimum(
    fit: ModelFit,
    point: Point,
    posterior: Posterior,
    options: WeighingOptions,
    *,
    seed: int,
    progress: Progress = None,
) -> ModelFit | None:
    """Fit a model again from a point below its minimum.

    Args:
        fit: the model; not changed.
        point: see :func:`find_lower_draw`.
        posterior: of the model.
        options: how far off the second start is, and how much lower a minimum must be.
        seed: of the second start.
        progress: called with one line per iteration, and one for a lower minimum.

    Returns:
        The fit without draws if its minimum is lower, else None.
    """
    second = draw_perturbation(
        fit.chol, generator(child(seed, "lower", fit.model)), options.restart
    )
    moves = torch.stack((torch.zeros_like(second), second))
    nuisances = point.nuisances + (fit.nuisance_response @ moves[:, None, :, None])[..., 0]
    found = assimilate_model(
        posterior,
        Point(point.gel + moves, nuisances),
        seed=seed,
        options=SearchOptions(starts=2),
        progress=progress,
    )
    if found.cost >= fit.cost - options.lower_minimum:
        return None
    if progress:
        progress(
            f"{fit.prior.material.title}: draws found a minimum that is "
            f"{fit.cost - found.cost:.1f} nats lower"
        )
    return found
