"""Profile likelihood: how well a parameter can be known at all, whatever the others are.

A parameter is held at values on both sides of its most probable one, and everything else is fitted
again: the other parameters within their priors, and the nuisances. The profile is how many nats the
best fit loses, without the prior of the parameter itself; a 95 % interval is where it loses less
than 1.92 (half the 95 % quantile of chi-square with one degree of freedom; Raue et al.,
Bioinformatics 25, 2009). A profile that does not rise on one side says that the data do not bound
the parameter there, which an interval of the posterior hides behind its prior.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from imr_torch.assimilate.fit import ModelFit
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.map_fit import assimilate_model
from imr_torch.assimilate.options import CheckedOptions, SearchOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.errors import InputDataError
from imr_torch.float64 import tensor
from imr_torch.material import ModelBelief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.types import Progress, ProgressLine

FALL = 1.920729
"""Nats that the best fit loses at the end of a 95 % interval."""


@dataclass(frozen=True)
class ProfileOptions(CheckedOptions):
    """Where a profile is computed.

    Args:
        steps: distances from the most probable value at which the parameter is held, posterior
            standard deviations.
        fall: nats beyond which it is not followed.
        farthest: prior standard deviations from the prior's median beyond which it is not.
        search: of everything else.

    >>> from imr_torch.assimilate.profile import ProfileOptions
    >>> ProfileOptions(steps=(1.0, 2.0)).fall
    3.0
    """

    steps: tuple[float, ...] = (0.7, 1.4, 2.1, 2.8, 3.6, 5.0, 8.0, 13.0, 21.0)
    fall: float = 3.0
    farthest: float = 4.0
    search: SearchOptions = field(
        default_factory=lambda: SearchOptions(starts=2, iterations=30, basin_rounds=0)
    )


@dataclass(frozen=True)
class Profile:
    """The profile likelihood of one parameter.

    Args:
        name: of the parameter.
        values: where it was held, SI, ascending.
        fall: nats that the best fit loses there, 0 at the best of them.
        converged: whether the fit at each value has converged.
        limits: ends of the 95 % interval, SI; None where the profile does not fall by 1.92 nats
            within the prior.

    >>> from imr_torch.assimilate import Profile
    >>> Profile("G", (1e3, 2e3, 3e3), (4.0, 0.0, 1.0), (True, True, True), (1.3e3, None)).bounded
    'from below'
    """

    name: str
    values: tuple[float, ...]
    fall: tuple[float, ...]
    converged: tuple[bool, ...]
    limits: tuple[float | None, float | None]

    @property
    def bounded(self) -> str:
        """``"on both sides"``, ``"from below"``, ``"from above"`` or ``"on neither side"``."""
        low, high = (limit is not None for limit in self.limits)
        return {
            (True, True): "on both sides",
            (True, False): "from below",
            (False, True): "from above",
        }.get((low, high), "on neither side")


def profile(
    fit: ModelFit,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    names: tuple[str, ...] = (),
    options: ProfileOptions | None = None,
    seed: int = 0,
    progress: Progress = None,
) -> tuple[Profile, ...]:
    """The profile likelihood of parameters at a fit.

    Each value starts where the fit at the value before it ended, and from a point beside that.

    Args:
        fit: the most probable gel of a model with two free parameters or more.
        batch: the data.
        simulator: makes the bubbles.
        names: parameters; all free ones of the model without any.
        options: where it is computed.
        seed: of the second starts.
        progress: called with one line per value.

    Raises:
        InputDataError: for a parameter that the model does not have, or a model with one parameter.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, wide_prior
    >>> from imr_torch.assimilate import SearchOptions, assimilate, profile
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> simulator = PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=1)
    >>> batch = ExperimentBatch((laboratory.shoot(torch.tensor([400.0, 0.22]).double(), seed=1),))
    >>> fits = assimilate(wide_prior(["nhkv"]), batch, simulator, seed=0, options=SearchOptions(raw_samples=16, starts=2))
    >>> (found,) = profile(fits["nhkv"], batch, simulator, names=("mu",))
    >>> found.bounded, found.limits[0] < 0.093 < found.limits[1]
    ('on both sides', True)
    """
    prior = fit.prior
    wrong = [name for name in names if name not in prior.names]
    if wrong:
        raise InputDataError(
            f"profile: {wrong[0]!r} is no free parameter of {prior.model!r}; it has "
            f"{', '.join(prior.names)}."
        )
    if len(prior.names) < 2:
        raise InputDataError(
            f"profile: {prior.model!r} has one free parameter, so its posterior is its profile."
        )
    return tuple(
        _profile_parameter(
            Posterior(prior, batch, simulator),
            fit,
            prior.names.index(name),
            options or ProfileOptions(),
            seed,
            progress,
        )
        for name in names or prior.names
    )


def _profile_parameter(
    posterior: Posterior,
    fit: ModelFit,
    i: int,
    options: ProfileOptions,
    seed: int,
    progress: Progress,
) -> Profile:
    """The profile of one parameter, followed to both sides until it has fallen by enough."""
    prior = fit.prior
    name = prior.names[i]
    rest = [j for j in range(len(prior.names)) if j != i]
    control = float(prior.unwhitened(fit.mean)[i])
    centre = float(prior.mean[i])
    sd, width = (float(part.chol[i].norm()) for part in (fit.posterior, prior))
    covariance = fit.posterior.chol @ fit.posterior.chol.mT
    ridge = covariance[rest, i] / covariance[i, i]
    own_prior = 0.5 * ((control - centre) / width) ** 2
    found = {control: (fit.cost - own_prior, fit.certificate.converged)}
    for side in (-1.0, 1.0):
        others = prior.unwhitened(fit.mean)[rest] + side * options.steps[0] * sd * ridge
        nuisances = fit.nuisances
        for step in options.steps:
            held = control + side * step * sd
            if abs(held - centre) > options.farthest * width:
                break
            left = _hold_parameter(prior, i, held)
            begin = left.whitened(others[None])
            last = assimilate_model(
                replace(posterior, prior=left),
                Point(torch.cat((begin, begin + 0.01)), nuisances),
                seed=child(seed, "profile", name, str(side), str(step)),
                options=options.search,
            )
            if not math.isfinite(last.cost):  # no bubble could be made there
                break
            others = left.unwhitened(last.mean)
            nuisances = last.nuisances
            found[held] = (last.cost, last.certificate.converged)
            lowest = min(cost for cost, _ in found.values())
            if progress:
                text = f"profile of {name}: {side * step:+.1f} sd, {last.cost - lowest:.2f} nats"
                progress(ProgressLine(text, stage="profile"))
            if last.cost - lowest > options.fall:
                break
    places = tensor(sorted(found))
    costs, converged = zip(*(found[place] for place in places.tolist()), strict=True)
    values = prior.marginals[i].to_physical(places).tolist()
    fall = [cost - min(costs) for cost in costs]
    best = fall.index(0.0)
    low = _find_crossing(values[: best + 1][::-1], fall[: best + 1][::-1])
    high = _find_crossing(values[best:], fall[best:])
    return Profile(name, tuple(values), tuple(fall), converged, (low, high))


def _hold_parameter(prior: ModelBelief, i: int, control: float) -> ModelBelief:
    """The prior of the other parameters given one that is held at a control."""
    rest = [j for j in range(len(prior.names)) if j != i]
    whole = prior.chol @ prior.chol.mT
    slope = whole[rest, i] / whole[i, i]
    covariance = whole[rest][:, rest] - torch.outer(slope, whole[i, rest])
    value = prior.marginals[i].to_physical(tensor(control))
    return replace(
        prior,
        marginals=tuple(prior.marginals[j] for j in rest),
        mean=prior.mean[rest] + slope * (control - prior.mean[i]),
        chol=torch.linalg.cholesky(covariance),
        known={**prior.known, prior.names[i]: float(value)},
        cloud=None,
    )


def _find_crossing(values: list[float], fall: list[float]) -> float | None:
    """The first value, from the best one outwards, at which the root of the fall crosses that of
    ``FALL``.
    """
    beyond = next((k for k, nats in enumerate(fall) if nats > FALL), None)
    if beyond is None:
        return None
    around = slice(beyond - 1, beyond + 1)
    return float(np.interp(FALL**0.5, np.sqrt(fall[around]), values[around]))
