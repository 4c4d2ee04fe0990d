"""The document of a characterisation: its numbers, and the curves from which its figures are drawn
again.
"""

from dataclasses import replace
from typing import Any

from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.assimilate.dense import dense_curve
from imr_torch.characterization import LEVELS, Characterization, predictive_band
from imr_torch.files import drawn_numbers
from imr_torch.observe import ExperimentBatch, TraceSet
from imr_torch.simulate import Simulator


def characterization_document(
    result: Characterization,
    traces: TraceSet,
    simulator: Simulator,
    *,
    command: str = "imr-torch diagnose",
    draws: int = 100,
    seed: int = 0,
) -> dict[str, Any]:
    """JSON-ready result, with the measured frames, the model curves and the residuals.

    Args:
        result: the characterisation.
        traces: the records it was made of.
        simulator: makes the bubbles of the drawn curves.
        command: what to try if the model does not explain the curves.
        draws: posterior draws behind the predictive band.
        seed: of these draws.

    >>> import torch
    >>> from imr_torch import PolytropicSimulator, characterize, wide_prior
    >>> from imr_torch.assimilate import SearchOptions
    >>> from imr_torch.material import PARAMETERS
    >>> from imr_torch.observe import RadiusTrace, TraceSet
    >>> from imr_torch.results import characterization_document
    >>> from imr_torch.units import Surroundings
    >>> simulator, size, times = PolytropicSimulator(), 221e-6, torch.linspace(0.0, 2.2, 23, dtype=torch.float64)
    >>> bubble = simulator(PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), torch.tensor([200.0, 0.2]).double(), times)
    >>> traces = TraceSet((RadiusTrace("a", times * Surroundings().time_scale(size), size * bubble.radius, "example"),))
    >>> options = SearchOptions(raw_samples=16, starts=2)
    >>> result = characterize(
    ...     traces,
    ...     prior=wide_prior(["nhkv"]),
    ...     simulator=simulator,
    ...     estimate_noise=False,
    ...     rest_radius=(0.2, 0.002),
    ...     options=options,
    ... )
    >>> document = characterization_document(result, traces, simulator)
    >>> document["curves"][0]["frames"]["recorded"], len(document["curves"][0]["models"]["nhkv"]["t_star"])
    (23, 600)
    """
    simulator = simulator if result.medium is None else result.medium.applied(simulator)
    curves = _curves(result, traces, simulator, draws=draws, seed=seed) if len(traces) else []
    left_out = [
        {"file": x.file, "experiment": x.experiment_id, "rows": str(x.rows), "reason": x.reason}
        for x in traces.left_out
    ]
    tested = result.fit_test
    check = (
        None
        if tested is None
        else tested.to_dict() | {"command": command, "sentence": tested.sentence(command)}
    )
    return result.to_dict() | {
        "fit_test": check,
        "rows_left_out": left_out,
        "notes": list(traces.notes),
        "curves": curves,
    }


def _curves(
    result: Characterization, traces: TraceSet, simulator: Simulator, *, draws: int, seed: int
) -> list[dict[str, Any]]:
    """Every curve with its measured frames, the curves of the models and the predictive band of the
    most probable one.
    """
    whole = result.assimilation
    best = result.posterior.best.model
    pairs = [fit.of_curves(whole.batch) for fit in whole.fits]
    fits = tuple(fit for fit, _ in pairs)
    batch = pairs[0][1]
    drawn = {fit.model: dense_curve(fit, batch, simulator) for fit in fits}
    curves_only = replace(whole, batch=batch, fits=fits)
    band = predictive_band(
        curves_only, result.posterior, simulator, best, draws=draws, seed=seed, times=drawn[best][0]
    )
    scale = simulator.conditions.surroundings
    curves = []
    for e, (trace, use, experiment) in enumerate(
        zip(traces, result.frames, result.experiments, strict=True)
    ):
        marks = result.landmarks[trace.experiment_id]
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
                "band": {
                    "model": best,
                    "levels": LEVELS,
                    "t_star": drawn_numbers(drawn[best][0][e]),
                }
                | {
                    name: drawn_numbers(values[e])
                    for name, values in zip(("low", "median", "high"), band, strict=True)
                },
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
