"""Predictive scores: the log density that a model fitted to some experiments gives to held-out
ones.

Evidence measures how well prior and model predict all data, and so depends on the prior's width; a
held-out score measures how well the posterior given some experiments predicts the others. Leaving
some out of a weighted fit needs no simulation while the weights allow it (Pareto-smoothed
leave-one-out: Vehtari, Gelman & Gabry, Stat. Comput. 27, 2017, with whole experiments for single
data); where they do not, the fit is made again without them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imr_torch.assimilate import Assimilation, ModelFit, SearchOptions, assimilate, weigh
from imr_torch.assimilate.importance import are_reliable, effective_size, smooth_tail
from imr_torch.errors import InputDataError
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child
from imr_torch.select.evidence import log_evidence
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress, ProgressLine


@dataclass(frozen=True)
class PredictiveScore:
    """Log predictive density of held-out experiments.

    Args:
        model: key of the constitutive model.
        held_out: labels of the experiments.
        value: ``log p(held out | the others)``, nats; of all repeats and frames together.
        error: its Monte Carlo standard error.
        pareto_k: shape of the tail of the weights that leave the experiments out (before a refit);
            the largest, of several.
        refitted: whether the fit was made again without them, once at least.

    >>> from imr_torch.select import PredictiveScore
    >>> score = PredictiveScore("nhkv", held_out=("shot 2",), value=101.2, error=0.1, pareto_k=0.3, refitted=False)
    >>> score.held_out
    ('shot 2',)
    """

    model: str
    held_out: tuple[str, ...]
    value: float
    error: float
    pareto_k: float
    refitted: bool


def default_folds(count: int, *, alone: int = 5, parts: int = 4) -> list[list[int]]:
    """Which of ``count`` experiments are held out together: each alone up to five, else in four
    parts.

    >>> from imr_torch.select import default_folds
    >>> default_folds(3), default_folds(9)
    ([[0], [1], [2]], [[0, 4, 8], [1, 5], [2, 6], [3, 7]])
    """
    if count <= alone:
        return [[i] for i in range(count)]
    return [list(range(start, count, parts)) for start in range(parts)]


@one_torch_thread()
def cross_validate(
    assimilation: Assimilation,
    simulator: Simulator,
    *,
    seed: int,
    folds: Sequence[Sequence[int]] | None = None,
    samples: int = 256,
    options: SearchOptions | None = None,
    progress: Progress = None,
) -> tuple[PredictiveScore, ...]:
    """Score every model on each fold of the experiments, learning from the others.

    Args:
        assimilation: weighted fits to all experiments.
        simulator: the simulator they were made with, for refits.
        seed: of refits, which start where the whole fit ended.
        folds: indices of the experiments that are held out together; :func:`default_folds` when not
            given.
        samples: draws per round of a refit.
        options: how a refit searches.
        progress: called with one line per fold.

    Returns:
        One score per fold and model, models within folds; see :func:`sum_over_folds`.

    Raises:
        InputDataError: if the fits are not weighted, or a fold is empty or holds all experiments.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case, wide_prior
    >>> from imr_torch.assimilate import SearchOptions, assimilate, weigh
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> from imr_torch.select import cross_validate
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> designs = torch.tensor([[400.0, 0.22], [600.0, 0.18]], dtype=torch.float64)
    >>> batch = ExperimentBatch(tuple(laboratory.shoot(design, seed=1) for design in designs))
    >>> fits = assimilate(wide_prior(["nhkv"]), batch, simulator, seed=0, options=SearchOptions(raw_samples=16, starts=2))
    >>> scores = cross_validate(weigh(fits, simulator, seed=0, samples=64), simulator, seed=0, samples=64)
    >>> [score.held_out for score in scores]
    [('We 400, R_inf* 0.220',), ('We 600, R_inf* 0.180',)]
    """
    batch = assimilation.batch
    count = len(batch.experiments)
    folds = default_folds(count) if folds is None else folds
    for fold in folds:
        if not 0 < len(set(fold)) < count or not all(0 <= e < count for e in fold):
            raise InputDataError(
                f"Fold {list(fold)}: expected some, and not all, of the experiments 0 to "
                f"{count - 1}."
            )
    scores = []
    for number, fold in enumerate(folds):
        found = [_leave_out(fit, batch, fold) for fit in assimilation.fits]
        poor = [i for i, (_, trusted) in enumerate(found) if not trusted]
        if poor:
            whole = assimilation.fits[poor[0]].sample
            assert whole is not None
            near = _restrict_fits(assimilation, poor, [e for e in range(count) if e not in fold])
            seed_of_fit = child(seed, "fit", number)
            again = assimilate(
                near.prior, near.batch, simulator, seed=seed_of_fit, options=options, near=near
            )
            noise = None if whole.noise is None else whole.noise.nodes
            again = weigh(
                again, simulator, seed=child(seed, "weigh", number), samples=samples, noise=noise
            )
            for i, fit in zip(poor, again.fits, strict=True):
                # evidence of all experiments over evidence of the others
                joint = log_evidence(assimilation.fits[i])
                rest = log_evidence(fit)
                value = joint.value - rest.value
                error = math.hypot(joint.error, rest.error)
                found[i] = replace(found[i][0], value=value, error=error, refitted=True), True
        scores += [score for score, _ in found]
        if progress:
            text = f"scores: held out {', '.join(scores[-1].held_out)}"
            progress(ProgressLine(text, stage="scores"))
    return tuple(scores)


def sum_over_folds(scores: Sequence[PredictiveScore]) -> tuple[PredictiveScore, ...]:
    """The score of each model over all folds, in the order of the models.

    >>> from imr_torch.select import PredictiveScore, sum_over_folds
    >>> first = PredictiveScore("nhkv", ("shot 1",), value=100.0, error=0.3, pareto_k=0.2, refitted=False)
    >>> second = PredictiveScore("nhkv", ("shot 2",), value=90.0, error=0.4, pareto_k=0.1, refitted=False)
    >>> (total,) = sum_over_folds([first, second])
    >>> total.value, total.error
    (190.0, 0.5)
    """
    by_model = {score.model: [s for s in scores if s.model == score.model] for score in scores}
    return tuple(
        PredictiveScore(
            model,
            held_out=tuple(label for one in own for label in one.held_out),
            value=sum(one.value for one in own),
            error=math.hypot(*(one.error for one in own)),
            pareto_k=max(one.pareto_k for one in own),
            refitted=any(one.refitted for one in own),
        )
        for model, own in by_model.items()
    )


def _restrict_fits(
    assimilation: Assimilation, models: Sequence[int], experiments: Sequence[int]
) -> Assimilation:
    """Some models and experiments of an assimilation: where a search without the others starts."""
    prior = assimilation.prior
    batch = assimilation.batch
    belief = Belief(tuple(prior.models[i] for i in models), prior.log_probabilities[list(models)])
    kept = replace(batch, experiments=tuple(batch.experiments[e] for e in experiments))
    rows = list(experiments)
    frames = kept.mask.shape[1]
    begin = (assimilation.fits[i].of_experiments(rows, frames) for i in models)
    return Assimilation(belief, kept, tuple(begin))


def _leave_out(
    fit: ModelFit, batch: ExperimentBatch, fold: Sequence[int]
) -> tuple[PredictiveScore, bool]:
    """Score by the weights of the whole fit over the likelihood of the fold, and whether those
    weights are reliable.
    """
    log_evidence(fit)  # says what to do where the fit is not weighted
    sample = fit.sample
    assert sample is not None
    seen = sample.density_given_others(fold)
    log_weights, shape = smooth_tail(
        torch.where(torch.isfinite(seen), sample.log_weights - seen, -torch.inf)
    )
    without = torch.softmax(log_weights, dim=0)
    trusted = are_reliable(shape, float(effective_size(without)), len(sample))
    labels = tuple(batch.experiments[e].label for e in fold)
    value, error = _log_ratio(without, seen)
    return PredictiveScore(fit.model, labels, value, error, shape, False), trusted


def _log_ratio(weights: Tensor, log_values: Tensor) -> tuple[float, float]:
    """Log of the weighted mean of values given by their logarithm, and its standard error (delta
    method).
    """
    joint = weights.log() + torch.where(weights > 0.0, log_values, 0.0)
    tilted = torch.softmax(joint, dim=0)
    return float(torch.logsumexp(joint, dim=0)), float((tilted - weights).norm())
