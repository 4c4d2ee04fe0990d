"""Location of the gap: from when in the event on it can be detected, and in which experiments.

*When*: refit on the frames up to a moment and test; frames before an effect acts are free of it,
    whereas the residual of a
fit to all frames is spread over them by the fit. The first moment that rejects is the first at
which the gap can be detected: it comes earlier with more repeats, and no earlier than the effect
acts (where that is: :mod:`imr_torch.gap.acts`). *Which*: the same test on one design at a time, and
the drift of the parameters over designs: a trend in We (which fixes the size and so the rate)
points to rate or size, one in R_inf* to stretch or gas, none to what is alike everywhere. Refits
are linear about the fit (:mod:`imr_torch.gap.restrict`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.errors import InputDataError
from imr_torch.gap.restrict import calibrate, draw_residuals, log_p, refit, restrict
from imr_torch.goodness.linear import Linearisation, curves
from imr_torch.goodness.phases import phase_clock, phase_name
from imr_torch.goodness.score import pulse_changes, shape_rows
from imr_torch.labels import p_value
from imr_torch.observe import ExperimentBatch
from imr_torch.random import SeedLike
from imr_torch.simulate import Simulator

_GRID = (0.15, 0.3, 0.5, 0.75, 0.94, 1.06, 1.25, 1.5, 1.75, 1.94, 2.06, 2.25, 2.6, 3.2, math.inf)
_LEVEL = 0.01  # of a false onset or trend; that there is a gap at all is not decided here
_BESIDE = 4  # designs from which on the trends in We and R_inf* are told apart


@dataclass(frozen=True)
class Onset:
    """The first time at which the gap can be detected with these data; it comes earlier with more
    repeats.

    Args:
        time: dimensionless time of the last frame of the first prefix that rejects, median over
            experiments; NaN if none does.
        phase: one of :data:`imr_torch.goodness.phases.PHASES`, or ``"none"``.
        times: the end of each prefix, dimensionless, median over experiments.
        p_values: of each prefix, calibrated over all prefixes and tests.
        level: below which a prefix rejects.
    """

    time: float
    phase: str
    times: tuple[float, ...]
    p_values: tuple[float, ...]
    level: float

    def __str__(self) -> str:
        if self.phase == "none":
            return (
                "No prefix of the records rejects the model (smallest "
                f"{p_value(min(self.p_values))})."
            )
        return (
            f"The gap can first be detected in the {self.phase}: records up to t* = "
            f"{self.time:.2f} already reject the model "
            "(earlier ones would with more repeats)."
        )


def generic_directions(
    fit: ModelFit, line: Linearisation, batch: ExperimentBatch, simulator: Simulator
) -> dict[str, Float[Tensor, "_ rows"]]:
    """Directions that stand for no effect in particular: a pressure pulse at each of several times,
    and output shapes.

    Returns:
        Name -> whitened rows ``k x N``. A pulse is a test of its own, so that an early prefix is
        not asked about late ones.
    """
    changes = pulse_changes(batch)
    pulses = line.whiten(
        (curves(fit, batch, simulator, list(changes.values())) - line.prediction).nan_to_num()
    )
    rows = {
        f"pulse at {moment:.2f}": row[None] for moment, row in zip(changes, pulses, strict=True)
    }
    return rows | {"shape": shape_rows(line)[:2]}


def onset(
    fit: ModelFit,
    line: Linearisation,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: SeedLike,
    directions: Mapping[str, Tensor] | None = None,
    level: float = _LEVEL,
) -> Onset:
    """The prefix test: refit on the frames up to a moment and test, for a grid of moments.

    Moments are set on the phase clock of each experiment, so that curves whose collapses come at
    different times are cut alike. Refits are linear about ``fit``; linearised anew where they lead,
    16 of 16 sets kept their phase (3 designs of 100 curves, gaps of 10 to 209 sd).

    Args:
        fit: the base model's fit.
        line: local sensitivities at the fit.
        batch: the data.
        simulator: makes the bubbles.
        seed: of the residuals drawn for the calibration.
        directions: name -> whitened rows ``k x N`` to test
            (:func:`imr_torch.goodness.score.effect_directions`) beside the generic ones.
        level: chance of a false onset anywhere in the event.
    """
    tests = generic_directions(fit, line, batch, simulator) | dict(directions or {})
    clock = phase_clock(batch.times, line.prediction, batch.mask)
    drawn = draw_residuals(line, seed=seed)
    ends = []
    times = []
    observed = []
    calibration = []
    before = 0
    for end in _GRID:
        frames = (clock <= end) & batch.mask
        if int(frames.sum()) == before:
            continue
        before = int(frames.sum())
        part = restrict(line, frames)
        data, null = log_p(part, frames, tests, drawn)
        ends.append(end)
        times.append(_last_frame(batch.times, frames))
        observed.append(data)
        calibration.append(null)
    p_values = calibrate(observed, calibration).tolist()
    first = next((i for i, p in enumerate(p_values) if p < level), None)
    if first is None:
        return Onset(math.nan, "none", tuple(times), tuple(p_values), level)
    return Onset(times[first], phase_name(ends[first]), tuple(times), tuple(p_values), level)


def _last_frame(times: Tensor, frames: Tensor) -> float:
    """Median over experiments of the last frame's time."""
    return float(torch.where(frames, times, 0.0).amax(1).median())


@dataclass(frozen=True)
class Trend:
    """Drift of one fitted parameter over a coordinate of the design.

    Args:
        parameter: its name.
        over: ``"We"`` or ``"R_inf*"``.
        slope: change of the parameter's control (prior standard deviations) over the range of the
            coordinate that was shot.
        z: slope over its standard deviation.
    """

    parameter: str
    over: str
    slope: float
    z: float


@dataclass(frozen=True)
class ByExperiment:
    """Which experiments the gap lies in.

    Args:
        labels: of the experiments.
        p_values: of each design on its own, its parameters refitted; calibrated over designs and
            tests.
        names: fitted parameters.
        values: ``E x d`` tensor, refitted to each design alone, SI.
        low: ``E x d`` tensor, one standard deviation below.
        high: ``E x d`` tensor, one above.
        trends: drift of each parameter over each coordinate of the design.
        reading: one sentence on what the trends point to.
    """

    labels: tuple[str, ...]
    p_values: tuple[float, ...]
    names: tuple[str, ...]
    values: Float[Tensor, "experiments controls"]
    low: Float[Tensor, "experiments controls"]
    high: Float[Tensor, "experiments controls"]
    trends: tuple[Trend, ...]
    reading: str


def by_experiment(
    fit: ModelFit,
    line: Linearisation,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    seed: SeedLike,
    directions: Mapping[str, Tensor] | None = None,
    level: float = _LEVEL,
) -> ByExperiment:
    """The gap test and the parameters of each design alone, and the drift of the parameters over
    designs.

    Args:
        fit: the base model's fit.
        line: local sensitivities at the fit.
        batch: the data.
        simulator: makes the bubbles.
        seed: of the residuals drawn for the calibration.
        directions: as in :func:`onset`.
        level: chance of a false trend, over all parameters and coordinates.

    Returns:
        Tests, parameters by linear refit, trends by generalised least squares with all nuisances
        free.
    """
    tests = generic_directions(fit, line, batch, simulator) | dict(directions or {})
    drawn = draw_residuals(line, seed=seed)
    observed = []
    calibration = []
    values = []
    for e in range(len(batch.experiments)):
        frames = torch.zeros_like(batch.mask)
        frames[e] = batch.mask[e]
        part = restrict(line, frames)
        shift, to_shift = refit(part)
        sd = to_shift[: len(fit.mean)].norm(dim=1)
        centre = fit.mean + shift[: len(fit.mean)]
        values.append(
            torch.stack([_physical(fit, centre + step * sd) for step in (0.0, -1.0, 1.0)])
        )
        data, null = log_p(part, frames, tests, drawn)
        observed.append(data)
        calibration.append(null)
    trends = drifts(fit, line, batch)
    centre, low, high = torch.stack(values).unbind(1)
    p_values = tuple(calibrate(observed, calibration).tolist())
    labels = tuple(e.label for e in batch.experiments)
    return ByExperiment(
        labels,
        p_values,
        fit.prior.names,
        centre,
        low,
        high,
        trends,
        _read(trends, level, len(labels)),
    )


def _physical(fit: ModelFit, controls: Tensor) -> Tensor:
    return fit.prior.physical(fit.prior.mean + fit.prior.chol @ controls)


def drifts(fit: ModelFit, line: Linearisation, batch: ExperimentBatch) -> tuple[Trend, ...]:
    """Slopes of the fitted parameters over log We and R_inf*, from generalised least squares beside
    all that was fitted.

    With fewer than four designs each coordinate is taken alone, so that one that goes with the
    other shows in both.
    """
    size = len(fit.mean)
    coordinates = {"We": batch.designs[:, 0].log(), "R_inf*": batch.designs[:, 1]}
    scaled = {
        name: _centred(x) for name, x in coordinates.items() if float(x.max() - x.min()) > 1e-6
    }
    gel = line.fitted.clone()
    gel[batch.mask.numel() :] = (
        0.0  # a drift is no shift of the mean, so the prior says nothing of it
    )
    rows = {}
    for name, x in scaled.items():
        weight = torch.nn.functional.pad(
            x[:, None].expand_as(batch.mask).flatten(), (0, len(gel) - batch.mask.numel())
        )
        rows[name] = line.project(gel[:, :size].mT * weight)
    trends = []
    for name, own in rows.items():
        others = (
            [row for other, row in rows.items() if other != name]
            if len(batch.experiments) >= _BESIDE
            else []
        )
        for i, parameter in enumerate(fit.prior.names):
            beside = torch.cat([own[:i], own[i + 1 :], *others])
            left = (
                own[i] - torch.linalg.lstsq(beside.mT, own[i], driver="gelsd").solution @ beside
                if len(beside)
                else own[i]
            )
            length = float(left.norm())
            if length > 1e-3:
                z = float(left @ line.residual) / length
                trends.append(Trend(parameter, name, z / length, z))
    return tuple(trends)


def _centred(x: Tensor) -> Tensor:
    """A coordinate over its range, about its mean."""
    return (x - x.mean()) / (x.max() - x.min())


_MEANING = {"We": "rate or size", "R_inf*": "stretch or gas"}


def _read(trends: tuple[Trend, ...], level: float, experiments: int) -> str:
    if not trends:
        return "All experiments share one design, so nothing can be said about trends."
    limit = -torch.special.ndtri(
        torch.tensor(0.5 * level / len(trends), dtype=torch.float64)
    ).item()
    found = {
        name: [t.parameter for t in trends if t.over == name and abs(t.z) > limit]
        for name in _MEANING
    }
    said = [
        f"{', '.join(names)} over {over} (points to {_MEANING[over]})"
        for over, names in found.items()
        if names
    ]
    if len(said) > 1 and experiments < _BESIDE:
        names = ", ".join(sorted({name for over in found.values() for name in over}))
        return (
            f"Fitted parameters differ between the experiments: {names}. {experiments} "
            "experiments do not tell a drift over We "
            f"({_MEANING['We']}) from one over R_inf* ({_MEANING['R_inf*']}); {_BESIDE} would."
        )
    if said:
        return f"Fitted parameters drift: {'; '.join(said)}."
    return (
        "No fitted parameter drifts over the designs: the cause, if any, is alike in all, as "
        "errors of measurement are."
    )


def frames_between(
    batch: ExperimentBatch, start: float, end: float
) -> Bool[Tensor, "experiments frames"]:
    """``E x T`` boolean tensor: frames with ``start <= t* < end``.

    Raises:
        InputDataError: if there is no such frame.
    """
    frames = (batch.times >= start) & (batch.times < end) & batch.mask
    if not bool(frames.any()):
        raise InputDataError(
            f"No frame lies between t* = {start:g} and {end:g}; the records end at {_end(batch):g}."
        )
    return frames


def _end(batch: ExperimentBatch) -> float:
    return float(batch.times[batch.mask].max())
