"""How much of an effect shows: what a refit of the gel, and of what is uncertain in each experiment, leaves of it in sd.

The refit is a real one as far as it makes the rest smaller: to first order alone, most effects leave several times more.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from imr_torch.gap.locate import PHASES, phase_clock, phase_name
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.simulate import Simulator

_NUDGE = 0.01  # relative step of G and mu, and step of nuisances in prior sd, for their slopes
_FARTHEST_GEL, _FARTHEST_NUISANCE = 1.0, 15.0  # move of the log of G and mu, and of nuisances in prior sd
_REFITS = 3


def signals(
    gel: Mapping[str, float], effects: Sequence[Mapping[str, float]], plan: ExperimentBatch, simulator: Simulator, repeats: int
) -> list[list[float]]:
    """What a refit leaves of each effect, up to the end of each phase.

    Args:
        gel: G and mu, SI.
        effects: changed parameters of each, SI.
        plan: the experiments; their nuisances are refitted with their priors.
        simulator: makes the bubbles.
        repeats: curves of each experiment.

    Returns:
        A row an effect with an entry for each of ``PHASES``, in standard deviations of the data; NaN where it has no curve.
    """
    if not effects:
        return []
    columns = torch.nonzero((plan.nuisance_sds > 0.0).any(0))[:, 0].tolist()
    size, experiments = len(gel), len(plan.experiments)
    still = torch.zeros(experiments, 3, dtype=torch.float64)

    def curves(gels: Sequence[Mapping[str, float]], changed: Sequence[Mapping[str, float]], shifts: Tensor) -> Tensor:
        parameters = [PARAMETERS.pack({**one, **effect}) for one, effect in zip(gels, changed, strict=True)]
        return predict(simulator, torch.stack(parameters), plan, shifts * plan.nuisance_sds if columns else None)

    nudged = [gel, *({**gel, name: math.exp(_NUDGE) * gel[name]} for name in gel), *([gel] * (len(columns) + len(effects)))]
    shifts = still.repeat(len(nudged), 1, 1)
    for row, column in enumerate(columns, start=1 + size):
        shifts[row, :, column] = _NUDGE
    first = curves(nudged, [{}] * (1 + size + len(columns)) + list(effects), shifts)
    base, sd = first[0].nan_to_num(), plan.sd(first[0])

    def seen(radius: Tensor) -> Tensor:
        return (plan.whiten(radius - base, sd) * math.sqrt(repeats)).flatten(1)

    clock = phase_clock(plan.times, base, plan.mask)
    phase = torch.tensor([[PHASES.index(phase_name(c)) for c in row] for row in clock.tolist()])
    keep = torch.stack([phase <= last for last in range(len(PHASES))]).flatten(1).to(base)  # P x N
    changes = seen(first[1:])
    own = _each_alone(changes[size : size + len(columns)], experiments)
    slopes = torch.cat((changes[:size], own)).nan_to_num() * keep[:, None]  # P x k x N
    changes = changes[size + len(columns) :] * keep[:, None]  # P x n x N
    priors = torch.cat((torch.zeros(size, len(own), dtype=torch.float64), _NUDGE * torch.eye(len(own), dtype=torch.float64)))
    fitted = torch.cat((slopes, priors.expand(len(PHASES), -1, -1)), 2).mT  # P x (N + nuisances) x k
    basis = torch.linalg.qr(fitted).Q

    def beside_priors(left: Tensor) -> Tensor:
        return torch.nn.functional.pad(left, (0, len(own)))

    def length(left: Tensor) -> Tensor:
        whole = beside_priors(left)
        return (whole - (whole @ basis) @ basis.mT).norm(dim=-1)

    farthest = torch.full((len(priors),), _FARTHEST_NUISANCE / _NUDGE, dtype=torch.float64)
    farthest[:size] = _FARTHEST_GEL / _NUDGE
    lengths = length(changes)
    for _ in range(_REFITS):
        steps = torch.linalg.lstsq(fitted, beside_priors(changes.nan_to_num()).mT, driver="gelsd").solution.mT  # P x n x k
        steps = torch.maximum(torch.minimum(steps, farthest), -farthest)
        moves = -_NUDGE * steps.flatten(0, 1)
        gels = [dict(zip(gel, row, strict=True)) for row in _moved(gel, moves[:, :size])]
        shifts = still.repeat(len(moves), 1, 1)
        for number, column in enumerate(columns):
            shifts[..., column] = moves[:, size:].unflatten(1, (-1, experiments))[:, number]
        moved = seen(curves(gels, list(effects) * len(PHASES), shifts))
        beside = (moved.unflatten(0, steps.shape[:2]) + steps @ slopes) * keep[:, None]
        now = length(beside)
        smaller = now < lengths
        changes, lengths = torch.where(smaller[..., None], beside, changes), torch.where(smaller, now, lengths)
    return lengths.mT.tolist()


def _each_alone(slopes: Tensor, experiments: int) -> Tensor:
    """Slopes of nuisances moved in all experiments (``C x E T``) as those of each in each, ``C E x E T``."""
    eye = torch.eye(experiments, dtype=torch.float64)
    return (eye[:, :, None] * slopes.unflatten(1, (experiments, -1))[:, None]).flatten(2).flatten(0, 1)


def _moved(gel: Mapping[str, float], steps: Tensor) -> list[list[float]]:
    """Values of a gel's parameters after relative steps, a row each."""
    return (torch.tensor(list(gel.values()), dtype=torch.float64) * steps.exp()).tolist()
