"""Importance sampling of each fit's posterior: checks the Gaussian approximation, and corrects its
moments where it fails.

Each fit's Gaussian, with heavier tails, proposes draws that are weighted by the exact posterior.
Nuisances are integrated out for each draw and each experiment by importance sampling from their
conditional Gaussian, with heavier tails too, in opposite pairs, which cancels its skewness; the
product over experiments is without bias (pseudo-marginal: Andrieu & Roberts, Ann. Stat. 37, 2009).
That Gaussian is at first the fit's, moved linearly with the gel, and after the first round each
draw's own. A model whose Gaussian is not confirmed gets another round about the ridge that its
posterior lies on (:mod:`~imr_torch.assimilate.ridge`), then with proposals made from all its
weighted draws, until one is reliable.

Where a draw has a lower cost than the minimum, the model is fitted again from there
(:mod:`~imr_torch.assimilate.lower`). Another mode far from all draws is not detected here, but by
disagreement of the starts in the fit's certificate.
"""

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from imr_torch.assimilate.conditional import conditional_nuisances
from imr_torch.assimilate.fit import Assimilation, ModelFit, Verdict
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.importance import ImportanceSample, NoiseSample, smooth
from imr_torch.assimilate.lower import lower_minima, lower_point
from imr_torch.assimilate.noise_posterior import NoiseMixture, NoiseNodes
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.proposals import (
    Kernels,
    mixture_log_prob,
    student_draws,
    student_log_prob,
)
from imr_torch.assimilate.ridge import trace_ridge
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.observe import ExperimentBatch
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress

_REFITS = 4  # times that a model is fitted again, at most
# of nuisances for each draw from the third round on, where more than half of the effective draws
# were lost
_PAIRS = 4
_FEWER = 4  # a model far behind gets one draw in so many
_FREEDOM = 15
"""Degrees of freedom of what proposes nuisances: heavier tails than a Gaussian's, which costs 3 % of the draws an experiment
where the posterior is one. Of 17 models of real files 3 were refused by a Gaussian, 1 by these (or 7, at 8 % an experiment)."""


@dataclass(frozen=True)
class _Draws:
    """Draws of one model in one round.

    Args:
        controls: ``n x d`` tensor.
        nuisances: ``n x K x E x 3`` tensor: opposite pairs, or (``K = 1``) all zero where none is
            uncertain.
        log_ratio: ``n x K x E`` tensor, log of prior over proposal of the nuisances.
        uniforms: ``n x (E + 1)`` tensor of uniform random numbers, by which one of the nuisances of
            each is kept, and (the last) one noise law.
    """

    controls: Tensor
    nuisances: Tensor
    log_ratio: Tensor
    uniforms: Tensor


@dataclass(frozen=True)
class _Round:
    """Draws that were simulated; fields as in :class:`ImportanceSample`."""

    controls: Tensor
    by_experiment: Tensor
    nuisances: Tensor
    noise: NoiseSample | None = None

    @property
    def likelihood(self) -> Tensor:
        """``n`` tensor, log likelihood of all experiments, the noise integrated out where it is
        uncertain.
        """
        return self.by_experiment.sum(1) if self.noise is None else self.noise.log_likelihood

    @property
    def log_prior(self) -> Tensor:
        """``n`` tensor, log density under the prior."""
        return _standard_log_prob(self.controls).sum(1)


@dataclass
class _State:
    """The state of one model between rounds: the fit with the draws of its last round, and those
    before.

    Args:
        fit: the fit.
        mixture: its moments over all noise laws; None where the noise is known, or not yet made.
        refits: times that it was made again, or tried to be.
        proposals: of each round since.
        parts: draws of each round since.
        drawn: rounds in all.
    """

    fit: ModelFit
    mixture: NoiseMixture | None = None
    refits: int = 0
    proposals: list[Kernels] = field(default_factory=list)
    parts: list[_Round] = field(default_factory=list)
    drawn: int = 0

    @property
    def about(self) -> ModelFit:
        """The fit, with the moments of its posterior over all noise laws where these are uncertain."""
        return self.fit if self.mixture is None else replace(self.fit, **vars(self.mixture))

    @property
    def refused(self) -> bool:
        """Whether the draws so far do not give reliable moments."""
        return self.fit.verdict is Verdict.REFUSED


@one_torch_thread()
def weigh(
    assimilation: Assimilation,
    simulator: Simulator,
    *,
    seed: int,
    samples: int = 256,
    rounds: int = 4,
    drop_behind: float | None = None,
    refit: bool = True,
    noise: NoiseNodes | None = None,
    progress: Progress | None = None,
) -> Assimilation:
    """Weigh draws about every fit by the exact posterior.

    Args:
        assimilation: the fits; not changed.
        simulator: the simulator they were made with.
        seed: of the draws.
        samples: draws per model in the first two rounds, each one simulation per experiment (two
            where nuisances are uncertain). Every later round has twice as many as the one before,
            so that chance alone does not lead to refusal; but where nuisances are uncertain the
            third has as many, with four times the nuisances of each where the second round was
            worth less than half of its draws. Of a model that ``drop_behind`` leaves one round, a
            quarter.
        rounds: most rounds; a model stops when the weights are reliable and their moments those
            that the proposal was made for, which after the first round are those of the fit's
            Gaussian.
        drop_behind: a model gets one round only if its optimum is worse than the best one's by more
            than this, nats, or if its evidence is, by reliable weights.
        refit: whether a model of which a draw has a lower cost than its minimum is fitted again
            from there, and weighted anew.
        noise: laws of the noise, which is then integrated out: the likelihood of each draw is
            summed over them (:class:`imr_torch.assimilate.NoiseNodes`). The law of the batch is
            taken as known when not given.
        progress: called with one line per round.

    Returns:
        The assimilation with a ``sample`` in each fit, from which evidence, moments and verdict
        follow.

    Raises:
        InputDataError: for fewer than 25 samples, no round, or ``noise`` beside collapse times.
        ConvergenceError: if no draw of some model could be simulated.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions, assimilate, weigh
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=5)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=1)
    >>> options = SearchOptions(raw_samples=16, starts=2)
    >>> fits = assimilate(case.prior, ExperimentBatch((shot,)), simulator, seed=0, options=options)
    >>> weighted = weigh(fits, simulator, seed=0, samples=64)
    >>> weighted["nhkv"].verdict.value
    'trusted'
    """
    if samples < 25 or rounds < 1:
        raise InputDataError(
            f"weigh: samples {samples} must be at least 25, and rounds {rounds} at least 1."
        )
    batch = assimilation.batch
    if noise is not None and bool(batch.collapse.any()):
        raise InputDataError(
            "weigh was given noise laws to integrate over, and the data hold collapse times, "
            "which have an error of their own; "
            "leave noise out."
        )
    states = [_State(replace(fit, sample=None)) for fit in assimilation.fits]
    waiting = states
    number = 0
    while waiting:
        number += 1
        ahead = _ahead([state.fit for state in states], drop_behind)
        for state in waiting:
            if noise is not None and state.mixture is None:
                state.mixture = noise.mixture(state.fit.linearise(batch, simulator))
            state.proposals.append(_proposal(state, batch, simulator))
            some = samples if state.fit.model in ahead else max(25, samples // _FEWER)
            state.parts.append(
                _simulate(
                    state, _draw(state, batch, some, seed, simulator), batch, simulator, noise
                )
            )
            state.drawn += 1
            state.fit = _judge(state.fit, state.proposals[-1], state.parts[-1])
        if progress:
            progress(
                f"draws: round {number}, "
                + ", ".join(f"{c.fit.model} {c.fit.trust}" for c in waiting)
            )
        if refit:
            _fit_again(waiting, states, batch, simulator, child(seed, "refit", number), progress)
        ahead = _ahead([state.fit for state in states], drop_behind)
        waiting = [
            c
            for c in waiting
            if not c.parts or (c.refused and len(c.parts) < rounds and c.fit.model in ahead)
        ]
    return replace(assimilation, fits=tuple(state.fit for state in states))


def _fit_again(
    drawn: list[_State],
    states: list[_State],
    batch: ExperimentBatch,
    simulator: Simulator,
    seed: int,
    progress: Progress | None,
) -> None:
    """Replace fits by fits to lower minima that draws of the last round found."""
    best = min(state.fit.cost for state in states)
    possible = [state for state in drawn if state.refits < _REFITS]
    points = [lower_point(state.fit, best, batch, simulator) for state in possible]
    doubtful = [
        (state, point) for state, point in zip(possible, points, strict=True) if point is not None
    ]
    if not doubtful:
        return
    fits = [state.fit for state, _ in doubtful]
    lower = lower_minima(
        fits, [point for _, point in doubtful], batch, simulator, seed=seed, progress=progress
    )
    for state, _ in doubtful:
        state.refits += 1
        if state.fit.model in lower:
            state.fit = lower[state.fit.model]
            state.mixture = None
            state.proposals = []
            state.parts = []


def _proposal(state: _State, batch: ExperimentBatch, simulator: Simulator) -> Kernels:
    """The proposal of the next round: the fit's Gaussian, then its ridge, then one from all its
    draws so far.
    """
    if not state.parts:
        return Kernels.about(state.about.mean, state.about.chol)
    if len(state.parts) == 1:
        return trace_ridge(state.fit, batch, simulator)
    return _again(state.proposals, state.parts)


def _ahead(fits: list[ModelFit], drop_behind: float | None) -> set[str]:
    """Models that get further rounds: those not far behind the best, neither by cost nor by
    evidence.
    """
    if drop_behind is None:
        return {fit.model for fit in fits}
    samples = {
        fit.model: fit.sample for fit in fits if fit.sample is not None and fit.sample.reliable
    }
    evidence = {model: sample.log_evidence for model, sample in samples.items()}
    best = min(fit.cost for fit in fits)
    most = max(evidence.values(), default=-math.inf)
    near = {fit.model for fit in fits if fit.cost <= best + drop_behind}
    return near - {model for model, value in evidence.items() if value < most - drop_behind}


def _draw(
    state: _State, batch: ExperimentBatch, samples: int, seed: int, simulator: Simulator
) -> _Draws:
    """Draws of the gel, and of the nuisances given the gel.

    Those are placed anew for each gel after the first round.
    """
    fit = state.fit
    about = state.about
    number = len(state.parts)
    sure = not bool((batch.nuisance_sds > 0.0).any())
    samples *= 2 ** max(0, number - (1 if sure else 2))
    source = generator(child(seed, "weigh", fit.model, state.drawn))
    experiments = len(batch.experiments)
    controls = state.proposals[-1].draw(samples, source)
    uniforms = torch.rand(samples, experiments, generator=source, dtype=torch.float64)
    by_law = torch.rand(
        samples,
        1,
        generator=generator(child(seed, "laws", fit.model, state.drawn)),
        dtype=torch.float64,
    )
    uniforms = torch.cat((uniforms, by_law), 1)
    if sure:
        still = torch.zeros(samples, 1, *batch.nuisance_sds.shape, dtype=torch.float64)
        return _Draws(controls, still, still[..., 0], uniforms)
    uncertain = batch.nuisance_sds > 0.0
    last = fit.sample
    pairs = (
        1 if number < 2 or (last is not None and last.effective_samples > len(last) / 2) else _PAIRS
    )
    normal = torch.randn(samples, pairs, *uncertain.shape, generator=source, dtype=torch.float64)
    half = torch.where(uncertain, student_draws(normal.shape, _FREEDOM, source), normal)
    noise = torch.cat((half, -half), dim=1)
    centre = about.nuisances_at(controls)
    chol = about.nuisance_chol.expand(samples, -1, -1, -1)
    if number:
        posterior = Posterior(fit.prior, batch, simulator)
        fitted = fit.nuisance_chol
        centre, chol = conditional_nuisances(
            posterior, Point(controls, centre), fitted.expand(samples, -1, -1, -1)
        )
        chol = chol @ torch.linalg.solve_triangular(fitted, about.nuisance_chol, upper=False)
    deviation = torch.linalg.solve_triangular(chol.mT[:, None], noise[..., None], upper=True)[
        ..., 0
    ]
    nuisances = centre[:, None] + deviation
    log_prior = _standard_log_prob(nuisances).sum(-1)
    log_proposal = torch.where(uncertain, 0.0, _standard_log_prob(noise)).sum(-1)
    square = torch.where(uncertain, noise.square(), 0.0).sum(-1)
    log_proposal = log_proposal + student_log_prob(square, uncertain.sum(1), _FREEDOM)
    log_det = chol.diagonal(dim1=-2, dim2=-1).log().sum(-1)[:, None]
    return _Draws(controls, nuisances, log_prior - log_proposal - log_det, uniforms)


def _standard_log_prob(values: Tensor) -> Tensor:
    """Log density of the standard normal, of each value."""
    return -0.5 * (values.square() + math.log(2.0 * math.pi))


def _simulate(
    state: _State,
    draws: _Draws,
    batch: ExperimentBatch,
    simulator: Simulator,
    noise: NoiseNodes | None,
) -> _Round:
    """Likelihoods of the draws of a model."""
    count = draws.nuisances.shape[:2]
    point = Point(draws.controls.repeat_interleave(count[1], 0), draws.nuisances.flatten(0, 1))
    prediction = Posterior(state.fit.prior, batch, simulator).predict(point).unflatten(0, count)
    likelihood = batch.log_likelihood(prediction)
    by_experiment = _mean_over_nuisances(draws, likelihood)
    if noise is None or state.mixture is None:
        return _Round(draws.controls, by_experiment, _kept(draws, likelihood))
    parts = [
        _mean_over_nuisances(draws, noise.log_likelihood(batch, prediction, law))
        for law in range(len(noise.laws))
    ]
    by_law = torch.cat(parts).movedim(0, 1)  # n x M x E
    drawn = _drawn_laws(noise, by_law, draws.uniforms[:, -1])
    laws = drawn // noise.log_factors.shape[1]
    scales = drawn % noise.log_factors.shape[1]
    for law in laws.unique().tolist():
        rows = torch.nonzero(laws == law)[:, 0]
        likelihood[rows] = noise.log_likelihood(batch, prediction[rows], law)[
            scales[rows], torch.arange(len(rows))
        ]
    return _Round(
        draws.controls,
        by_experiment,
        _kept(draws, likelihood),
        NoiseSample(noise, state.mixture, by_law, drawn),
    )


def _mean_over_nuisances(draws: _Draws, likelihood: Tensor) -> Tensor:
    """Logarithm of the mean over the nuisances of each draw of the likelihood: ``... x n x K x E``
    to ``... x n x E``.
    """
    return torch.logsumexp(likelihood + draws.log_ratio, dim=-2) - math.log(likelihood.shape[-2])


def _kept(draws: _Draws, likelihood: Tensor) -> Tensor:
    """One of the nuisances of each draw and experiment, in proportion to its part of the likelihood
    (``n x K x E``).
    """
    weights = likelihood + draws.log_ratio
    experiments = likelihood.shape[2]
    share = torch.softmax(weights.flip(1).nan_to_num(neginf=-1e300), 1).cumsum(1)[:, :-1]
    kept = weights.shape[1] - 1 - (draws.uniforms[:, None, :experiments] >= share).sum(1)
    return draws.nuisances.gather(
        1, kept[:, None, :, None].expand(-1, 1, -1, draws.nuisances.shape[3])
    )[:, 0]


def _drawn_laws(nodes: NoiseNodes, by_law: Tensor, uniforms: Tensor) -> Tensor:
    """One noise law of each draw, in proportion to its part of the likelihood: ``n`` integers."""
    weights = (by_law.sum(2) + nodes.log_prior.flatten()).nan_to_num(neginf=-1e300)
    share = torch.softmax(weights, 1).cumsum(1)
    return torch.searchsorted(share, uniforms[:, None].contiguous())[:, 0].clamp_max(
        share.shape[1] - 1
    )


def _judge(fit: ModelFit, proposal: Kernels, part: _Round) -> ModelFit:
    """The fit with the draws of one round for its sample."""
    log_proposal = proposal.log_prob(part.controls)
    weighted = part.likelihood + part.log_prior - log_proposal
    if not bool(torch.isfinite(weighted).any()):
        raise ConvergenceError(
            f"{fit.model}: none of {len(weighted)} draws could be simulated; its fit is not usable."
        )
    first, rounds = (
        (smooth(weighted)[1], 1)
        if fit.sample is None
        else (fit.sample.first_shape, fit.sample.rounds + 1)
    )
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
        noise=part.noise,
    )
    return replace(fit, sample=sample)


def _again(proposals: list[Kernels], parts: list[_Round]) -> Kernels:
    """A proposal from all draws so far, weighted by the mixture of their proposals."""
    controls = torch.cat([part.controls for part in parts])
    target = torch.cat([part.likelihood + part.log_prior for part in parts])
    return Kernels.through(
        controls,
        target - mixture_log_prob(proposals, [len(part.controls) for part in parts], controls),
    )
