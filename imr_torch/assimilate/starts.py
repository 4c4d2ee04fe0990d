"""Where the chains of a search set out: from the best of many prior draws, from given gels, or from about an earlier optimum.

Starts of a model are apart from each other, so that their ending in one place says something.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from imr_torch.assimilate.fit import Assimilation
from imr_torch.assimilate.options import EnsembleOptions
from imr_torch.assimilate.problem import Problem
from imr_torch.errors import ConvergenceError, ShapeError

_APART = 0.5  # prior standard deviations between the scouts that are chosen
_RESTART = 0.25  # prior standard deviations
_BESIDE = 10.0  # posterior standard deviations between an earlier optimum and the starts about it


@dataclass(frozen=True)
class Starts:
    """Points at which ``C`` chains set out.

    Args:
        model: ``C`` tensor, index of the model of each, in order.
        gel: ``C x size`` tensor, controls.
        nuisances: ``C x E x 3`` tensor, standardised.
        cost: ``C`` tensor, nats; infinite where a bubble fails.
    """

    model: Tensor
    gel: Tensor
    nuisances: Tensor
    cost: Tensor


def scouted(problem: Problem, options: EnsembleOptions, source: torch.Generator) -> Starts:
    """The best of many prior draws of each model that are not neighbours of each other."""
    models, count = len(problem.belief.models), options.scouts
    draws = torch.randn(models, count, problem.size, generator=source, dtype=torch.float64)
    draws[:, 0] = 0.0
    for i, part in enumerate(problem.belief.models):
        draws[i, :, len(part.names) :] = 0.0  # padding: controls that this model does not have
    index = torch.arange(models).repeat_interleave(count)
    still = torch.zeros(models * count, *problem.batch.nuisance_sds.shape, dtype=torch.float64)
    cost = problem.cost(index, draws.flatten(0, 1), still).reshape(models, count)
    chosen = torch.stack([_distinct(problem, i, draws[i], cost[i], options.starts) for i in range(models)])
    model = torch.arange(models).repeat_interleave(options.starts)
    rows = chosen.flatten()
    return Starts(model, draws[model, rows], still[: len(model)], cost[model, rows])


def given(problem: Problem, gels: Sequence[Tensor], nuisances: Sequence[Tensor] | None) -> Starts:
    """Given controls, two rows or more of each model; all those of a model begin with the same nuisances, zero by default.

    Raises:
        ShapeError: if the controls do not suit the models.
    """
    free = [len(part.names) for part in problem.belief.models]
    if [rows.shape[1] for rows in gels] != free or min(len(rows) for rows in gels) < 2:
        shapes = [tuple(rows.shape) for rows in gels]
        raise ShapeError(f"starts has shapes {shapes}; expected two rows or more of {free} free parameters.")
    model = torch.arange(len(free)).repeat_interleave(torch.tensor([len(rows) for rows in gels]))
    gel = torch.cat([problem.padded(rows) for rows in gels])
    if nuisances is None:
        begun = torch.zeros(len(model), *problem.batch.nuisance_sds.shape, dtype=torch.float64)
    else:
        begun = torch.stack([nuisances[i] for i in model.tolist()])
    return Starts(model, gel, begun, problem.cost(model, gel, begun))


def beside(problem: Problem, near: Assimilation, options: EnsembleOptions, source: torch.Generator) -> Starts:
    """Each model's optimum in an earlier assimilation, and perturbed copies of it."""
    model = torch.arange(len(problem.belief.models)).repeat_interleave(options.starts)
    fits = [near[problem.belief.keys[i]] for i in model.tolist()]
    noise = torch.stack([problem.padded(around(fit.chol, source, _BESIDE)) for fit in fits])
    noise[:: options.starts] = 0.0
    optimum = torch.stack([problem.padded(fit.mean) for fit in fits])
    nuisances = torch.stack([fit.nuisances for fit in fits])
    gel = optimum + noise
    cost = problem.cost(model, gel, nuisances)
    failed = torch.isinf(cost)
    if bool(failed.any()):
        gel[failed] = optimum[failed]
        cost[failed] = problem.cost(model[failed], gel[failed], nuisances[failed])
    return Starts(model, gel, nuisances, cost)


def around(chol: Tensor, source: torch.Generator, away: float) -> Tensor:
    """A ``d`` perturbation, ``away`` posterior standard deviations (``chol``, ``d x d``) or, if less, a quarter of the prior's.

    Where the data are sharp, a step on the prior's scale leads out of the minimum into whichever lies next to it.
    """
    noise = torch.randn(chol.shape[0], generator=source, dtype=torch.float64)
    step = away * (chol @ noise)
    return step * (_RESTART * noise.norm() / step.norm().clamp_min(1e-300)).clamp_max(1.0)


def _distinct(problem: Problem, model: int, draws: Tensor, cost: Tensor, count: int) -> Tensor:
    """Rows of the best scouts of a model, each apart from the ones before."""
    free = len(problem.belief.models[model].names)
    order = torch.argsort(cost)
    order = order[torch.isfinite(cost[order])]
    if order.numel() < 2:
        raise ConvergenceError(
            f"{problem.belief.keys[model]}: {order.numel()} of {len(cost)} prior draws could be simulated; "
            "check units and bounds of the prior and the designs."
        )
    picked: list[int] = []
    for row in order.tolist():
        gaps = [(draws[row, :free] - draws[other, :free]).norm() for other in picked]
        if all(gap > _APART for gap in gaps):
            picked.append(row)
        if len(picked) == count:
            break
    picked += [row for row in order.tolist() if row not in picked]
    return torch.tensor((picked * count)[:count])
