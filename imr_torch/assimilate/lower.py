"""Repeated fits of models for which a posterior draw has a lower cost than the fitted minimum.

Starts that agree do not exclude another, lower minimum: where frames lie next to a collapse, the
nuisances of one experiment may have a second minimum that no start came near. Posterior draws,
whose nuisances are fitted anew for each gel, may find it. The weights of draws only suggest it,
since they depend on a few draws of the nuisances; decisive is the cost of the most probable draws,
at their own most probable nuisances.
"""

import math
from collections.abc import Sequence

import torch

from imr_torch.assimilate.conditional import conditional_nuisances
from imr_torch.assimilate.fit import ModelFit
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.map_fit import assimilate
from imr_torch.assimilate.options import SearchOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.starts import around
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

# nats by which a draw must be more probable than the optimum; the integral over nuisances is off by
# some tenths
_MORE = 1.0
_LOWER = 0.1  # nats by which a point or minimum must be lower to belong to another
_LIKELIEST, _STEPS = 4, 3  # draws that are looked at, and Gauss-Newton steps of their nuisances
_AWAY = 3.0  # posterior standard deviations between the draw and the second start
_OPTIONS = SearchOptions(starts=2)


def lower_point(
    fit: ModelFit, best: float, batch: ExperimentBatch, simulator: Simulator
) -> Point | None:
    """The lowest of the most probable draws if its cost is below the fit's own minimum.

    Args:
        fit: a model with its draws.
        best: the lowest cost of all models, nats; a model that is far behind is left out.
        batch: the data.
        simulator: the simulator it was made with; asked only where the weights suggest another
            minimum.
    """
    assert fit.sample is not None
    if fit.far_behind(best) or _excess(fit) <= _MORE:
        return None
    likeliest = fit.sample.log_target_as_fitted.argsort(descending=True)[:_LIKELIEST]
    posterior = Posterior(fit.prior, batch, simulator)
    point = Point(fit.sample.controls[likeliest], fit.sample.nuisances[likeliest])
    chol = fit.nuisance_chol.expand(len(likeliest), -1, -1, -1)
    if len(posterior.uncertain):
        for _ in range(_STEPS):
            nuisances, chol = conditional_nuisances(posterior, point, chol)
            point = Point(point.gel, nuisances)
    highest = posterior.log_joint(point).max(0)
    return point[highest.indices] if -float(highest.values) < fit.cost - _LOWER else None


def lower_minima(
    fits: Sequence[ModelFit],
    points: Sequence[Point],
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: int,
    progress: Progress | None = None,
) -> dict[str, ModelFit]:
    """Fit models again from points below their minima.

    Args:
        fits: the models, at least one; not changed.
        points: of each, see :func:`lower_point`.
        batch: the data.
        simulator: the simulator they were made with.
        seed: of the second starts.
        progress: called with one line per iteration, and one for each lower minimum.

    Returns:
        Model -> fit, those whose new minimum is lower, without draws.
    """
    starts = []
    nuisances = []
    for fit, point in zip(fits, points, strict=True):
        second = around(fit.chol, generator(child(seed, "lower", fit.model)), _AWAY)
        moves = torch.stack((torch.zeros_like(second), second))
        starts.append(point.gel + moves)
        nuisances.append(
            point.nuisances + (fit.nuisance_response @ moves[:, None, :, None])[..., 0]
        )
    belief = Belief(tuple(fit.prior for fit in fits), torch.zeros(len(fits), dtype=torch.float64))
    found = assimilate(
        belief,
        batch,
        simulator,
        seed=seed,
        options=_OPTIONS,
        starts=starts,
        nuisances=nuisances,
        warn=False,
        progress=progress,
    )
    before = {fit.model: fit.cost for fit in fits}
    lower = {fit.model: fit for fit in found.fits if fit.cost < before[fit.model] - _LOWER}
    if progress:
        for model, fit in lower.items():
            progress(
                f"{model}: draws found a minimum that is {before[model] - fit.cost:.1f} nats lower"
            )
    return lower


def _excess(fit: ModelFit) -> float:
    """Log probability of the most probable draw over that of the optimum, whose nuisances its
    Gaussian integrates out.
    """
    assert fit.sample is not None
    at_optimum = (
        -fit.cost - 0.5 * fit.nuisance_log_det - 0.5 * len(fit.mean) * math.log(2.0 * math.pi)
    )
    return float(fit.sample.log_target_as_fitted.max()) - at_optimum
