"""Simulation-based calibration: draws a model and a gel from the prior, simulates data, infers, and
ranks the truth.

If prior, likelihood and computation agree, the place of the truth among draws of its posterior is
uniform, whatever the data (Talts et al., arXiv 1804.06788, 2018; with the log likelihood as a
further quantity: Modrak et al., Bayesian Anal. 20, 2025), and a model that is given probability P
is the true one in a share P of all cases. From an arrangement follows a :class:`Replicate` for each
gel, which :mod:`imr_torch.calibration.statistics` judges. The inference is the toolkit's own or any
function from data to draws (Hamiltonian Monte Carlo, a neural posterior).
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from imr_torch.assimilate import (
    Assimilation,
    FitOptions,
    ImportanceSample,
    ModelFit,
    Point,
    Posterior,
    SearchOptions,
    assimilate_estimating_noise,
    noise_nodes,
    weigh,
)
from imr_torch.design import Plan
from imr_torch.errors import ConvergenceError, ShapeError
from imr_torch.material import Belief
from imr_torch.observe import Experiment, ExperimentBatch, SimulatedLaboratory, collapse_time
from imr_torch.random import child, generator
from imr_torch.select import evidences, update
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread

_ATTEMPTS = 50

Learn = Callable[[tuple[Experiment, ...]], ExperimentBatch]

Infer = Callable[[ExperimentBatch, str, int], Tensor]
"""Data, the true model and a seed to ``n x d`` draws of that model's free parameters, SI."""


@dataclass(frozen=True)
class Arrangement:
    """The prior, designs and inference that are calibrated.

    Args:
        prior: belief before the data, from which truths are drawn.
        designs: (We, R_inf*) of each experiment on a gel.
        plan: how they are observed.
        samples: weighted draws of each model and round.
        options: how gels are fitted, and by which method.
        learn: what the inference is given of the experiments; the data with their own noise when
            not given. Lets a wrong inference be tested, or one with less information.
        noise_rounds: how often the inference estimates the noise from its residuals.
        integrate_noise: whether the noise, where it is estimated, is integrated out, as in a
            characterisation.

    >>> from imr_torch import wide_prior
    >>> from imr_torch.calibration import Arrangement
    >>> arrangement = Arrangement(wide_prior(["nhkv"]), designs=((400.0, 0.22), (600.0, 0.18)), samples=64)
    >>> len(arrangement.designs), arrangement.plan.repeats
    (2, 1)
    """

    prior: Belief
    designs: tuple[tuple[float, float], ...]
    plan: Plan = field(default_factory=Plan)
    samples: int = 256
    options: FitOptions = field(default_factory=SearchOptions)
    learn: Learn | None = None
    noise_rounds: int = 0
    integrate_noise: bool = True


@dataclass(frozen=True)
class Replicate:
    """The result of one simulated gel: ranks of the truth, probabilities and diagnostics.

    Args:
        number: of the replicate.
        model: the truth's.
        gaussian: for each of its parameters, probability that the fit's Gaussian gives to values
            below the truth.
        weighted: the same of the weighted draws, the truth counted as one more of them.
        reported: the same of the posterior that users are given, which is the Gaussian or, where
            weighing repaired it, another.
        log_likelihood: the same of the log likelihood; None where nuisances are uncertain.
        z: (truth - mean)/sd of the Gaussian, in controls.
        probabilities: of all models after the data.
        information: what was learnt, nats: divergence of the posterior over models and gels from
            the prior.
        verdict: on the Gaussian answer of the true model.
        pareto_k: of its weights.
        effective_samples: of them.
        converged: whether every model's fit converged.
        redrawn: gels before this one that could not be simulated.
        failure: why there is no inference, and nothing of the above; None if there is.
        seconds: processor time.

    >>> from imr_torch.calibration import Replicate
    >>> Replicate(0, "nhkv", reported={"G": 0.31, "mu": 0.77}).failure is None
    True
    """

    number: int
    model: str
    gaussian: dict[str, float] = field(default_factory=dict)
    weighted: dict[str, float] = field(default_factory=dict)
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


@one_torch_thread()
def calibrate(
    arrangement: Arrangement,
    simulator: Simulator,
    numbers: Iterable[int],
    *,
    seed: int,
    infer: Infer | None = None,
) -> Iterator[Replicate]:
    """Replicates of an arrangement.

    Args:
        arrangement: what is calibrated.
        simulator: makes the bubbles of truth and inference.
        numbers: which replicates; each depends on the seed and its number alone. Gels and noise of
            a number are the same at every design of one prior.
        seed: of everything random.
        infer: draws a posterior of the true model; its replicates say where truths lie in what is
            ``reported``, and nothing of the other questions. The toolkit's own inference when not
            given.

    Yields:
        Replicates, in the order of their numbers.

    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.calibration import Arrangement, calibrate
    >>> prior = reference_case("soft-pa").prior
    >>> def prior_draws(batch, model, seed):  # an inference that does not look at the data
    ...     part = prior[model]
    ...     return part.physical(part.controls(100, seed=seed))
    >>> arrangement = Arrangement(prior, designs=((400.0, 0.22),))
    >>> found = list(calibrate(arrangement, PolytropicSimulator(), range(3), seed=0, infer=prior_draws))
    >>> [replicate.number for replicate in found], "G" in found[0].reported
    ([0, 1, 2], True)
    """
    for number in numbers:
        own = child(seed, "replicate", number)
        started = time.process_time()
        truth = _draw(arrangement, own, simulator)
        judged = (
            _inferred(arrangement, truth, own, simulator)
            if infer is None
            else _ranked(arrangement, truth, own, infer)
        )
        yield replace(
            judged,
            number=number,
            model=truth.model,
            redrawn=truth.redrawn,
            seconds=time.process_time() - started,
        )


@dataclass(frozen=True)
class _Truth:
    """A gel of the prior: its model, its whitened coordinates, and what was measured of it."""

    model: str
    gel: Tensor
    experiments: tuple[Experiment, ...]
    redrawn: int


def _data(arrangement: Arrangement, truth: _Truth) -> ExperimentBatch:
    """What the inference is given."""
    learn = arrangement.learn or partial(ExperimentBatch, noise=arrangement.plan.noise)
    return learn(truth.experiments)


def _ranked(arrangement: Arrangement, truth: _Truth, seed: int, infer: Infer) -> Replicate:
    """Where the truth lies among the draws of a function."""
    part = arrangement.prior[truth.model]
    try:
        draws = infer(_data(arrangement, truth), truth.model, child(seed, "infer"))
    except ConvergenceError as error:
        return Replicate(0, truth.model, failure=str(error))
    if (
        draws.ndim != 2
        or draws.shape[1] != len(part.names)
        or not bool(torch.isfinite(draws).all())
    ):
        raise ShapeError(
            f"infer returned draws of shape {tuple(draws.shape)} for {truth.model}; expected n x "
            f"{len(part.names)} finite "
            f"numbers in the order {', '.join(part.names)}, SI."
        )
    uniforms = torch.rand(
        len(part.names), generator=generator(child(seed, "lots")), dtype=torch.float64
    )
    below = (draws < part.physical(part.unwhitened(truth.gel))).double().sum(0)
    places = (below + uniforms) / (len(draws) + 1.0)
    return Replicate(
        0, truth.model, reported=dict(zip(part.names, places.tolist(), strict=True)), converged=True
    )


def _inferred(
    arrangement: Arrangement, truth: _Truth, seed: int, simulator: Simulator
) -> Replicate:
    """Result of the toolkit's own inference on one gel."""
    batch = _data(arrangement, truth)
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
        uncertain = arrangement.noise_rounds > 0 and arrangement.integrate_noise
        noise = noise_nodes(fitted, simulator) if uncertain else None
        result = weigh(
            fitted, simulator, seed=child(seed, "weigh"), samples=arrangement.samples, noise=noise
        )
    except ConvergenceError as error:
        return Replicate(0, truth.model, failure=str(error))
    fit = result[truth.model]
    sample = _sample(fit)
    names = fit.prior.names
    reported = fit.posterior
    uniforms = torch.rand(
        len(truth.gel) + 1, generator=generator(child(seed, "lots")), dtype=torch.float64
    ).tolist()
    z = (truth.gel - fit.mean) / torch.linalg.norm(fit.chol, dim=1)
    z_reported = (fit.prior.unwhitened(truth.gel) - reported.mean) / torch.linalg.norm(
        reported.chol, dim=1
    )
    above = truth.gel - sample.controls
    return Replicate(
        number=0,
        model=truth.model,
        gaussian=dict(zip(names, torch.special.ndtr(z).tolist(), strict=True)),
        weighted={
            name: _place(sample, above[:, i] > 0.0, uniforms[i]) for i, name in enumerate(names)
        },
        reported=dict(zip(names, torch.special.ndtr(z_reported).tolist(), strict=True)),
        log_likelihood=_likelihood_place(fit, result, truth, simulator, uniforms[-1]),
        z=dict(zip(names, z.tolist(), strict=True)),
        probabilities=update(result, evidences(result)).probabilities,
        information=information(result),
        verdict=fit.verdict.value,
        pareto_k=sample.pareto_k if math.isfinite(sample.pareto_k) else None,
        effective_samples=sample.effective_samples,
        converged=result.converged,
    )


def _likelihood_place(
    fit: ModelFit, result: Assimilation, truth: _Truth, simulator: Simulator, uniform: float
) -> float | None:
    """Share of the draws whose log likelihood is below the truth's.

    None where nuisances are uncertain.
    """
    posterior = Posterior(fit.prior, result.batch, simulator)
    if len(posterior.uncertain):
        return None
    prediction = posterior.predict(Point(truth.gel, posterior.still()))
    own = float(result.batch.log_likelihood(prediction).sum())
    sample = _sample(fit)
    return _place(sample, sample.by_experiment.sum(1) < own, uniform)


def _draw(arrangement: Arrangement, seed: int, simulator: Simulator) -> _Truth:
    """A gel of the prior that can be simulated, and its experiments, cut to the window."""
    prior = arrangement.prior
    plan = arrangement.plan
    chosen = torch.multinomial(
        prior.log_probabilities.exp(), 1, generator=generator(child(seed, "model"))
    )
    part = prior.models[int(chosen)]
    for attempt in range(_ATTEMPTS):
        gel = torch.randn(
            len(part.names), generator=generator(child(seed, "gel", attempt)), dtype=torch.float64
        )
        laboratory = SimulatedLaboratory(
            simulator,
            part.to_si(gel),
            noise=plan.noise,
            repeats=plan.repeats,
            times=plan.times,
            nuisance=plan.nuisance,
        )
        try:
            shots = [
                laboratory.shoot(design, seed=own) for design, own in _shots(arrangement, seed)
            ]
        except ConvergenceError:
            continue
        if plan.collapses is not None:
            shots = [
                shot.until(collapse_time(shot.times, shot.mean, plan.collapses)) for shot in shots
            ]
        return _Truth(part.model, gel, tuple(shots), attempt)
    raise ConvergenceError(
        f"None of {_ATTEMPTS} gels of the prior of {part.model!r} could be simulated at "
        f"{arrangement.designs}."
    )


def _shots(arrangement: Arrangement, seed: int) -> Iterator[tuple[Tensor, int]]:
    """Each design with the seed of its noise."""
    for number, design in enumerate(arrangement.designs):
        yield (
            torch.tensor(design, dtype=torch.float64),
            child(seed, "shoot", number) if number else child(seed, "shoot"),
        )


def _sample(fit: ModelFit) -> ImportanceSample:
    assert fit.sample is not None
    return fit.sample


def _place(sample: ImportanceSample, below: Tensor, uniform: float) -> float:
    """Rank of the truth in a posterior, between 0 and 1, uniform if the inference is calibrated.

    The weight of the draws below the truth, with the truth counted as one more effective draw: the
    fraction ``uniform`` of its weight, a uniform random number, counts as below.
    """
    count = sample.effective_samples
    return (count * float(sample.weights @ below.double()) + uniform) / (count + 1.0)


def information(result: Assimilation) -> float:
    """Information gained, nats: the Kullback-Leibler divergence of the posterior over models and
    gels from the prior.

    Its mean over data is the expected information gain of the experiment (Lindley, Ann. Math. Stat.
    27, 1956).

    Args:
        result: weighted fits.
    """
    prior = result.prior.log_probabilities
    after = torch.log_softmax(
        prior + torch.tensor([e.value for e in evidences(result)], dtype=torch.float64), dim=0
    )
    gains = []
    for fit in result.fits:
        sample = _sample(fit)
        seen = torch.where(sample.weights > 0.0, sample.log_likelihood, 0.0)
        gains.append(sample.weights @ seen - sample.log_evidence)
    terms = after.exp() * (after - prior + torch.stack(gains))
    return float(torch.where(after.exp() > 0.0, terms, 0.0).sum())
