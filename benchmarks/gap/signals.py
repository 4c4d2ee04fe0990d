"""How much of an effect shows: what a refit of the gel, and of what is uncertain in each experiment, leaves of it in sd.

The refit is a real one as far as it makes the rest smaller: to first order alone, most effects leave several times more. The
diagnosis does the like at a fit (`imr_torch/gap/refitted.py`); here the gel is the true one, nothing is fitted yet, and each
phase is refitted for itself.
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
    refit = _Refit(gel, plan, simulator)
    everywhere = _NUDGE * refit.everywhere
    still = everywhere.new_zeros(1, everywhere.shape[1])
    unchanged: list[Mapping[str, float]] = [{}] * (1 + len(everywhere))
    curves = refit.curves([*unchanged, *effects], torch.cat((still, everywhere, still.expand(len(effects), -1))))
    base, sd = curves[0].nan_to_num(), plan.sd(curves[0])
    keep = _up_to_each_phase(base, plan)

    def seen(radius: Tensor) -> Tensor:
        return (plan.whiten(radius - base, sd) * math.sqrt(repeats)).flatten(1)

    moved, changes = seen(curves[1:]).split([len(everywhere), len(effects)])
    slopes = refit.of_each(moved).nan_to_num() * keep[:, None]  # P x k x N
    changes = changes * keep[:, None]  # P x n x N
    beside = refit.beside(slopes)
    lengths = beside.length(changes)
    for _ in range(_REFITS):
        steps = beside.taking_back(changes)
        moved = seen(refit.curves([*effects] * len(PHASES), -_NUDGE * steps.flatten(0, 1)))
        rest = (moved.unflatten(0, steps.shape[:2]) + steps @ slopes) * keep[:, None]
        now = beside.length(rest)
        smaller = now < lengths  # not where a solve failed: NaN is not smaller
        changes, lengths = torch.where(smaller[..., None], rest, changes), torch.where(smaller, now, lengths)
    return lengths.mT.tolist()


class _Refit:
    """What is refitted: the log of each parameter of the gel, then each uncertain nuisance of each experiment in prior sd.

    Args:
        gel: G and mu, SI.
        plan: the experiments.
        simulator: makes the bubbles.
    """

    def __init__(self, gel: Mapping[str, float], plan: ExperimentBatch, simulator: Simulator):
        self.gel, self.plan, self.simulator = gel, plan, simulator
        self.uncertain: list[int] = torch.nonzero((plan.nuisance_sds > 0.0).any(0))[:, 0].tolist()

    @property
    def everywhere(self) -> Tensor:
        """Moves that are simulated for slopes: of the gel, and of a nuisance in all experiments at once; ``(2 + C) x k``."""
        blocks = torch.ones(1, len(self.plan.experiments), dtype=torch.float64)
        gel, nuisances = torch.eye(len(self.gel), dtype=torch.float64), torch.eye(len(self.uncertain), dtype=torch.float64)
        return torch.block_diag(gel, torch.kron(nuisances, blocks))

    def of_each(self, slopes: Tensor) -> Tensor:
        """Slopes of those moves (``(2 + C) x N``) as those of everything that is refitted, ``k x N``."""
        experiments = len(self.plan.experiments)
        gel, nuisances = slopes[: len(self.gel)], slopes[len(self.gel) :].unflatten(1, (experiments, -1))
        eye = torch.eye(experiments, dtype=torch.float64)
        return torch.cat((gel, (eye[:, :, None] * nuisances[:, None]).flatten(2).flatten(0, 1)))

    def curves(self, changed: Sequence[Mapping[str, float]], moves: Tensor) -> Tensor:
        """Radii after moves (``B x k``) and with changed parameters, ``B x E x T``."""
        values = torch.tensor(list(self.gel.values()), dtype=torch.float64) * moves[:, : len(self.gel)].exp()
        gels = (dict(zip(self.gel, row, strict=True)) for row in values.tolist())
        parameters = torch.stack([PARAMETERS.pack({**gel, **effect}) for gel, effect in zip(gels, changed, strict=True)])
        if not self.uncertain:
            return predict(self.simulator, parameters, self.plan)
        nuisances = moves.new_zeros(len(moves), len(self.plan.experiments), 3)
        nuisances[..., self.uncertain] = moves[:, len(self.gel) :].unflatten(1, (len(self.uncertain), -1)).mT
        return predict(self.simulator, parameters, self.plan, nuisances * self.plan.nuisance_sds)

    def beside(self, slopes: Tensor) -> "_Beside":
        """The neighbourhood of slopes of one nudge, ``P x k x N``; nuisances have their priors."""
        free = len(self.gel)
        nuisances = slopes.shape[1] - free
        priors = torch.cat((slopes.new_zeros(free, nuisances), _NUDGE * torch.eye(nuisances).to(slopes)))
        farthest = torch.cat((slopes.new_full((free,), _FARTHEST_GEL), slopes.new_full((nuisances,), _FARTHEST_NUISANCE)))
        return _Beside(torch.cat((slopes, priors.expand(len(slopes), -1, -1)), 2).mT, farthest / _NUDGE)


class _Beside:
    """A linear refit in each phase.

    Args:
        fitted: ``P x (N + nuisances) x k`` tensor, what a nudge changes, priors below.
        farthest: ``k`` tensor, most nudges of each.
    """

    def __init__(self, fitted: Tensor, farthest: Tensor):
        self.fitted, self.farthest = fitted, farthest
        self.basis = torch.linalg.qr(fitted).Q

    def length(self, changes: Tensor) -> Tensor:
        """What the refit leaves of changes (``P x n x N``), sd; ``P x n``."""
        whole = self._whole(changes)
        return (whole - (whole @ self.basis) @ self.basis.mT).norm(dim=-1)

    def taking_back(self, changes: Tensor) -> Tensor:
        """Nudges that add up to the changes, as far as they can, ``P x n x k``."""
        target = self._whole(changes.nan_to_num()).mT
        nudges = torch.linalg.lstsq(self.fitted, target, driver="gelsd").solution.mT
        return torch.maximum(torch.minimum(nudges, self.farthest), -self.farthest)

    def _whole(self, changes: Tensor) -> Tensor:
        """Changes above zeros for the priors."""
        return torch.nn.functional.pad(changes, (0, self.fitted.shape[1] - changes.shape[-1]))


def _up_to_each_phase(base: Tensor, plan: ExperimentBatch) -> Tensor:
    """Which frames lie no later than each of ``PHASES``; ``P x N`` of ones and zeros."""
    clock = phase_clock(plan.times, base, plan.mask)
    phase = torch.tensor([[PHASES.index(phase_name(c)) for c in row] for row in clock.tolist()])
    return torch.stack([phase <= last for last in range(len(PHASES))]).flatten(1).to(base)
