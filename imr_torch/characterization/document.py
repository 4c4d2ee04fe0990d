"""The curves of a characterisation as JSON-ready values, from which its figures are drawn again:
measured frames, curves of the models, residuals, and the predictive band.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from imr_torch.assimilate import Assimilation, ModelFit
from imr_torch.assimilate.dense import dense_curve
from imr_torch.characterization.bands import band_document, predictive_band
from imr_torch.files import drawn_numbers
from imr_torch.material import Belief
from imr_torch.observe import ExperimentBatch, Prepared, TraceSet
from imr_torch.observe.frames import FrameUse
from imr_torch.simulate import Simulator


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
) -> list[dict[str, Any]]:
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
                "models": {fit.model: _model(fit, batch, e, drawn[fit.model]) for fit in fits},
                "band": band_document(best, drawn[best][0], band, e),
            }
        )
    return curves


def _model(
    fit: ModelFit, batch: ExperimentBatch, e: int, drawn: tuple[Tensor, Tensor]
) -> dict[str, Any]:
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
