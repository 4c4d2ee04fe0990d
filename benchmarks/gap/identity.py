"""What the choice of shots is worth: sets that leave several causes, and further shots, chosen or
random, until one is named.

Both arms begin with the same data, and each further shot has as many repeats and the same
nuisances. An arm ends when the diagnosis names one cause alone, right or wrong, or after ``SHOTS``
shots.
"""

from typing import Any

import torch

from benchmarks.gap.sets import NUISANCE, SyntheticSet, Task, film, make_plan, make_set
from benchmarks.gap.table import SHOTS, families, named_alone
from imr_torch.campaign import DesignPolicy, Random, Situation
from imr_torch.design import DesignSpace, Plan
from imr_torch.errors import ConvergenceError
from imr_torch.gap import CauseLearner, GapReport, TellCausesApart
from imr_torch.material import LIBRARY, wide_prior
from imr_torch.observe import Experiment, ExperimentBatch, Nuisance
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator

_PRIOR = wide_prior(("nhkv",))


def compare_designs(task: Task, simulator: Simulator) -> dict[str, Any]:
    """Further shots at a set whose diagnosis leaves several causes, chosen and random, ready for
    JSON.

    Args:
        task: of kind ``"next"``.
        simulator: of the fits.

    Returns:
        ``ambiguous``: whether a gap was found and no cause named alone; then, by arm, ``named``
            (the shot after which a cause
        was named alone, None if none), ``right`` (whether it was the true one), ``p_true`` after
        the last shot and ``shots``, the designs.

    Raises:
        ConvergenceError: if a bubble of the truth cannot be simulated.
    """
    data = make_set(task)
    learner = CauseLearner(tuple(effect.name for effect in data.offered))
    arms: dict[str, DesignPolicy] = {"chosen": TellCausesApart(learner), "random": Random()}
    first = _diagnosed(learner, data.experiments, task, simulator)
    line: dict[str, Any] = {"truth": list(data.truth), "values": data.values, "signal": data.signal}
    line |= {
        "ambiguous": first.found and not named_alone(first.verdict, first.cause),
        "verdict_first": first.verdict,
        "cause_first": list(first.cause),
    }
    if not line["ambiguous"]:
        return line
    found = {name: _arm(policy, data, learner, task, simulator) for name, policy in arms.items()}
    return line | {
        key: {name: own[key] for name, own in found.items()}
        for key in ("named", "right", "p_true", "shots")
    }


def _arm(
    policy: DesignPolicy,
    data: SyntheticSet,
    learner: CauseLearner,
    task: Task,
    simulator: Simulator,
) -> dict[str, Any]:
    """Shots by one policy until a cause is named alone."""
    source = generator(child(task.seed, task.key, "arm"))
    nuisance = NUISANCE if task.nuisances else Nuisance()
    plan = Plan(repeats=task.repeats, nuisance=nuisance, collapses=None)
    experiments = list(data.experiments)
    shots = []
    report = _diagnosed(learner, experiments, task, simulator)
    named = None
    for shot in range(1, SHOTS + 1):
        number = len(experiments) + 1
        batch = ExperimentBatch(tuple(experiments))
        situation = Situation(
            number, _PRIOR, simulator, DesignSpace(), plan, task.seed, prior=_PRIOR, batch=batch
        )
        design = policy.choose(situation).design
        shots.append(design.tolist())
        experiments.append(_shoot(data, design, task, source, f"shot {shot}"))
        report = _diagnosed(learner, experiments, task, simulator)
        if named_alone(report.verdict, report.cause):
            named = shot
            break
    return {
        "named": named,
        "right": named is not None and families(report.cause) == families(data.truth),
        "p_true": _probability(report, data.truth[0]),
        "shots": shots,
    }


def _diagnosed(
    learner: CauseLearner, experiments: Any, task: Task, simulator: Simulator
) -> GapReport:
    return learner.diagnose(_PRIOR, ExperimentBatch(tuple(experiments)), simulator, task.seed)


def _probability(report: GapReport, truth: str) -> float:
    """Of the true effect's family, alone; 0 where no cause was fitted."""
    posterior = {} if report.attribution is None else report.attribution.posterior
    return sum(
        p
        for name, p in posterior.items()
        if name in LIBRARY and LIBRARY[name].family == LIBRARY[truth].family
    )


def _shoot(
    data: SyntheticSet, design: torch.Tensor, task: Task, source: torch.Generator, label: str
) -> Experiment:
    """One experiment on the set's gel."""
    filmed = film(data.values, make_plan(design[None], task), task, source)
    if filmed is None:
        raise ConvergenceError(
            f"The bubble at the design {design.tolist()} could not be simulated."
        )
    (shot,) = filmed[0]
    return Experiment(label, shot.design, shot.times, shot.radius, shot.nuisance)
