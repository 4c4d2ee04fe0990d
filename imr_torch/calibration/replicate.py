"""Simulation-based calibration: draws a model and a gel from the prior, simulates data, infers, and
ranks the truth.

If prior, likelihood and computation agree, the place of the truth among draws of its posterior is
uniform, whatever the data (Talts et al., arXiv 1804.06788, 2018), and a model that is given
probability P is the true one in a share P of all cases. From an arrangement follows a :class:`Replicate` for each
gel, which :mod:`imr_torch.calibration.statistics` judges. The inference is the toolkit's own or any
function from data to draws (Hamiltonian Monte Carlo, a neural posterior).
"""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from imr_torch.assimilate import (
    FitOptions,
    SearchOptions,
    assimilate_estimating_noise,
    noise_nodes,
    weigh,
)
from imr_torch.design import Plan
from imr_torch.errors import ConvergenceError, ShapeError
from imr_torch.float64 import rand, randn, tensor
from imr_torch.material import Belief
from imr_torch.observe import Experiment, ExperimentBatch, SimulatedLaboratory
from imr_torch.random import child, generator
from imr_torch.select import evidences, update
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread

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
            It is then integrated out, as in a characterisation.
        attempts: gels drawn, at most, until one can be simulated.

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
    attempts: int = 50


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
        probabilities: of all models after the data.
        verdict: on the Gaussian answer of the true model.
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
    probabilities: dict[str, float] = field(default_factory=dict)
    verdict: str = ""
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
    learn = arrangement.learn or partial(ExperimentBatch, noise=arrangement.plan.noise)
    for number in numbers:
        own = child(seed, "replicate", number)
        truth = _draw_truth(arrangement, own, simulator)
        started = time.process_time()
        answers: dict[str, Any]
        try:
            batch = learn(truth.experiments)
            answers = (
                _infer_replicate(arrangement, truth, batch, own, simulator)
                if infer is None
                else _rank_draws(arrangement, truth, batch, own, infer)
            )
        except ConvergenceError as error:
            answers = {"failure": str(error)}
        seconds = time.process_time() - started
        yield Replicate(
            number, truth.model, redrawn=truth.redrawn, seconds=seconds, **answers
        )


@dataclass(frozen=True)
class Truth:
    """A gel: its model, its coordinates whitened by the prior, and what was measured of it."""

    model: str
    gel: Tensor
    experiments: tuple[Experiment, ...]
    redrawn: int


def _rank_draws(
    arrangement: Arrangement, truth: Truth, batch: ExperimentBatch, seed: int, infer: Infer
) -> dict[str, Any]:
    """Where the truth lies among the draws of a function."""
    part = arrangement.prior[truth.model]
    draws = infer(batch, truth.model, child(seed, "infer"))
    if draws.ndim != 2 or draws.shape[1] != len(part.names) or not draws.isfinite().all():
        raise ShapeError(
            f"infer returned draws of shape {tuple(draws.shape)} for {truth.model}; expected n x "
            f"{len(part.names)} finite "
            f"numbers in the order {', '.join(part.names)}, SI."
        )
    uniforms = rand(len(part.names), generator=generator(child(seed, "lots")))
    below = (draws < part.physical(part.unwhitened(truth.gel))).double().sum(0)
    places = (below + uniforms) / (len(draws) + 1.0)
    return {
        "reported": dict(zip(part.names, places.tolist(), strict=True)),
        "converged": True,
    }


def _infer_replicate(
    arrangement: Arrangement,
    truth: Truth,
    batch: ExperimentBatch,
    seed: int,
    simulator: Simulator,
) -> dict[str, Any]:
    """What a replicate says of the toolkit's own inference on one gel."""
    fitted = assimilate_estimating_noise(
        arrangement.prior,
        batch,
        simulator,
        rounds=arrangement.noise_rounds,
        seed=child(seed, "fit"),
        options=arrangement.options,
        warn=False,
    )
    noise = noise_nodes(fitted, simulator) if arrangement.noise_rounds > 0 else None
    result = weigh(
        fitted,
        simulator,
        seed=child(seed, "weigh"),
        samples=arrangement.samples,
        noise=noise,
    )
    fit = result[truth.model]
    reported = fit.posterior
    uniforms = rand(len(truth.gel), generator=generator(child(seed, "lots")))
    z = (truth.gel - fit.mean) / torch.linalg.norm(fit.chol, dim=1)
    away = fit.prior.unwhitened(truth.gel) - reported.mean
    z_reported = away / torch.linalg.norm(reported.chol, dim=1)
    sample = fit.sample
    assert sample is not None
    # the truth counts as one more effective draw, of whose weight a uniform part is below
    count = sample.effective_samples
    below = sample.weights @ (sample.controls < truth.gel).double()
    places = (count * below + uniforms) / (count + 1.0)

    def by_name(values: Tensor) -> dict[str, float]:
        return dict(zip(fit.prior.names, values.tolist(), strict=True))

    return {
        "gaussian": by_name(torch.special.ndtr(z)),
        "weighted": by_name(places),
        "reported": by_name(torch.special.ndtr(z_reported)),
        "probabilities": update(result, evidences(result)).probabilities,
        "verdict": fit.verdict.value,
        "converged": result.converged,
    }


def _draw_truth(arrangement: Arrangement, seed: int, simulator: Simulator) -> Truth:
    """A gel of the prior that can be simulated, and its experiments, cut to the window."""
    prior = arrangement.prior
    plan = arrangement.plan
    chosen = torch.multinomial(
        prior.log_probabilities.exp(), 1, generator=generator(child(seed, "model"))
    )
    part = prior.models[int(chosen)]
    for attempt in range(arrangement.attempts):
        gel = randn(len(part.names), generator=generator(child(seed, "gel", attempt)))
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
                laboratory.shoot(
                    tensor(design), seed=child(seed, "shoot", *filter(None, [number]))
                )
                for number, design in enumerate(arrangement.designs)
            ]
        except ConvergenceError:
            continue
        return Truth(part.model, gel, tuple(map(plan.cut_to_window, shots)), attempt)
    raise ConvergenceError(
        f"None of {arrangement.attempts} gels of the prior of {part.model!r} could be simulated at "
        f"{arrangement.designs}."
    )
