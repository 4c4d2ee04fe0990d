"""Importance sampling of each fit's posterior: checks the Gaussian approximation, and corrects its
moments where it fails.

Each fit's Gaussian, with heavier tails, proposes draws that are weighted by the exact posterior, the
nuisances of each integrated out (:mod:`~imr_torch.assimilate.nuisance_draws`). A model whose
Gaussian is not confirmed, or whose nuisances do not follow the gel linearly, gets a round about the
ridge that its posterior lies on (:mod:`~imr_torch.assimilate.ridge`), then with proposals made from
all its weighted draws, until one is reliable and repeats the last. Where a draw has a lower cost
than the minimum, the model is fitted again from there (:mod:`~imr_torch.assimilate.refit`).
"""

import math
from dataclasses import dataclass, field, replace

import torch

from imr_torch.assimilate.fit import Assimilation, ModelFit, Verdict
from imr_torch.assimilate.importance import (
    ImportanceSample,
    NoiseSample,
    largest_shape,
    smooth_tail,
)
from imr_torch.assimilate.noise_law import NoiseNodes
from imr_torch.assimilate.nuisance_draws import (
    NuisanceBasin,
    NuisanceDraws,
    Placement,
    draw_nuisances,
    find_nuisance_basins,
    pick_columns,
    standard_log_prob,
)
from imr_torch.assimilate.options import WeighingOptions
from imr_torch.assimilate.posterior import Posterior
from imr_torch.assimilate.proposals import Kernels, mixture_log_prob
from imr_torch.assimilate.refit import find_lower_draw, fit_lower_minimum
from imr_torch.assimilate.ridge import trace_ridge
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.random import child, generator
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import DrawnControls, Progress, report_progress


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
        basins: where nuisances are proposed, the fit's own basins first.
    """

    fit: ModelFit
    posterior: Posterior
    refits: int = 0
    proposals: list[Kernels] = field(default_factory=list)
    parts: list[ImportanceSample] = field(default_factory=list)
    drawn: int = 0
    bent: bool = False
    basins: list[NuisanceBasin] = field(default_factory=list)

    def needs_round(self, options: WeighingOptions, ahead: set[str], rounds: int) -> bool:
        """Whether the draws so far do not give reliable moments, and more of them may."""
        if not self.parts:
            return True
        sample = self.parts[-1]
        if len(self.parts) >= rounds or self.fit.model not in ahead:
            return False
        hopeless = len(
            self.parts
        ) > 2 and sample.effective_samples < options.hopeless * len(sample)
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
        progress: called with one line per model and round.

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
    if noise is not None and batch.collapse.any():
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
    drawn = 0.0
    report_progress(progress, "draws about each fit", stage="draws", part=0.0)
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
            drawn += _size_of_round(len(state.parts) - 1)
            if progress:
                model = state.fit.prior.material.title
                text = f"draws: {model}, round {number}, {state.fit.trust}"
                step = (
                    f"{model}, round {number} of at most {rounds}" if rounds > 1 else model
                )
                expected = drawn + sum(
                    _size_of_round(later)  # two more each, as far as they are allowed
                    for one in waiting
                    if one.needs_round(options, ahead, rounds)
                    for later in range(len(one.parts), min(len(one.parts) + 2, rounds))
                )
                part = drawn / expected
                size = expected / (min(2, rounds) * len(states))
                report_progress(progress, text, step=step, part=part, size=size)
        _fit_again(waiting, states, options, child(seed, "refit", number), progress)
        ahead = _models_ahead([state.fit for state in states], drop_behind)
        waiting = [state for state in waiting if state.needs_round(options, ahead, rounds)]
    return replace(assimilation, fits=tuple(state.fit for state in states))


def _size_of_round(number: int) -> float:
    """Draws of a model's round, the first of which is 0, over those of its first one."""
    return 2.0 ** max(0, number - 2)


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
        point = find_lower_draw(state.fit, best, state.posterior, options)
        if point is None:
            continue
        state.refits += 1
        lower = fit_lower_minimum(
            state.fit, point, state.posterior, options, seed=seed, progress=progress
        )
        if lower is not None:
            state.fit = lower
            state.proposals = []
            state.parts = []


def _make_proposal(state: _State, seed: int, options: WeighingOptions) -> Kernels:
    """The proposal of the next round: the fit's Gaussian where nuisances follow it, then its ridge,
    then one from all draws so far. Reliable draws say which moments the ridge is to find.
    """
    fit = state.fit
    if not state.parts:
        state.basins = find_nuisance_basins(fit, state.posterior, within=options.further)
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
    log_weights = target - mixture_log_prob(state.proposals, counts, controls)
    # the largest weights of a tail that is light enough are chance; those of a heavy one say that
    # the posterior reaches on where they lie
    smoothed, shape = smooth_tail(log_weights)
    if shape <= largest_shape(len(controls)):
        log_weights = smoothed
    return Kernels.through_draws(controls, log_weights)


def _is_bent(state: _State, controls: DrawnControls, options: WeighingOptions) -> bool:
    """Whether draws of the fit's Gaussian lose much (median) where their nuisances are moved
    linearly with the gel.
    """
    if not len(state.posterior.uncertain):
        return False
    placed, chol = state.basins[0].place_nuisances(controls, Placement.FITTED)
    missed = chol.mT @ (placed - state.fit.nuisances_at(controls))[..., None]
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


def _draw_round(
    state: _State, samples: int, seed: int, options: WeighingOptions
) -> NuisanceDraws:
    """Draws of the next round.

    Nuisances are placed anew for each gel but in a first round where they follow it linearly.
    """
    fit = state.fit
    number = len(state.parts)
    sure = not len(state.posterior.uncertain)
    samples *= 2 ** max(0, number - (1 if sure else 2))
    source = generator(child(seed, "weigh", fit.model, state.drawn))
    controls = state.proposals[-1].draw_points(samples, source)
    placement = Placement.FITTED if number > 0 or state.bent else Placement.MOVED
    if number > 1 and not state.parts[-1].reliable:
        placement = Placement.CAREFUL
    return draw_nuisances(controls, state.basins, placement, options, source)


def _weigh_draws(
    state: _State, draws: NuisanceDraws, noise: NoiseNodes | None, source: torch.Generator
) -> ImportanceSample:
    """The draws of a model with their likelihoods."""
    batch = state.posterior.batch
    prediction = draws.predict()
    likelihood = batch.log_likelihood(prediction)
    by_experiment = draws.average_likelihood(likelihood)
    under_laws = None
    if noise is not None:
        parts = [
            draws.average_likelihood(noise.log_likelihood(batch, prediction, law))
            for law in range(len(noise.laws))
        ]
        by_law = torch.cat(parts).movedim(0, 1)  # n x M x E
        drawn = pick_columns(by_law.sum(2) + noise.log_prior.flatten(), source)
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
        log_prior=standard_log_prob(draws.controls).sum(1),
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
