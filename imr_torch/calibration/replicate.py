"""Simulation-based calibration: draw a model and a gel from the prior, shoot it, infer it, and ask where the truth came to lie.

If prior, likelihood and computation agree, the place of the truth among draws of its posterior is uniform, whatever the
data (Talts et al., arXiv 1804.06788, 2018; with the log likelihood as a further quantity: Modrak et al., Bayesian Anal. 20,
2025), and a model that is given probability P is the true one in a share P of all cases. In goes an arrangement, out comes
a :class:`Replicate` for each gel, which :mod:`imr_torch.calibration.statistics` judges.

One replicate serves all these questions.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from imr_torch.assimilate import Assimilation, ImportanceSample, ModelFit, SearchOptions, assimilate_estimating_noise, weigh
from imr_torch.design import Plan
from imr_torch.errors import ConvergenceError
from imr_torch.material import Belief
from imr_torch.observe import Experiment, ExperimentBatch, Noise, SimulatedLaboratory, collapse_time
from imr_torch.random import child, generator
from imr_torch.select import evidences, update
from imr_torch.simulate import Simulator

_ATTEMPTS = 50

Learn = Callable[[Experiment], ExperimentBatch]


@dataclass(frozen=True)
class Arrangement:
    """What is calibrated.

    Args:
        prior: belief before the data, from which truths are drawn.
        design: (We, R_inf*).
        plan: how it is observed.
        samples: weighed draws of each model and round.
        options: how the assimilation searches.
        learn: what the inference is given of an experiment; the data with their own noise when not given. For inferences
            that are wrong, to see that this is found, or know less.
        noise_rounds: how often the inference estimates the noise from its residuals.
    """

    prior: Belief
    design: tuple[float, float]
    plan: Plan = field(default_factory=Plan)
    samples: int = 256
    options: SearchOptions = field(default_factory=SearchOptions)
    learn: Learn | None = None
    noise_rounds: int = 0


@dataclass(frozen=True)
class Replicate:
    """What became of one gel.

    Args:
        number: of the replicate.
        model: the truth's.
        gaussian: for each of its parameters, probability that the fit's Gaussian gives to values below the truth.
        weighed: the same of the weighed draws, the truth counted as one more of them.
        reported: the same of the posterior that users are given, which is the Gaussian or, where weighing repaired it, another.
        log_likelihood: the same of the log likelihood; None where nuisances are uncertain.
        z: (truth - mean)/sd of the Gaussian, in controls.
        probabilities: of all models after the data.
        information: what was learnt, nats: divergence of the posterior over models and gels from the prior.
        verdict: on the Gaussian answer of the true model.
        pareto_k: of its weights.
        effective_samples: of them.
        converged: whether every model's fit carries a clean certificate.
        redrawn: gels before this one that could not be simulated.
        failure: why there is no inference, and nothing of the above; None if there is.
        seconds: processor time.
    """

    number: int
    model: str
    gaussian: dict[str, float] = field(default_factory=dict)
    weighed: dict[str, float] = field(default_factory=dict)
    reported: dict[str, float] = field(default_factory=dict)
    log_likelihood: float | None = None
    z: dict[str, float] = field(default_factory=dict)
    probabilities: dict[str, float] = field(default_factory=dict)
    information: float | None = None
    verdict: str = ""
    pareto_k: float | None = None
    effective_samples: float = 0.0
    converged: bool = False
    redrawn: int = 0
    failure: str | None = None
    seconds: float = 0.0


def calibrate(arrangement: Arrangement, simulator: Simulator, numbers: Iterable[int], *, seed: int) -> Iterator[Replicate]:
    """Replicates of an arrangement.

    Args:
        arrangement: what is calibrated.
        simulator: makes the bubbles of truth and inference.
        numbers: which replicates; each depends on the seed and its number alone. Gels and noise of a number are the same
            at every design of one prior.
        seed: of everything random.

    Yields:
        Replicates, in the order of their numbers.
    """
    for number in numbers:
        yield _replicate(arrangement, number, child(seed, "replicate", number), simulator)


@dataclass(frozen=True)
class _Truth:
    """A gel of the prior: its model, its controls in units of the prior, and what was measured."""

    model: str
    controls: Tensor
    curve: Tensor
    experiment: Experiment
    redrawn: int


def _replicate(arrangement: Arrangement, number: int, seed: int, simulator: Simulator) -> Replicate:
    """One gel from draw to judgement."""
    started = time.process_time()
    truth = _draw(arrangement, seed, simulator)
    learn = arrangement.learn or partial(_as_it_is, noise=arrangement.plan.noise)
    batch = learn(truth.experiment)
    try:
        fitted = assimilate_estimating_noise(
            arrangement.prior,
            batch,
            simulator,
            rounds=arrangement.noise_rounds,
            seed=child(seed, "fit"),
            options=arrangement.options,
            warn=False,
        )
        result = weigh(fitted, simulator, seed=child(seed, "weigh"), samples=arrangement.samples)
    except ConvergenceError as error:
        return Replicate(number, truth.model, redrawn=truth.redrawn, failure=str(error))
    fit = result[truth.model]
    sample = _sample(fit)
    lots = torch.rand(len(truth.controls) + 1, generator=generator(child(seed, "lots")), dtype=torch.float64).tolist()
    names = fit.prior.names
    z = (truth.controls - fit.mean) / torch.linalg.norm(fit.chol, dim=1)
    reported = fit.posterior
    at = fit.prior.mean + fit.prior.chol @ truth.controls
    z_reported = (at - reported.mean) / torch.linalg.norm(reported.chol, dim=1)
    above = truth.controls - sample.controls
    known = not bool((batch.nuisance_sds > 0.0).any())
    likely = sample.by_experiment.sum(1) - float(result.batch.log_likelihood(truth.curve).sum()) if known else None
    return Replicate(
        number=number,
        model=truth.model,
        gaussian=dict(zip(names, torch.special.ndtr(z).tolist(), strict=True)),
        weighed={name: _place(sample, above[:, i] > 0.0, lots[i]) for i, name in enumerate(names)},
        reported=dict(zip(names, torch.special.ndtr(z_reported).tolist(), strict=True)),
        log_likelihood=None if likely is None else _place(sample, likely < 0.0, lots[-1]),
        z=dict(zip(names, z.tolist(), strict=True)),
        probabilities=update(result, evidences(result)).probabilities,
        information=information(result),
        verdict=fit.verdict.value,
        pareto_k=sample.pareto_k if math.isfinite(sample.pareto_k) else None,
        effective_samples=sample.effective_samples,
        converged=result.converged,
        redrawn=truth.redrawn,
        seconds=time.process_time() - started,
    )


def _draw(arrangement: Arrangement, seed: int, simulator: Simulator) -> _Truth:
    """A gel of the prior that can be simulated, and its experiment, cut to the window."""
    prior, plan = arrangement.prior, arrangement.plan
    design = torch.tensor(arrangement.design, dtype=torch.float64)
    chosen = torch.multinomial(prior.log_probabilities.exp(), 1, generator=generator(child(seed, "model")))
    part = prior.models[int(chosen)]
    for attempt in range(_ATTEMPTS):
        controls = torch.randn(len(part.names), generator=generator(child(seed, "gel", attempt)), dtype=torch.float64)
        gel = part.parameters(part.mean + part.chol @ controls)
        laboratory = SimulatedLaboratory(
            simulator, gel, noise=plan.noise, repeats=plan.repeats, times=plan.times, nuisance=plan.nuisance
        )
        try:
            experiment = laboratory.shoot(design, seed=child(seed, "shoot"))
        except ConvergenceError:
            continue
        if plan.collapses is not None:
            experiment = experiment.until(collapse_time(experiment.times, experiment.mean, plan.collapses))
        curve = simulator(gel, design, experiment.times).radius
        return _Truth(part.model, controls, curve[None], experiment, attempt)
    raise ConvergenceError(f"None of {_ATTEMPTS} gels of the prior of {part.model!r} could be simulated at {design.tolist()}.")


def _as_it_is(experiment: Experiment, noise: Noise) -> ExperimentBatch:
    return ExperimentBatch((experiment,), noise)


def _sample(fit: ModelFit) -> ImportanceSample:
    assert fit.sample is not None
    return fit.sample


def _place(sample: ImportanceSample, below: Tensor, lot: float) -> float:
    """Share of a posterior below the truth, which is taken for one more effective draw, ``lot`` of it below itself."""
    count = sample.effective_samples
    return (count * float(sample.weights @ below.double()) + lot) / (count + 1.0)


def information(result: Assimilation) -> float:
    """What data taught, nats: the Kullback-Leibler divergence of the posterior over models and gels from the prior.

    Its mean over data is the expected information gain of the experiment (Lindley, Ann. Math. Stat. 27, 1956).

    Args:
        result: weighed fits.
    """
    prior = result.prior.log_probabilities
    after = torch.log_softmax(prior + torch.tensor([e.value for e in evidences(result)], dtype=torch.float64), dim=0)
    gains = []
    for fit in result.fits:
        sample = _sample(fit)
        seen = torch.where(sample.weights > 0.0, sample.by_experiment.sum(1), 0.0)
        gains.append(sample.weights @ seen - sample.log_evidence)
    terms = after.exp() * (after - prior + torch.stack(gains))
    return float(torch.where(after.exp() > 0.0, terms, 0.0).sum())
