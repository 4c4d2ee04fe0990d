"""Fits that are made again because draws of their posterior came upon a lower minimum.

Starts that agree say that a minimum was found twice, not that there is no other: where frames lie next to a collapse, the
nuisances of one experiment may have a second valley that no scout fell into. Draws of the posterior, whose nuisances are placed
anew for each gel, do. A draw that is more probable than the optimum is by the fit's own Gaussian tells of such a valley.
"""

import math
from collections.abc import Sequence

import torch

from imr_torch.assimilate.en4dvar import assimilate
from imr_torch.assimilate.fit import ModelFit
from imr_torch.assimilate.options import EnsembleOptions
from imr_torch.assimilate.starts import around
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

_MORE = 1.0  # nats by which a draw must be more probable than the optimum; the integral over nuisances is off by some tenths
_LOWER = 0.1  # nats by which a minimum must be lower to be another
_AWAY = 3.0  # posterior standard deviations between the draw and the second start
_OPTIONS = EnsembleOptions(starts=2)


def has_a_better_draw(fit: ModelFit, best: float) -> bool:
    """Whether a draw is more probable than the optimum, of a model that is not far behind ``best``, the cost of another."""
    return not fit.out_of_the_running(best) and _excess(fit) > _MORE


def lower_minima(
    fits: Sequence[ModelFit], batch: ExperimentBatch, simulator: Simulator, *, seed: int, progress: Progress | None = None
) -> dict[str, ModelFit]:
    """Fit models again from their most probable draws.

    Args:
        fits: models with their draws, at least one; not changed.
        batch: the data.
        simulator: the simulator they were made with.
        seed: of the second starts.
        progress: called with one line per iteration, and one for each lower minimum.

    Returns:
        Model -> fit, those whose new minimum is lower, without draws.
    """
    starts, nuisances = [], []
    for fit in fits:
        assert fit.sample is not None
        draw = int(fit.sample.log_target.argmax())
        second = around(fit.chol, generator(child(seed, "lower", fit.model)), _AWAY)
        starts.append(fit.sample.controls[draw] + torch.stack((torch.zeros_like(second), second)))
        nuisances.append(fit.sample.nuisances[draw])
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
            progress(f"{model}: draws found a minimum that is {before[model] - fit.cost:.1f} nats lower")
    return lower


def _excess(fit: ModelFit) -> float:
    """Log probability of the most probable draw over that of the optimum, whose nuisances its Gaussian integrates out."""
    assert fit.sample is not None
    at_optimum = -fit.cost - 0.5 * fit.nuisance_log_det - 0.5 * len(fit.mean) * math.log(2.0 * math.pi)
    return float(fit.sample.log_target.max()) - at_optimum
