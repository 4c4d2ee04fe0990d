"""Importance sampling of each fit's posterior: checks the Gaussian approximation, and corrects its
moments where it fails.

Each fit's Gaussian, with heavier tails, proposes draws that are weighted by the exact posterior.
Nuisances are integrated out for each draw and each experiment by importance sampling from their
conditional Gaussian, with slightly heavier tails, in opposite pairs, which cancels its skewness; the
product over experiments is without bias (pseudo-marginal: Andrieu & Roberts, Ann. Stat. 37, 2009).
That Gaussian is the fit's, moved linearly with the gel, in a first round whose nuisances follow the
gel so, else each draw's own. Where the cost of an experiment has further basins that are nearly as
deep (:mod:`~imr_torch.assimilate.basins`), each has its Gaussian, and their mixture is the proposal.
A model whose Gaussian is not confirmed, or whose nuisances do not follow, gets a round about the
ridge that its posterior lies on (:mod:`~imr_torch.assimilate.ridge`), then with proposals made from
all its weighted draws, until one is reliable and repeats the last.

Where a draw has a lower cost than the minimum, the model is fitted again from there. Another mode
far from all draws is not detected here, but by disagreement of the starts in the fit's certificate.

Repeated fits of models for which a posterior draw has a lower cost than the fitted minimum.

Starts that agree do not exclude another, lower minimum: where frames lie next to a collapse, the
nuisances of one experiment may have a second minimum that no start came near. Posterior draws,
whose nuisances are fitted anew for each gel, may find it. The weights of draws only suggest it,
since they depend on a few draws of the nuisances; decisive is the cost of the most probable draws,
at their own most probable nuisances.
"""

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from imr_torch.assimilate.basins import other_basins
from imr_torch.assimilate.fit import Assimilation, ModelFit, Verdict
from imr_torch.assimilate.forward import Point
from imr_torch.assimilate.importance import ImportanceSample, NoiseSample
from imr_torch.assimilate.map_fit import assimilate_model
from imr_torch.assimilate.noise_law import NoiseNodes
from imr_torch.assimilate.options import SearchOptions, WeighingOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.proposals import (
    Kernels,
    mixture_log_prob,
    student_draws,
    student_log_prob,
)
from imr_torch.assimilate.ridge import trace_ridge
from imr_torch.assimilate.starts import draw_perturbation
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.float64 import zeros
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import DrawnControls, Progress, ProgressLine


def lower_point(
    fit: ModelFit, best: float, posterior: Posterior, options: WeighingOptions
) -> Point | None:
    """The lowest of the most probable draws if its cost is below the fit's own minimum.

    Args:
        fit: a model with its draws.
        best: the lowest cost of all models, nats; a model that is far behind is left out.
        posterior: of the model; bubbles are made only where the weights suggest another minimum.
        options: by how much, and how many draws are looked at.
    """
    assert fit.sample is not None
    log_target = fit.sample.as_fitted.log_target
    # of the optimum, whose nuisances its Gaussian integrates out
    at_optimum = (
        -fit.cost - 0.5 * fit.nuisance_log_det - 0.5 * len(fit.mean) * math.log(2.0 * math.pi)
    )
    if fit.far_behind(best) or float(log_target.max()) - at_optimum <= options.lower_draw:
        return None
    likeliest = log_target.argsort(descending=True)[: options.likeliest]
    point = Point(fit.sample.controls[likeliest], fit.sample.nuisances[likeliest])
    for _ in range(options.nuisance_steps if len(posterior.uncertain) else 0):
        point = Point(point.gel, posterior.fit_nuisances(point)[0])
    highest = posterior.log_joint(point).max(0)
    return (
        point[highest.indices]
        if -float(highest.values) < fit.cost - options.lower_minimum
        else None
    )


def lower_minimum(
    fit: ModelFit,
    point: Point,
    posterior: Posterior,
    options: WeighingOptions,
    *,
    seed: int,
    progress: Progress = None,
) -> ModelFit | None:
    """Fit a model again from a point below its minimum.

    Args:
        fit: the model; not changed.
        point: see :func:`lower_point`.
        posterior: of the model.
        options: how far off the second start is, and how much lower a minimum must be.
        seed: of the second start.
        progress: called with one line per iteration, and one for a lower minimum.

    Returns:
        The fit without draws if its minimum is lower, else None.
    """
    second = draw_perturbation(
        fit.chol, generator(child(seed, "lower", fit.model)), options.restart
    )
    moves = torch.stack((torch.zeros_like(second), second))
    nuisances = point.nuisances + (fit.nuisance_response @ moves[:, None, :, None])[..., 0]
    found = assimilate_model(
        posterior,
        Point(point.gel + moves, nuisances),
        seed=seed,
        options=SearchOptions(starts=2),
        progress=progress,
    )
    if found.cost >= fit.cost - options.lower_minimum:
        return None
    if progress:
        progress(
            f"{fit.model}: draws found a minimum that is {fit.cost - found.cost:.1f} nats lower"
        )
    return found


@dataclass(frozen=True)
class _Draws:
    """Draws of one model in one round.

    Args:
        controls: ``n x d`` tensor.
        nuisances: ``n x K x E x w`` tensor: opposite pairs, or (``K = 1``) all zero where none is
            uncertain.
        log_ratio: ``n x K x E`` tensor, log of prior over proposal of the nuisances.
    """

    controls: Tensor
    nuisances: Tensor
    log_ratio: Tensor

    def average_likelihood(self, likelihood: Tensor) -> Tensor:
        """Logarithm of the mean over the nuisances of each draw of the likelihood: ``... x n x K x
        E`` to ``... x n x E``.
        """
        total = torch.logsumexp(likelihood + self.log_ratio, dim=-2)
        return total - math.log(likelihood.shape[-2])

    def keep_nuisances(self, likelihood: Tensor, source: torch.Generator) -> Tensor:
        """One of the nuisances of each draw and experiment, in proportion to its part of the
        likelihood (``n x K x E``).
        """
        chosen = _pick_columns((likelihood + self.log_ratio).mT.flatten(0, 1), source)
        chosen = chosen.reshape(len(likelihood), 1, -1, 1)
        width = self.nuisances.shape[-1]
        return self.nuisances.gather(1, chosen.expand(-1, -1, -1, width))[:, 0]


@dataclass(frozen=True)
class _Place:
    """Basins of the nuisances of some experiments.

    Args:
        rows: which experiments.
        fit: the fit of the model there, of these experiments.
        posterior: of the same.
    """

    rows: Tensor
    fit: ModelFit
    posterior: Posterior


@dataclass
class _State:
    """The state of one model between rounds: the fit with the draws of its last round, and those
    before.

    Args:
        fit: the fit.
        posterior: of its model.
        refits: times that it was made again, or tried to be.
        proposals: of each round since.
        parts: draws of each round since.
        drawn: rounds in all.
        bent: whether the nuisances do not follow the gel linearly.
        places: where nuisances are proposed, the fit's own basins first.
    """

    fit: ModelFit
    posterior: Posterior
    refits: int = 0
    proposals: list[Kernels] = field(default_factory=list)
    parts: list[ImportanceSample] = field(default_factory=list)
    drawn: int = 0
    bent: bool = False
    places: "list[_Place]" = field(default_factory=list)

    def needs_round(self, options: WeighingOptions) -> bool:
        """Whether the draws so far do not give reliable moments, and more of them may."""
        sample = self.fit.sample
        assert sample is not None
        hopeless = len(self.parts) > 2 and sample.effective_samples < options.hopeless * len(sample)
        return self.fit.verdict is Verdict.REFUSED and not hopeless


@one_torch_thread()
def weigh(
    assimilation: Assimilation,
    simulator: Simulator,
    *,
    seed: int,
    samples: int = 256,
    rounds: int = 4,
    drop_behind: float | None = None,
    options: WeighingOptions | None = None,
    noise: NoiseNodes | None = None,
    progress: Progress = None,
) -> Assimilation:
    """Weigh draws about every fit by the exact posterior.

    Args:
        assimilation: the fits; not changed.
        simulator: the simulator they were made with.
        seed: of the draws.
        samples: draws per model in the first two rounds, each one simulation per experiment (two
            where nuisances are uncertain). Every later round has twice as many as the one before,
            so that chance alone does not lead to refusal; but where nuisances are uncertain the
            third has as many, and where the weights of the second were not reliable it has more
            nuisances of each (``nuisance_pairs``), placed by its own sensitivities. A model that
            ``drop_behind`` leaves one round has a quarter.
        rounds: most rounds; a model stops when the weights are reliable and their moments those
            that the proposal was made for, which after the first round are those of the fit's
            Gaussian.
        drop_behind: a model gets one round only if its optimum is worse than the best one's by more
            than this, nats, or if its evidence is, by reliable weights.
        options: when a model is fitted again from a draw below its minimum, and how draws are
            made.
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
    options = options or WeighingOptions()
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
    states = [
        _State(replace(fit, sample=None), Posterior(fit.prior, batch, simulator))
        for fit in assimilation.fits
    ]
    waiting = states
    number = 0
    while waiting:
        number += 1
        ahead = _models_ahead([state.fit for state in states], drop_behind)
        for state in waiting:
            state.proposals.append(_make_proposal(state, seed, options))
            share = 1.0 if state.fit.model in ahead else options.behind_share
            draws = _draw_round(state, max(25, int(share * samples)), seed, options)
            source = generator(child(seed, "kept", state.fit.model, state.drawn))
            sample = _weigh_draws(state, draws, noise, source)
            state.parts.append(sample)
            state.drawn += 1
            state.fit = replace(state.fit, sample=sample)
        if progress:
            trusts = ", ".join(f"{c.fit.model} {c.fit.trust}" for c in waiting)
            step = f"round {number}"
            progress(ProgressLine(f"draws: {step}, {trusts}", step=step))
        _fit_again(waiting, states, options, child(seed, "refit", number), progress)
        ahead = _models_ahead([state.fit for state in states], drop_behind)
        waiting = [
            c
            for c in waiting
            if not c.parts
            or (c.needs_round(options) and len(c.parts) < rounds and c.fit.model in ahead)
        ]
    return replace(assimilation, fits=tuple(state.fit for state in states))


def _fit_again(
    drawn: list[_State],
    states: list[_State],
    options: WeighingOptions,
    seed: int,
    progress: Progress,
) -> None:
    """Replace fits by fits to lower minima that draws of the last round found."""
    best = min(state.fit.cost for state in states)
    for state in drawn:
        if state.refits >= options.refits:
            continue
        point = lower_point(state.fit, best, state.posterior, options)
        if point is None:
            continue
        state.refits += 1
        lower = lower_minimum(
            state.fit, point, state.posterior, options, seed=seed, progress=progress
        )
        if lower is not None:
            state.fit = lower
            state.proposals = []
            state.parts = []
            state.places = []


def _make_proposal(state: _State, seed: int, options: WeighingOptions) -> Kernels:
    """The proposal of the next round: the fit's Gaussian where nuisances follow it, then its ridge,
    then one from all draws so far. Reliable draws say which moments the ridge is to find.
    """
    fit = state.fit
    if not state.parts:
        gaussian = Kernels.about_mean(fit.mean, fit.chol)
        source = generator(child(seed, "bent", fit.model, state.drawn))
        state.bent = _is_bent(state, gaussian.draw_points(options.placed, source), options)
        return trace_ridge(fit, state.posterior) if state.bent else gaussian
    if len(state.parts) == 1 and not state.bent:
        ridge = trace_ridge(fit, state.posterior)
        (first,) = state.parts
        if not first.reliable:
            return ridge
        chol = torch.linalg.cholesky(first.covariance)
        return replace(ridge, mean=first.mean, chol=chol, effective=first.effective_samples)
    controls = torch.cat([part.controls for part in state.parts])
    target = torch.cat([part.log_target for part in state.parts])
    counts = [len(part) for part in state.parts]
    return Kernels.through_draws(
        controls, target - mixture_log_prob(state.proposals, counts, controls)
    )


def _is_bent(state: _State, controls: DrawnControls, options: WeighingOptions) -> bool:
    """Whether draws of the fit's Gaussian lose much (median) where their nuisances are moved
    linearly with the gel.
    """
    if not bool((state.posterior.batch.nuisance_sds > 0.0).any()):
        return False
    linear = Point(controls, state.fit.nuisances_at(controls))
    placed, chol = state.posterior.fit_nuisances(linear, beside=state.fit.point)
    missed = chol.mT @ (placed - linear.nuisances)[..., None]
    return 0.5 * float(missed.square().sum((1, 2, 3)).nanmedian()) > options.lost


def _models_ahead(fits: list[ModelFit], drop_behind: float | None) -> set[str]:
    """Models that get further rounds: those not far behind the best, neither by cost nor by
    evidence.
    """
    if drop_behind is None:
        return {fit.model for fit in fits}
    evidence = {
        fit.model: fit.sample.log_evidence
        for fit in fits
        if fit.sample is not None and fit.sample.reliable
    }
    best = min(fit.cost for fit in fits)
    most = max(evidence.values(), default=-math.inf)
    near = {fit.model for fit in fits if fit.cost <= best + drop_behind}
    return near - {model for model, value in evidence.items() if value < most - drop_behind}


def _draw_round(state: _State, samples: int, seed: int, options: WeighingOptions) -> _Draws:
    """Draws of the gel, and of the nuisances given the gel.

    Those are placed anew for each gel but in a first round where they follow it linearly.
    """
    fit = state.fit
    number = len(state.parts)
    uncertain = state.posterior.batch.nuisance_sds > 0.0
    sure = not bool(uncertain.any())
    samples *= 2 ** max(0, number - (1 if sure else 2))
    source = generator(child(seed, "weigh", fit.model, state.drawn))
    controls = state.proposals[-1].draw_points(samples, source)
    state.places = state.places or _find_places(state, options)
    if sure:
        still = zeros(samples, 1, *uncertain.shape)
        return _Draws(controls, still, still[..., 0])
    is_placed = number > 0 or state.bent
    freedom = round(options.nuisance_freedom * (math.sqrt(len(uncertain)) if is_placed else 1.0))
    careful = number > 1 and fit.sample is not None and not fit.sample.reliable
    pairs = options.nuisance_pairs if careful else 1
    half = student_draws((samples, len(state.places) * pairs, *uncertain.shape), freedom, source)
    parts = list[tuple[Tensor, ...]]()  # nuisances, where they are proposed, factors of the Hessian
    for place, some in zip(state.places, half.split(pairs, dim=1), strict=True):
        noise = (torch.cat((some, -some), dim=1) * uncertain)[:, :, place.rows]
        centre = place.fit.nuisances_at(controls)
        chol = place.fit.nuisance_chol.expand(samples, -1, -1, -1)
        if is_placed:
            beside = None if careful else place.fit.point
            centre, chol = place.posterior.fit_nuisances(Point(controls, centre), beside=beside)
        deviation = torch.linalg.solve_triangular(chol.mT[:, None], noise[..., None], upper=True)
        own = (centre[:, None] + deviation[..., 0], centre[:, None], chol[:, None])
        if parts:  # of the other experiments, the same once more
            replaced = zip(parts[0], own, strict=True)
            own = tuple(every.index_copy(2, place.rows, some) for every, some in replaced)
        parts.append(own)
    nuisances = torch.cat([own[0] for own in parts], 1)
    log_proposal = torch.stack(
        [
            student_log_prob(
                ((chol.mT @ (nuisances - centre)[..., None])[..., 0] * uncertain).square().sum(-1),
                uncertain.sum(1),
                freedom,
            )
            + torch.where(uncertain, chol.diagonal(dim1=-2, dim2=-1), 1.0).log().sum(-1)
            for _, centre, chol in parts
        ]
    ).logsumexp(0) - math.log(len(parts))
    log_prior = torch.where(uncertain, _standard_log_prob(nuisances), 0.0).sum(-1)
    return _Draws(controls, nuisances, log_prior - log_proposal)


def _find_places(state: _State, options: WeighingOptions) -> list[_Place]:
    """The fit, and the fit with other nuisances of single experiments that have further basins."""
    fit = state.fit
    places = [_Place(torch.arange(len(fit.nuisances)), fit, state.posterior)]
    for nuisances in other_basins(fit, state.posterior, within=options.further):
        rows = torch.nonzero((nuisances != fit.nuisances).any(1))[:, 0]
        posterior = state.posterior.of_experiments(rows)
        point = Point(fit.mean, nuisances[rows])
        equations = posterior.neighbourhood(point).equations
        there = replace(
            fit,
            nuisances=point.nuisances,
            nuisance_response=equations.reduced.nuisance_response,
            nuisance_chol=torch.linalg.cholesky(equations.nuisance_hessian),
        )
        places.append(_Place(rows, there, posterior))
    return places


def _predict_draws(state: _State, draws: _Draws) -> Tensor:
    """``n x K x E x T`` tensor; bubbles that nuisances of one basin have in common are made once."""
    count = draws.nuisances.shape[1] // len(state.places)
    controls = draws.controls.repeat_interleave(count, 0)
    parts = list[Tensor]()
    for place, nuisances in zip(state.places, draws.nuisances.split(count, dim=1), strict=True):
        own = nuisances[:, :, place.rows]
        seen = place.posterior.predict(Point(controls, own.flatten(0, 1)))
        seen = seen.unflatten(0, own.shape[:2])
        if parts:
            longer = parts[0].shape[-1] - seen.shape[-1]
            seen = torch.nn.functional.pad(seen, (0, longer))
            seen = parts[0].index_copy(2, place.rows, seen)
        parts.append(seen)
    return torch.cat(parts, 1)


def _standard_log_prob(values: Tensor) -> Tensor:
    """Log density of the standard normal, of each value."""
    return -0.5 * (values.square() + math.log(2.0 * math.pi))


def _weigh_draws(
    state: _State, draws: _Draws, noise: NoiseNodes | None, source: torch.Generator
) -> ImportanceSample:
    """The draws of a model with their likelihoods."""
    batch = state.posterior.batch
    prediction = _predict_draws(state, draws)
    likelihood = batch.log_likelihood(prediction)
    by_experiment = draws.average_likelihood(likelihood)
    under_laws = None
    if noise is not None:
        parts = [
            draws.average_likelihood(noise.log_likelihood(batch, prediction, law))
            for law in range(len(noise.laws))
        ]
        by_law = torch.cat(parts).movedim(0, 1)  # n x M x E
        drawn = _pick_columns(by_law.sum(2) + noise.log_prior.flatten(), source)
        laws, scales = drawn // noise.scales, drawn % noise.scales
        for law in laws.unique().tolist():
            rows = torch.nonzero(laws == law)[:, 0]
            at_scales = noise.log_likelihood(batch, prediction[rows], law)
            likelihood[rows] = at_scales[scales[rows], torch.arange(len(rows))]
        under_laws = NoiseSample(noise, by_law, drawn)
    proposal = state.proposals[-1]
    before = state.fit.sample
    sample = ImportanceSample(
        controls=draws.controls,
        log_prior=_standard_log_prob(draws.controls).sum(1),
        by_experiment=by_experiment,
        log_proposal=proposal.log_prob(draws.controls),
        nuisances=draws.keep_nuisances(likelihood, source),
        centre=proposal.mean,
        spread=proposal.chol,
        behind=proposal.effective,
        first_shape=math.nan if before is None else before.first_shape,
        rounds=1 if before is None else before.rounds + 1,
        precisions=proposal.precisions_at(draws.controls),
        noise=under_laws,
    )
    if sample.failed == len(sample):
        raise ConvergenceError(
            f"{state.fit.model}: none of {len(sample)} draws could be simulated; its fit is not "
            "usable."
        )
    return sample if before is not None else replace(sample, first_shape=sample.pareto_k)


def _pick_columns(log_weights: Tensor, source: torch.Generator) -> Tensor:
    """One column of each row, in proportion to its weight: ``n`` integers."""
    shares = torch.softmax(log_weights.nan_to_num(neginf=-1e300), 1)
    return torch.multinomial(shares, 1, generator=source)[:, 0]
