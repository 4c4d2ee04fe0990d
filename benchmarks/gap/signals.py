"""How much of an effect shows: what a refit of the gel, and of what is uncertain in each
experiment, leaves of it in sd.

The refit is a real one, of the true curve without noise: most effects are taken back further than
    to first order. It is apart
from the fits under test: SciPy's trust-region least squares from the true gel.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from imr_torch.float64 import eye, tensor
from imr_torch.material import PARAMETERS, Effect
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator

Vector = NDArray[np.float64]

# relative step of G and mu, and step of all others in prior sd, for their slopes
_NUDGE = 1e-4
_FARTHEST = 3.0  # move of the log of G and mu, which the first frames alone do not hold
_UNLIKELY = 6.0  # prior standard deviations that the parameters of a rival may reach
_EVALUATIONS = 60
_TOLERANCE = 1e-6  # relative, of the sum of squares
_FAILED = 1e3  # residual of every frame where a bubble has no curve: no step goes there


def signals(
    gel: Mapping[str, float],
    effects: Sequence[Mapping[str, float]],
    plan: ExperimentBatch,
    simulator: Simulator,
) -> list[float]:
    """What a refit leaves of each effect.

    Args:
        gel: G and mu, SI.
        effects: changed parameters of each, SI.
        plan: the experiments, with as many repeats as are shot; their nuisances are refitted with
            their priors.
        simulator: makes the bubbles.

    Returns:
        Length of each residual, in standard deviations of the data; NaN for an effect that has no
        curve.
    """
    if not effects:
        return []
    curves = predict(
        simulator,
        torch.stack([PARAMETERS.pack({**gel, **effect}) for effect in effects]),
        plan,
    )
    return [refit(gel, curve, plan, simulator) for curve in curves]


def beside_rival(
    gel: Mapping[str, float],
    truth: Mapping[str, float],
    rival: Effect,
    plan: ExperimentBatch,
    simulator: Simulator,
) -> float:
    """What a refit of the gel and of another effect leaves of a true one, in standard deviations of
    the data.

    Args:
        gel: G and mu, SI.
        truth: changed parameters of the true effect, SI.
        rival: the other effect, refitted from each of its starts with its priors.
        plan: the experiments.
        simulator: makes the bubbles.
    """
    curve = predict(simulator, PARAMETERS.pack({**gel, **truth})[None], plan)[0]
    return min(
        refit(gel, curve, plan, simulator, rival=(rival, values)) for values in rival.starts
    )


def refit(
    gel: Mapping[str, float],
    curve: Tensor,
    plan: ExperimentBatch,
    simulator: Simulator,
    *,
    rival: tuple[Effect, Sequence[float]] | None = None,
) -> float:
    """Length of what a refit leaves of a true curve (``E x T``).

    Places are moves of the log of each parameter of the gel, then controls of the parameters of a
    rival, which begin at given values, then moves of each uncertain nuisance of each experiment in
    prior sd.
    """
    uncertain: list[int] = torch.nonzero((plan.nuisance_sds > 0.0).any(0))[:, 0].tolist()
    experiments = len(plan.experiments)
    sd = plan.sd(curve)
    priors = {} if rival is None else rival[0].priors
    values = () if rival is None else rival[1]
    begun = [
        float(prior.to_control(torch.tensor(x).double()))
        for prior, x in zip(priors.values(), values, strict=True)
    ]
    own = len(gel) + len(priors)
    still = np.concatenate(
        (np.zeros(len(gel)), begun, np.zeros(experiments * len(uncertain)))
    )
    if not bool(torch.isfinite(curve[plan.mask]).all()):
        return math.nan

    def place(x: Tensor) -> tuple[Tensor, Tensor]:
        moved = tensor(list(gel.values())) * x[:, : len(gel)].exp()
        beside = [
            prior.to_physical(x[:, len(gel) + i]) for i, prior in enumerate(priors.values())
        ]
        physical = torch.cat((moved, *(column[:, None] for column in beside)), 1)
        rows = torch.stack(
            [
                PARAMETERS.pack(dict(zip((*gel, *priors), row, strict=True)))
                for row in physical.tolist()
            ]
        )
        shifts = x.new_zeros(len(x), experiments, 3)
        shifts[..., uncertain] = x[:, own:].unflatten(1, (experiments, len(uncertain)))
        return rows, shifts * plan.nuisance_sds

    def whitened(radius: Tensor) -> Tensor:
        return plan.whiten(radius - curve, sd)[..., plan.mask]

    def residual(x: Vector) -> Vector:
        rows, shifts = place(torch.from_numpy(x)[None])
        data = whitened(predict(simulator, rows, plan, shifts))[0].nan_to_num(nan=_FAILED)
        return np.concatenate((data.numpy(), x[len(gel) :]))

    def slopes(x: Vector) -> Vector:
        # a nuisance moves its own experiment alone, so that of all experiments is moved at once
        everywhere = torch.block_diag(
            torch.eye(own), torch.eye(len(uncertain)).repeat(1, experiments)
        ).double()
        rows, shifts = place(
            torch.from_numpy(x)
            + _NUDGE * torch.cat((everywhere.new_zeros(1, len(x)), everywhere))
        )
        radius = predict(simulator, rows[None], plan, shifts[None], bundled=True)[0]
        moved = (radius[1:] - radius[0]) / _NUDGE
        alone = eye(experiments)[:, None, :, None] * moved[own:]  # E x C x E x T
        columns = whitened(
            curve + torch.cat((moved[:own], alone.flatten(0, 1)))
        ).nan_to_num()
        believed = eye(len(x))[:, len(gel) :]
        return torch.cat((columns, believed), 1).mT.numpy()

    farthest = np.repeat(
        (_FARTHEST, _UNLIKELY, np.inf), (len(gel), len(priors), len(still) - own)
    )
    begin = still.clip(-farthest, farthest)
    found = least_squares(
        residual,
        begin,
        slopes,
        (-farthest, farthest),
        ftol=_TOLERANCE,
        max_nfev=_EVALUATIONS,
    )
    return math.sqrt(2.0 * found.cost)
