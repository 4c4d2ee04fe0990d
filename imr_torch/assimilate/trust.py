"""When the Gaussian answer is to be trusted, and what to believe where it is not.

Each fit's Gaussian, with heavier tails, proposes draws that are weighed by the exact posterior. Nuisances are integrated
out for each draw and each experiment by importance sampling from their conditional Gaussian, with heavier tails too, in
opposite pairs, which cancels its skewness; the product over experiments is without bias (pseudo-marginal: Andrieu & Roberts,
Ann. Stat. 37, 2009). That Gaussian is at first the fit's, moved linearly with the gel, and after the first round each draw's
own. Draws of all models are simulated in one call a round. A model whose Gaussian does not stand gets another round about the
ridge that its posterior lies on (:mod:`~imr_torch.assimilate.ridge`), then with proposals made from all its weighed draws,
until one stands.

A draw that comes upon a lower minimum has the fit made again from there (:mod:`~imr_torch.assimilate.lower`). Another mode far
from all draws stays unseen here; against that stands the agreement of the starts in the fit's certificate.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imr_torch.assimilate.conditional import conditional_nuisances, possible_nuisances
from imr_torch.assimilate.fit import Assimilation, ModelFit, Verdict
from imr_torch.assimilate.importance import ImportanceSample, smooth
from imr_torch.assimilate.lower import lower_minima
from imr_torch.assimilate.proposals import Kernels, mixture_log_prob, student_draws, student_log_prob
from imr_torch.assimilate.ridge import trace_ridges
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.observe import ExperimentBatch, predict
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.types import Progress

_FREEDOM = 15
"""Degrees of freedom of what proposes nuisances: heavier tails than a Gaussian's, which costs 3 % of the draws an experiment
where the posterior is one. Of 17 models of real files 3 were refused by a Gaussian, 1 by these (or 7, at 8 % an experiment)."""


@dataclass(frozen=True)
class _Draws:
    """Draws of one model in one round.

    Args:
        controls: ``n x d`` tensor.
        nuisances: ``n x K x E x 3`` tensor: opposite pairs, or (``K = 1``) all zero where none is uncertain.
        log_ratio: ``n x K x E`` tensor, log of prior over proposal of the nuisances.
        lots: ``n x E`` tensor of uniform numbers, by which one of each pair is kept.
    """

    controls: Tensor
    nuisances: Tensor
    log_ratio: Tensor
    lots: Tensor


@dataclass(frozen=True)
class _Round:
    """Draws that were simulated; fields as in :class:`ImportanceSample`."""

    controls: Tensor
    by_experiment: Tensor
    nuisances: Tensor

    @property
    def likelihood(self) -> Tensor:
        """``n`` tensor, log likelihood of all experiments."""
        return self.by_experiment.sum(1)

    @property
    def log_prior(self) -> Tensor:
        """``n`` tensor, log density under the prior."""
        return _standard_log_prob(self.controls).sum(1)


def weigh(
    assimilation: Assimilation,
    simulator: Simulator,
    *,
    seed: int,
    samples: int = 256,
    rounds: int = 4,
    hopeless: float | None = None,
    refit: bool = True,
    progress: Progress | None = None,
) -> Assimilation:
    """Weigh draws about every fit by the exact posterior.

    Args:
        assimilation: the fits; not changed.
        simulator: the simulator they were made with.
        seed: of the draws.
        samples: draws per model in the first two rounds, each one simulation per experiment (two where nuisances are
            uncertain); every later round has twice as many as the one before, so that chance alone cannot go on refusing.
        rounds: most rounds; a model stops when the weights are reliable and their moments those that the proposal was
            made for, which after the first round are those of the fit's Gaussian.
        hopeless: a model gets one round only if its optimum is worse than the best one's by more than this, nats, or if its
            evidence is, by weights that can be leant on.
        refit: whether a model of which a draw comes upon a lower minimum is fitted again from there, and weighed again.
        progress: called with one line per round.

    Returns:
        The assimilation with a ``sample`` in each fit, from which evidence, moments and verdict are taken.

    Raises:
        InputDataError: for fewer than 25 samples or no round.
        ConvergenceError: if no draw of some model could be simulated.
    """
    if samples < 25 or rounds < 1:
        raise InputDataError(f"weigh: samples {samples} must be at least 25, and rounds {rounds} at least 1.")
    fits, batch = tuple(replace(fit, sample=None) for fit in assimilation.fits), assimilation.batch
    proposals: dict[str, list[Kernels]] = {fit.model: [Kernels.about(fit.mean, fit.chol)] for fit in fits}
    parts: dict[str, list[_Round]] = {fit.model: [] for fit in fits}
    found = {fit.model: fit for fit in fits}
    waiting = list(fits)
    for number in range(rounds):
        count = samples * 2 ** max(0, number - 1)
        again = simulator if number else None
        draws = [_draw(f, batch, proposals[f.model][-1], count, child(seed, "weigh", f.model, number), again) for f in waiting]
        for fit, part in zip(waiting, _simulate(waiting, draws, batch, simulator), strict=True):
            parts[fit.model].append(part)
            found[fit.model] = _judge(found[fit.model], proposals[fit.model][-1], part)
        if progress:
            progress(f"draws: round {number + 1}, " + ", ".join(f"{f.model} {found[f.model].trust}" for f in waiting))
        ahead = _ahead(list(found.values()), hopeless)
        waiting = [fit for fit in waiting if found[fit.model].verdict is Verdict.REFUSED and fit.model in ahead]
        if not waiting or number == rounds - 1:
            break
        if number == 0:
            made = trace_ridges(waiting, batch, simulator)
        else:
            made = [_again(proposals[fit.model], parts[fit.model]) for fit in waiting]
        for fit, proposal in zip(waiting, made, strict=True):
            proposals[fit.model].append(proposal)
    weighed = replace(assimilation, fits=tuple(found[fit.model] for fit in fits))
    lower = lower_minima(weighed, simulator, seed=child(seed, "refit"), progress=progress) if refit else {}
    if not lower:
        return weighed
    again = weigh(
        replace(assimilation, fits=tuple(lower.values())),
        simulator,
        seed=child(seed, "again"),
        samples=samples,
        rounds=rounds,
        refit=False,
        progress=progress,
    )
    return replace(weighed, fits=tuple(again[fit.model] if fit.model in lower else fit for fit in weighed.fits))


def _ahead(fits: list[ModelFit], hopeless: float | None) -> set[str]:
    """Models that are worth further rounds: neither by optimum nor by evidence far behind the best."""
    if hopeless is None:
        return {fit.model for fit in fits}
    samples = {fit.model: fit.sample for fit in fits if fit.sample is not None and fit.sample.reliable}
    evidence = {model: sample.log_evidence for model, sample in samples.items()}
    best, most = min(fit.cost for fit in fits), max(evidence.values(), default=-math.inf)
    near = {fit.model for fit in fits if fit.cost <= best + hopeless}
    return near - {model for model, value in evidence.items() if value < most - hopeless}


def _draw(
    fit: ModelFit, batch: ExperimentBatch, proposal: Kernels, samples: int, seed: int, simulator: Simulator | None
) -> _Draws:
    """Draws of the gel, and of the nuisances given the gel; those are placed anew for each gel if there is a simulator."""
    source, experiments = generator(seed), len(batch.experiments)
    controls = proposal.draw(samples, source)
    lots = torch.rand(samples, experiments, generator=source, dtype=torch.float64)
    if not bool((batch.nuisance_sds > 0.0).any()):
        still = torch.zeros(samples, 1, experiments, 3, dtype=torch.float64)
        return _Draws(controls, still, still[..., 0], lots)
    uncertain = batch.nuisance_sds > 0.0
    normal = torch.randn(samples, 1, experiments, 3, generator=source, dtype=torch.float64)
    half = torch.where(uncertain, student_draws(normal.shape, _FREEDOM, source), normal)
    noise = torch.cat((half, -half), dim=1)
    centre, chol = fit.nuisances_at(controls), fit.nuisance_chol.expand(samples, -1, -1, -1)
    if simulator is not None:
        centre, chol = conditional_nuisances(fit.parameters(controls), centre, chol, batch, simulator)
    deviation = torch.linalg.solve_triangular(chol.mT[:, None], noise[..., None], upper=True)[..., 0]
    nuisances = centre[:, None] + deviation
    log_prior = _standard_log_prob(nuisances).sum(-1)
    log_proposal = torch.where(uncertain, 0.0, _standard_log_prob(noise)).sum(-1)
    square = torch.where(uncertain, noise.square(), 0.0).sum(-1)
    log_proposal = log_proposal + student_log_prob(square, uncertain.sum(1), _FREEDOM)
    log_det = chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)[:, None]
    return _Draws(controls, nuisances, log_prior - log_proposal - log_det, lots)


def _standard_log_prob(values: Tensor) -> Tensor:
    """Log density of the standard normal, of each value."""
    return -0.5 * (values.square() + math.log(2.0 * math.pi))


def _simulate(fits: list[ModelFit], draws: list[_Draws], batch: ExperimentBatch, simulator: Simulator) -> list[_Round]:
    """Likelihoods of the draws of all models, in one call of the simulator."""
    pairs = draws[0].nuisances.shape[1]
    parameters = torch.cat([fit.parameters(d.controls) for fit, d in zip(fits, draws, strict=True)])
    nuisances = torch.cat([d.nuisances for d in draws])
    possible = possible_nuisances(nuisances * batch.nuisance_sds, batch)
    shifts = torch.where(possible[..., None], nuisances * batch.nuisance_sds, 0.0) if pairs > 1 else None
    prediction = predict(simulator, parameters[:, None].expand(-1, pairs, -1), batch, shifts)
    likelihood = batch.log_likelihood(torch.where(batch.mask, prediction, 0.0))
    likelihood = torch.where(possible, likelihood, -torch.inf)
    rows = zip(draws, likelihood.split([len(d.controls) for d in draws]), strict=True)
    return [_integrate(d, values) for d, values in rows]


def _integrate(draws: _Draws, likelihood: Tensor) -> _Round:
    """Mean over each pair of nuisances of the likelihood (``n x K x E``), and one of the pair, in proportion to its part."""
    weights = likelihood + draws.log_ratio
    by_experiment = torch.logsumexp(weights, dim=1) - math.log(weights.shape[1])
    second = draws.lots < torch.sigmoid((weights[:, -1] - weights[:, 0]).nan_to_num(0.0))
    kept = torch.where(second[..., None], draws.nuisances[:, -1], draws.nuisances[:, 0])
    return _Round(draws.controls, by_experiment, kept)


def _judge(fit: ModelFit, proposal: Kernels, part: _Round) -> ModelFit:
    """The fit with the draws of one round for its sample."""
    log_proposal = proposal.log_prob(part.controls)
    weighed = part.likelihood + part.log_prior - log_proposal
    if not bool(torch.isfinite(weighed).any()):
        raise ConvergenceError(f"{fit.model}: none of {len(weighed)} draws could be simulated; its fit is not usable.")
    first, rounds = (smooth(weighed)[1], 1) if fit.sample is None else (fit.sample.first_shape, fit.sample.rounds + 1)
    sample = ImportanceSample(
        controls=part.controls,
        log_prior=part.log_prior,
        by_experiment=part.by_experiment,
        log_proposal=log_proposal,
        nuisances=part.nuisances,
        centre=proposal.mean,
        spread=proposal.chol,
        first_shape=first,
        rounds=rounds,
        precisions=proposal.precisions_at(part.controls),
    )
    return replace(fit, sample=sample)


def _again(proposals: list[Kernels], parts: list[_Round]) -> Kernels:
    """A proposal from all draws so far, weighed by the mixture of their proposals."""
    controls = torch.cat([part.controls for part in parts])
    target = torch.cat([part.likelihood + part.log_prior for part in parts])
    return Kernels.through(controls, target - mixture_log_prob(proposals, [len(part.controls) for part in parts], controls))
