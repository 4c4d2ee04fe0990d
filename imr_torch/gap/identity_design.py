"""The next design: the one that best tells the remaining causes apart.

The causes left by a diagnosis are the models of one belief: each a fit with its posterior, weighted
by its probability. The information that an experiment is expected to give about *which* of them is
true, ``I(cause; y)``, is that about the model (:class:`imr_torch.design.Laplace`), averaged over
posterior draws of each cause: at one nominal value the best design is that of one gel, which need
not be this one. It never exceeds the entropy of the causes. What it means is said by the expected
probability of the truth. An unknown effect makes no data, so it is not among the causes here.
"""

from collections.abc import Mapping

import torch

from imr_torch.assimilate import ModelFit
from imr_torch.design import (
    DesignSpace,
    ExpectedInformationGain,
    Laplace,
    NextDesign,
    Plan,
    search_design,
)
from imr_torch.design.response import Shot
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.float64 import linspace, tensor
from imr_torch.material import LIBRARY, Belief
from imr_torch.observe import ExperimentBatch, Nuisance
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Design, Progress

_LEFT = 0.02  # a cause less probable than this is not worth an experiment
_MOST = 6  # causes that are compared
_FINAL = 4  # times the draws at the design that is returned
_REFINEMENTS = 3  # Gauss-Newton steps to the gel of a rival cause


def plan_of(batch: ExperimentBatch) -> Plan:
    """How the next shot will be observed: as these experiments were, in the median over them.

    Frames are spread evenly over the record. A known exposure is left out: predictions of planned
    shots are instants.

    >>> import torch
    >>> from imr_torch.gap.identity_design import plan_of
    >>> from imr_torch.observe import Experiment, ExperimentBatch
    >>> times = torch.linspace(0.0, 2.0, 41, dtype=torch.float64)
    >>> plan = plan_of(ExperimentBatch((Experiment("shot 1", (400.0, 0.22), times, torch.ones(3, 41, dtype=torch.float64)),)))
    >>> plan.repeats, len(plan.times), float(plan.times[-1])
    (3, 41, 2.0)
    """
    rows = [(e.times[0], e.times[-1], len(e.times), e.repeats) for e in batch.curves]
    first, last, frames, repeats = tensor(rows).median(0).values.tolist()
    return Plan(
        times=linspace(first, last, round(frames)),
        repeats=round(repeats),
        noise=batch.noise,
        nuisance=Nuisance(*batch.nuisance_sds.median(0).values.tolist()),
        collapses=None,
    )


def remaining_causes(
    fits: Mapping[str, ModelFit], posterior: Mapping[str, float]
) -> dict[str, float]:
    """The causes worth telling apart, the most probable of each family, with probabilities that sum
    to one.

    Args:
        fits: hypothesis -> fit.
        posterior: hypothesis -> probability; ``"other"`` and what has no fit cannot be simulated
            and are left out.

    Raises:
        InputDataError: if fewer than two causes are left.
    """
    ranked = sorted(
        (name for name in posterior if name in fits), key=lambda name: -posterior[name]
    )
    chosen: dict[str, str] = {}
    for name in ranked:
        # two members of a family are the same to first order: no design of this kind separates them
        part = name.split("+")[-1]
        family = LIBRARY[part].family if part in LIBRARY else part
        if posterior[name] >= _LEFT and len(chosen) < _MOST:
            chosen.setdefault(family, name)
    if len(chosen) < 2:
        raise InputDataError(
            f"Causes with a fit and a probability of {_LEFT} or more are "
            f"{', '.join(chosen.values()) or 'none'}; two of different families are needed."
        )
    total = sum(posterior[name] for name in chosen.values())
    return {name: posterior[name] / total for name in chosen.values()}


def identity_design(
    fits: Mapping[str, ModelFit],
    posterior: Mapping[str, float],
    simulator: Simulator,
    *,
    plan: Plan,
    seed: int,
    space: DesignSpace | None = None,
    designs: int = 16,
    draws: int = 16,
    progress: Progress = None,
) -> NextDesign:
    """The design that best tells the remaining causes apart.

    Designs that fill the space are evaluated with the same draws, a Gaussian process smooths the
    map, and the maximum of its mean is evaluated once more with fresh draws, so the gain that is
    returned is free of the winner's curse.

    Args:
        fits: hypothesis -> fit (:attr:`imr_torch.gap.attribute.Attribution.with_one_gel`), with
            ``"none"`` if it is still possible.
        posterior: hypothesis -> probability.
        simulator: makes the bubbles.
        plan: how the next experiment will be observed.
        seed: of draws and surrogate.
        space: designs that can be shot.
        designs: how many are evaluated.
        draws: data made of each cause at each design; at the one returned four times as many.
        progress: called with one line per design.

    Raises:
        InputDataError: if fewer than two causes are left, or fewer than two designs could be
            simulated.
        ConvergenceError: if too many bubbles fail at the best design.
    """
    causes = remaining_causes(fits, posterior)
    gain = ExpectedInformationGain(
        _belief(causes, fits),
        simulator,
        _estimator(draws),
        target="model",
        plan=plan,
        space=space,
    )
    found = search_design(
        gain,
        seed=child(seed, "search"),
        evaluations=designs,
        initial=designs,
        progress=progress,
    )
    return judge_design(
        causes,
        fits,
        found.recommendation.design,
        simulator,
        plan,
        draws=_FINAL * draws,
        seed=child(seed, "best"),
    )


def judge_design(
    causes: Mapping[str, float],
    fits: Mapping[str, ModelFit],
    design: Design,
    simulator: Simulator,
    plan: Plan,
    *,
    draws: int,
    seed: int,
) -> NextDesign:
    """What one shot is expected to tell about the cause.

    Args:
        causes: cause -> probability now, summing to one.
        fits: cause -> fit.
        design: ``2`` tensor, (We, R_inf*).
        simulator: makes the bubbles.
        plan: how the shot will be observed.
        draws: data made of each cause.
        seed: of draws and noise.

    Raises:
        ConvergenceError: if fewer than two data of a cause could be simulated.
    """
    shot = Shot(_belief(causes, fits), design[None], simulator, plan)
    gels, _, logs = _estimator(draws).compare_models(shot, generator(seed))
    if min(map(len, gels.parts)) < 2:
        raise ConvergenceError(
            f"Too many bubbles failed at the design {design.tolist()}; narrow the space."
        )
    log_prior = shot.belief.log_probabilities
    posterior = torch.log_softmax(logs.mT + log_prior, dim=1)
    own = [posterior[some, i] for i, some in enumerate(gels.rows)]
    return NextDesign.judge(design, own, dict(causes), plan)


def _belief(causes: Mapping[str, float], fits: Mapping[str, ModelFit]) -> Belief:
    probabilities = tensor(list(causes.values()))
    return Belief(tuple(fits[name].posterior for name in causes), probabilities.log())


def _estimator(draws: int) -> Laplace:
    """All data of a cause are compared with every other cause."""
    return Laplace(draws=draws, rivals=draws, refinements=_REFINEMENTS)
