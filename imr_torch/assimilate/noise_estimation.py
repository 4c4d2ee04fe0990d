"""Assimilation of measured curves with their noise inferred about the fits.

All models are fitted with the noise law as given; the noise of single frames is inferred about the
best model, beside any smooth misfit (:mod:`imr_torch.assimilate.frame_noise`); all models are
fitted again with it. Where a model misses the data, fits take all that they leave for independent,
and the last ones are widened for what the residuals have in common. Only residuals and
sensitivities of the earlier fits are used, so these end within a tenth of a nat of a minimum. What
the uncertainty of the law means for gel and evidence is left to :func:`imr_torch.assimilate.weigh`.
"""

from dataclasses import replace

import torch

from imr_torch.assimilate.en4dvar import assimilate_en4dvar
from imr_torch.assimilate.fit import Assimilation, ModelFit
from imr_torch.assimilate.frame_noise import FIRST_JITTER, infer_frame_noise
from imr_torch.assimilate.map_fit import assimilate
from imr_torch.assimilate.noise_grid import FrameNoisePrior
from imr_torch.assimilate.noise_law import NoiseNodes
from imr_torch.assimilate.options import En4DVarOptions, FitOptions, SearchOptions
from imr_torch.assimilate.spikes import without_spoilt_frames
from imr_torch.float64 import tensor
from imr_torch.material import Belief
from imr_torch.observe import CollapseTime, Experiment, ExperimentBatch
from imr_torch.observe.collapse import estimate_scatter
from imr_torch.observe.noise import FEWEST_RESIDUALS
from imr_torch.random import child
from imr_torch.simulate import Simulator
from imr_torch.threads import one_torch_thread
from imr_torch.types import Progress, report_progress

NOISE_ROUNDS = 2
"""How often the noise of measured curves is estimated: from fits with the given law, and from fits with the first estimate."""


@one_torch_thread()
def assimilate_estimating_noise(
    belief: Belief,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    rounds: int,
    seed: int,
    options: FitOptions | None = None,
    warn: bool = True,
    progress: Progress = None,
) -> Assimilation:
    """Fit all models, infer the noise about the best one, and fit again.

    Args:
        belief: prior; not changed.
        batch: the experiments; the first fits are made with their noise.
        simulator: makes the bubbles.
        rounds: how often the noise is estimated and the fits made again; with 0 it is as given.
        seed: of starts and ensembles.
        options: the method and its settings, :func:`assimilate` by default; tolerances are those of
            the last fits, others end at a gradient of .3 posterior standard deviations and where
            starts agree within a nat.
        warn: as for :func:`assimilate`, of the last fits.
        progress: called with one line per iteration.

    Returns:
        The last fits; their batch has the noise that they were made with.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions, assimilate_estimating_noise
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, Noise, SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), noise=Noise(scale=2.0), repeats=5)
    >>> shot, options = laboratory.shoot(torch.tensor([400.0, 0.22]).double(), seed=1), SearchOptions(raw_samples=16, starts=2)
    >>> fits = assimilate_estimating_noise(case.prior, ExperimentBatch((shot,)), simulator, rounds=1, seed=0, options=options)
    >>> round(fits.batch.noise.scale, 1)  # times the published law
    2.0
    """
    law = FrameNoisePrior(batch.noise)
    if rounds:
        batch = replace(batch, noise=replace(batch.noise, jitter=FIRST_JITTER))
    options = options or SearchOptions()

    def fit_models(
        batch: ExperimentBatch, number: int, near: Assimilation | None
    ) -> Assimilation:
        own = child(seed, "round", number) if number else seed
        last = number == rounds
        if isinstance(options, En4DVarOptions):
            return assimilate_en4dvar(
                belief,
                batch,
                simulator,
                seed=own,
                options=options,
                near=near,
                progress=progress,
            )
        rough = replace(
            options,
            gradient=max(options.gradient, 0.3),
            agreement=max(options.agreement, 1.0),
            basin_rounds=0 if number else options.basin_rounds,  # searched before and after
        )
        return assimilate(
            belief,
            batch,
            simulator,
            seed=own,
            options=options if last else rough,
            near=near,
            warn=warn and last,
            progress=progress,
        )

    result = fit_models(batch, 0, None)
    if rounds:
        kept = without_spoilt_frames(result.lowest.linearise(result.batch, simulator))
        if kept is not result.batch:
            result = fit_models(kept, 0, result)
    for number in range(1, rounds + 1):
        scattered = replace(result.batch, experiments=with_scatter(result))
        batch = with_inferred_noise(
            scattered, result, law, simulator, widen=number == rounds
        )
        report_progress(progress, f"noise {batch.noise}", stage="noise")
        result = fit_models(batch, number, result)
    return result


def with_inferred_noise(
    batch: ExperimentBatch,
    result: Assimilation,
    prior: FrameNoisePrior,
    simulator: Simulator,
    *,
    widen: bool,
) -> ExperimentBatch:
    """A batch with the noise of its curves as inferred about the model of lowest cost; as it was
    where these tell too little.

    Args:
        batch: the experiments of the fits.
        result: the fits.
        prior: of the law.
        simulator: makes the bubbles.
        widen: whether it is enlarged so that intervals are right; noise is inferred about fits
            without that, which would pass beside curves that the model misses.
    """
    if not (~batch.collapse).any():
        return batch
    best, curves = result.lowest.of_curves(result.batch)
    if not determines_noise(best, curves):
        return batch
    near = best.linearise(curves, simulator)
    return infer_frame_noise(near, prior).for_fits(widen=widen).applied(batch)


def noise_nodes(result: Assimilation, simulator: Simulator) -> NoiseNodes | None:
    """Laws of the noise over which posteriors are integrated; None where it was not inferred, or
    collapse times stand beside.

    Args:
        result: fits whose batch has its noise inferred.
        simulator: makes the bubbles.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import SearchOptions, assimilate_estimating_noise, noise_nodes, weigh
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
    >>> case, simulator = reference_case("soft-pa"), PolytropicSimulator()
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack(case.truth), repeats=1)
    >>> shot, options = laboratory.shoot(torch.tensor([400.0, 0.22]).double(), seed=1), SearchOptions(raw_samples=16, starts=2)
    >>> fits = assimilate_estimating_noise(case.prior, ExperimentBatch((shot,)), simulator, rounds=1, seed=0, options=options)
    >>> weigh(fits, simulator, seed=0, samples=64, noise=noise_nodes(fits, simulator))["nhkv"].sample.reliable
    True
    """
    batch = result.batch
    if batch.noise_laws is None or batch.collapse.any():
        return None
    best = result.lowest
    return NoiseNodes.about_fit(batch.noise_laws, best.linearise(batch, simulator))


def with_scatter(result: Assimilation) -> tuple[Experiment | CollapseTime, ...]:
    """The experiments, with the further error of collapse times that their residuals ask for, the
    same (over t*) for all.

    The model of lowest cost counts. With the error ``s`` of a time and its slopes ``a`` over the
    standardised nuisances, the precision of these given the gel is ``I + a a^T/s^2``, and they have
    taken up ``|a|^2/(s^2 + |a|^2)`` of the residual.
    """
    best = result.lowest
    batch = result.batch
    rows = batch.collapse
    shots = [e for e in batch.experiments if isinstance(e, CollapseTime)]
    if not shots:
        return batch.experiments
    left = (batch.mean - best.prediction)[rows, 0]
    square = tensor([shot.whole_sd**2 for shot in shots])
    stated = tensor([shot.sd**2 for shot in shots])
    precision = best.nuisance_chol[rows].square().sum((-2, -1))  # trace, 3 without data
    slopes = square * (precision - 3.0).clamp_min(0.0)
    gel = len(best.mean) - float(best.chol.square().sum())
    scatter = estimate_scatter(
        left * (1.0 + slopes / square), stated + slopes, max(gel, 0.0)
    )
    return tuple(
        replace(e, scatter=scatter) if isinstance(e, CollapseTime) else e
        for e in batch.experiments
    )


def determines_noise(fit: ModelFit, batch: ExperimentBatch) -> bool:
    """Whether a fit leaves ten degrees of freedom or more, from which on residuals determine the
    noise.
    """
    return float(batch.mask.sum()) - freedom_of(fit, batch) >= FEWEST_RESIDUALS


def freedom_of(fit: ModelFit, batch: ExperimentBatch) -> float:
    """Degrees of freedom that a fit took: its controls and nuisances, each as far as the data
    reduced its prior variance.
    """
    gel = len(fit.mean) - float(fit.chol.square().sum())
    uncertain = batch.nuisance_sds > 0.0
    left = torch.cholesky_inverse(fit.nuisance_chol).diagonal(dim1=-2, dim2=-1)
    return max(gel, 0.0) + float((1.0 - left)[uncertain].clamp_min(0.0).sum())
