"""The document of a characterisation: its numbers, and the curves from which its figures are drawn again."""

from typing import Any

import torch
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.characterize import LEVELS, Characterization, predictive_band
from imr_torch.observe import ExperimentBatch, TraceSet, predict
from imr_torch.simulate import Simulator

_UNIFORM = 200  # points of a drawn curve that lie evenly in time
_ALONG = (200, 200)  # those added evenly along the curve found so far, which a collapse needs
_ROUND = 7  # digits of what is only drawn


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
    >>> options = SearchOptions(scouts=16, starts=2)
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
    batch, best = result.assimilation.batch, result.posterior.best.model
    drawn = {fit.model: dense_curve(fit, batch, simulator) for fit in result.assimilation.fits}
    band = predictive_band(result.assimilation, result.posterior, simulator, best, draws=draws, seed=seed, times=drawn[best][0])
    scale = simulator.conditions.surroundings
    curves = []
    for e, (trace, use, experiment) in enumerate(zip(traces, result.frames, result.experiments, strict=True)):
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
                },
                "models": {fit.model: _model(fit, batch, e, drawn[fit.model]) for fit in result.assimilation.fits},
                "band": {"model": best, "levels": LEVELS, "t_star": _numbers(drawn[best][0][e])}
                | {name: _numbers(values[e]) for name, values in zip(("low", "median", "high"), band, strict=True)},
            }
        )
    left_out = [
        {"file": x.file, "experiment": x.experiment_id, "rows": str(x.rows), "reason": x.reason} for x in traces.left_out
    ]
    tested = result.fit_test
    check = None if tested is None else tested.to_dict() | {"command": command, "sentence": tested.sentence(command)}
    return result.to_dict() | {
        "fit_test": check,
        "rows_left_out": left_out,
        "notes": list(traces.notes),
        "curves": curves,
    }


def dense_curve(fit: ModelFit, batch: ExperimentBatch, simulator: Simulator) -> tuple[Tensor, Tensor]:
    """The fitted curve at so many times that a collapse is drawn round: two ``E x D`` tensors, t* and R/Rmax.

    Args:
        fit: the fit.
        batch: its data.
        simulator: makes the bubbles.
    """
    last = torch.where(batch.mask, batch.times, 0.0).amax(1, keepdim=True)
    first = batch.times[:, :1].clamp_max(0.0)
    times = first + (last - first) * torch.linspace(0.0, 1.0, _UNIFORM, dtype=torch.float64)
    parameters, shifts = fit.parameters(fit.mean), fit.nuisances * batch.nuisance_sds
    for added in _ALONG:
        curve = predict(simulator, parameters, batch, shifts, times=times)
        times = torch.cat((times, _along(times, curve, added)), 1).sort(1).values
        times = times + 1e-9 * torch.arange(times.shape[1], dtype=torch.float64)  # strictly increasing
    return times, predict(simulator, parameters, batch, shifts, times=times)


def _along(times: Tensor, curve: Tensor, count: int) -> Tensor:
    """Times of points evenly along the polygon of a curve, in a frame as wide as the record and as high as Rmax."""
    length = torch.hypot(times.diff(dim=1) / (times[:, -1:] - times[:, :1]), curve.diff(dim=1).nan_to_num()).cumsum(1)
    length = torch.nn.functional.pad(length, (1, 0))
    wanted = length[:, -1:] * torch.linspace(0.0, 1.0, count + 2, dtype=torch.float64)[1:-1]
    right = torch.searchsorted(length, wanted.contiguous()).clamp(1, times.shape[1] - 1)
    low, high = length.gather(1, right - 1), length.gather(1, right)
    weight = ((wanted - low) / (high - low).clamp_min(1e-300)).clamp(0.0, 1.0)
    return times.gather(1, right - 1) * (1.0 - weight) + times.gather(1, right) * weight


def _model(fit: ModelFit, batch: ExperimentBatch, e: int, drawn: tuple[Tensor, Tensor]) -> dict[str, Any]:
    """The curve of one model in one experiment, and its residuals at the fitted frames."""
    seen = batch.mask[e]
    residual = (batch.mean - fit.prediction)[e][seen]
    noise = (batch.sd(fit.prediction) / batch.counts.sqrt())[e][seen]
    return {
        "t_star": _numbers(drawn[0][e]),
        "R_star": _numbers(drawn[1][e]),
        "residual": _numbers(residual),
        "residual_over_sd": _numbers(residual / noise),
    }


def _numbers(values: Tensor) -> list[float | None]:
    """Numbers for JSON, which has no NaN."""
    return [round(x, _ROUND) if x == x and abs(x) < float("inf") else None for x in values.tolist()]
