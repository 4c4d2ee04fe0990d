"""Apparent parameters over the event, each fitted to the frames of a moving window only.

If constant parameters are right, windows agree within their uncertainty; if the model lacks
something, they drift. That is how Chu et al. (2026, arXiv 2606.13584) follow gels through a
collapse, with an iterative ensemble Kalman smoother and multiple data assimilation; here each
window is a Gauss-Newton fit from the common fit, every bubble still starting at its maximum at t* =
0. It shows whether and when constant parameters fail, but no cause, since any unmodelled effect
makes parameters drift. It is a baseline for comparison, and no part of the verdict.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.special import chdtrc
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.errors import InputDataError
from imr_torch.gap.locate import frames_between
from imr_torch.gap.restrict import moved, refit, restrict
from imr_torch.goodness.linear import Linearisation
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator

_STEPS = 2
_LONGEST = 2.0  # prior standard deviations that a window may move at once


@dataclass(frozen=True)
class MovingWindows:
    """Apparent parameters over the event.

    Args:
        centres: ``W`` tensor, dimensionless.
        names: fitted parameters.
        values: ``W x d`` tensor, SI.
        low: ``W x d`` tensor, one standard deviation below.
        high: ``W x d`` tensor, one above.
        drift: ``d`` tensor, slope of each parameter over the event in its standard deviations (z).
        p_constant: ``d`` tensor, p-value of a constant parameter.
    """

    centres: Float[Tensor, "windows"]
    names: tuple[str, ...]
    values: Float[Tensor, "windows controls"]
    low: Float[Tensor, "windows controls"]
    high: Float[Tensor, "windows controls"]
    drift: Float[Tensor, "controls"]
    p_constant: Float[Tensor, "controls"]


def moving_windows(
    fit: ModelFit,
    line: Linearisation,
    batch: ExperimentBatch,
    simulator: Simulator,
    *,
    width: float | None = None,
    windows: int = 7,
    steps: int = _STEPS,
) -> MovingWindows:
    """Fit the parameters to each of several overlapping windows, all experiments together,
    nuisances free.

    Args:
        fit: the fit to all frames, from which each window starts.
        line: local sensitivities at the fit.
        batch: the data.
        simulator: makes the bubbles.
        width: of a window, in Rmax/U_c; by default 1, about a first collapse, or half of a record
            that is shorter than two.
        windows: how many, evenly over the records.
        steps: Gauss-Newton steps of each; the first needs no bubbles.

    Raises:
        InputDataError: if windows do not fit into the records, or one holds no frame.
    """
    end = float(batch.times[batch.mask].max())
    width = min(1.0, 0.5 * end) if width is None else width
    if windows < 2 or steps < 1 or not 0.0 < width < end:
        raise InputDataError(
            f"Expected 2 windows or more, 1 step or more and 0 < width < {end:g}; got {windows}, "
            f"{steps} and {width}."
        )
    starts = torch.linspace(0.0, end - width, windows, dtype=torch.float64)
    frames = [frames_between(batch, start, start + width + 1e-9) for start in starts.tolist()]
    found = [_window(fit, line, batch, steps, f, simulator) for f in frames]
    controls, maps = (torch.stack(parts) for parts in zip(*found, strict=True))
    sd = maps.norm(dim=2)
    values, low, high = (_physical(fit, controls + step * sd) for step in (0.0, -1.0, 1.0))
    drift, p_constant = _constancy(starts, controls, maps)
    return MovingWindows(
        starts + 0.5 * width, fit.prior.names, values, low, high, drift, p_constant
    )


def _window(
    fit: ModelFit,
    line: Linearisation,
    batch: ExperimentBatch,
    steps: int,
    frames: Tensor,
    simulator: Simulator,
) -> tuple[Tensor, Tensor]:
    """Controls of one window (``d``) and the ``d x N`` matrix that makes them from noise."""
    size = len(fit.mean)
    total = torch.zeros(line.fitted.shape[1], dtype=torch.float64)
    here = line
    for step in range(steps):
        shift, to_shift = refit(restrict(here, frames))
        total = total + shift * min(1.0, _LONGEST / max(float(shift.norm()), 1e-300))
        if step < steps - 1:
            here = moved(fit, line, total, batch, simulator)
            if here is line:  # that point cannot be simulated
                break
    return fit.mean + total[:size], to_shift[:size]  # type: ignore[possibly-unbound]  # steps >= 1


def _physical(fit: ModelFit, controls: Tensor) -> Tensor:
    return fit.prior.physical(fit.prior.unwhitened(controls))


def _constancy(centres: Tensor, controls: Tensor, maps: Tensor) -> tuple[Tensor, Tensor]:
    """Slope over its sd and p-value of constancy of each parameter.

    Windows that share frames are correlated.
    """
    count, size = controls.shape
    basis = torch.stack((torch.ones(count, dtype=torch.float64), centres - centres.mean()), 1)
    drift = []
    p_values = []
    for i in range(size):
        covariance = maps[:, i] @ maps[:, i].mT
        covariance = covariance + 1e-9 * covariance.diagonal().mean() * torch.eye(
            count, dtype=torch.float64
        )
        chol = torch.linalg.cholesky(covariance)
        design = torch.linalg.solve_triangular(chol, basis, upper=False)
        data = torch.linalg.solve_triangular(chol, controls[:, i : i + 1], upper=False)
        inverse = torch.linalg.inv(design.mT @ design)
        drift.append(float((inverse @ design.mT @ data)[1, 0] / inverse[1, 1].sqrt()))
        constant = torch.linalg.qr(design[:, :1]).Q
        square = float((data - constant @ (constant.mT @ data)).square().sum())
        p_values.append(float(chdtrc(count - 1, square)))
    return torch.tensor(drift, dtype=torch.float64), torch.tensor(p_values, dtype=torch.float64)
