"""The curves of a characterisation as JSON-ready values, from which its figures are drawn again:
measured frames, curves of the models, residuals, and the predictive band.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from imr_torch.assimilate import Assimilation, ModelFit
from imr_torch.assimilate.dense import dense_curve
from imr_torch.files import Document, drawn_numbers
from imr_torch.material import Belief
from imr_torch.material.intervals import LEVELS
from imr_torch.observe import ExperimentBatch, Prepared, TraceSet, predict
from imr_torch.observe.frames import FrameUse
from imr_torch.simulate import Simulator


def predictive_band(
    result: Assimilation,
    posterior: Belief,
    simulator: Simulator,
    model: str,
    *,
    draws: int = 100,
    seed: int = 0,
    times: Tensor,
    noise_levels: int = 21,
) -> tuple[Tensor, Tensor, Tensor]:
    """Posterior predictive quantiles (5, 50, 95 %) of single frames, over gel and noise: three ``E
    x T`` tensors, R/Rmax.

    Args:
        result: the fits, for the data and the nuisances.
        posterior: belief after the data.
        simulator: makes the bubbles.
        model: whose prediction.
        draws: posterior draws.
        seed: of the draws.
        times: ``E x T`` tensor, dimensionless, increasing.
        noise_levels: quantiles of the noise that are taken with each draw.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, reference_case
    >>> from imr_torch.assimilate import assimilate
    >>> from imr_torch.characterization import predictive_band
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import ExperimentBatch, Noise, SimulatedLaboratory
    >>> simulator, prior = PolytropicSimulator(), reference_case("soft-pa").prior
    >>> laboratory = SimulatedLaboratory(simulator, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=4)
    >>> shot = laboratory.shoot(torch.tensor([400.0, 0.22], dtype=torch.float64), seed=0)
    >>> result = assimilate(prior, ExperimentBatch((shot,), Noise()), simulator, seed=0)
    >>> low, middle, high = predictive_band(result, prior, simulator, "nhkv", draws=20, times=result.batch.times)
    >>> bool((low < middle).all()), bool((middle < high).all())
    (True, True)
    """
    fit = result[model]
    batch = result.batch
    part = posterior[model]
    controls = part.controls(draws, seed=seed)
    shifts = (fit.nuisances * batch.nuisance_sds).expand(draws, -1, -1)
    prediction = predict(simulator, part.parameters(controls), batch, shifts, times=times)
    # noise at its quantiles, not at random numbers, so that the band is smooth
    levels = (torch.arange(noise_levels, dtype=torch.float64) + 0.5) / noise_levels
    noise = torch.special.ndtri(levels)
    laws = None if fit.sample is None else fit.sample.noise_laws(draws)
    if laws is None:
        sd = batch.noise.of_frames.sd(prediction, times)
    else:  # each draw with a noise law of its own
        sd = torch.stack(
            [law.of_frames.sd(curves, times) for law, curves in zip(laws, prediction, strict=True)]
        )
    levels = torch.tensor(LEVELS, dtype=prediction.dtype)
    rows = [
        torch.nanquantile((own + of_own * noise[:, None, None]).flatten(0, 1), levels, dim=0)
        for own, of_own in zip(prediction.unbind(1), sd.unbind(1), strict=True)
    ]
    low, middle, high = torch.stack(rows, 1)
    return low, middle, high


def band_document(model: str, times: Tensor, band: Sequence[Tensor], e: int) -> Document:
    """The predictive band of one experiment, JSON-ready.

    Args:
        model: whose prediction.
        times: ``E x T`` tensor, dimensionless.
        band: three ``E x T`` tensors, from :func:`predictive_band`.
        e: which experiment.
    """
    rows = zip(("t_star", "low", "median", "high"), (times, *band), strict=True)
    return {"model": model, "levels": LEVELS} | {
        name: drawn_numbers(values[e]) for name, values in rows
    }


def curves_document(
    whole: Assimilation,
    posterior: Belief,
    prepared: Prepared,
    frames: Sequence[FrameUse],
    traces: TraceSet,
    simulator: Simulator,
    *,
    draws: int,
    seed: int,
) -> list[Document]:
    """Every curve with its measured frames, the curves of the models and the predictive band of the
    most probable one.

    Args:
        whole: the fits.
        posterior: belief after the data.
        prepared: the curves as they were fitted.
        frames: which frames were fitted.
        traces: the records.
        simulator: makes the bubbles, in the medium of the curves.
        draws: posterior draws behind the predictive band.
        seed: of these draws.
    """
    best = posterior.best.model
    pairs = [fit.of_curves(whole.batch) for fit in whole.fits]
    fits = tuple(fit for fit, _ in pairs)
    batch = pairs[0][1]
    drawn = {fit.model: dense_curve(fit, batch, simulator) for fit in fits}
    curves_only = replace(whole, batch=batch, fits=fits)
    band = predictive_band(
        curves_only, posterior, simulator, best, draws=draws, seed=seed, times=drawn[best][0]
    )
    scale = simulator.conditions.surroundings
    curves = []
    for e, (trace, use, experiment) in enumerate(
        zip(traces, frames, prepared.experiments, strict=True)
    ):
        marks = prepared.landmarks[trace.experiment_id]
        curves.append(
            {
                "id": trace.experiment_id,
                "source": trace.source.rsplit("/", 1)[-1],
                "We": experiment.design[0],
                "R_inf*": experiment.design[1],
                "Rmax_m": marks.max_radius_m,
                "R_inf_m": marks.max_radius_m * experiment.design[1],
                "time_of_max_s": marks.time_of_max_s,
                "time_scale_s": float(scale.time_scale(marks.max_radius_m)),
                "frames": use.to_dict(),
                "measured": {
                    "t_star": use.t_star,
                    "R_star": (trace.radius_m / marks.max_radius_m).tolist(),
                    "fitted": use.fitted,
                }
                | (
                    {}
                    if trace.asphericity is None
                    else {"asphericity": drawn_numbers(trace.asphericity)}
                ),
                "models": {
                    fit.model: _document_model(fit, batch, e, drawn[fit.model]) for fit in fits
                },
                "band": band_document(best, drawn[best][0], band, e),
            }
        )
    return curves


def _document_model(
    fit: ModelFit, batch: ExperimentBatch, e: int, drawn: tuple[Tensor, Tensor]
) -> Document:
    """The curve of one model in one experiment, and its residuals at the fitted frames."""
    seen = batch.mask[e]
    residual = (batch.mean - fit.prediction)[e][seen]
    noise = (batch.of_frames.sd(fit.prediction) / batch.counts.sqrt())[e][seen]
    return {
        "t_star": drawn_numbers(drawn[0][e]),
        "R_star": drawn_numbers(drawn[1][e]),
        "residual": drawn_numbers(residual),
        "residual_over_sd": drawn_numbers(residual / noise),
    }
