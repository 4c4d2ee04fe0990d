"""Linear refits to some of the frames, and tests of the residual that such a refit leaves.

Leaving frames out changes neither the curves nor their sensitivities, only which rows count; the
priors always do. So every "refit on a part of the data" in locating a gap is one small
least-squares problem on rows that are there already, in place of a nonlinear search. That is first
order in the distance between the two fits; :func:`moved` takes the linearisation there when it
matters. The smallest p-value over many tests is calibrated with residuals drawn under the fitted
model, as in :mod:`imr_torch.goodness.score`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from imr_torch.assimilate import ModelFit, Point
from imr_torch.goodness.linear import Linearisation, linearise_at, shifted
from imr_torch.goodness.score import block, log_survival
from imr_torch.observe import ExperimentBatch
from imr_torch.random import SeedLike, generator
from imr_torch.simulate import Simulator

BOOTSTRAP = 2000
"""Residuals drawn under the fitted model for a calibration."""


def kept_rows(
    line: Linearisation, frames: Bool[Tensor, "experiments frames"]
) -> Bool[Tensor, "rows"]:
    """Which whitened rows (``N`` boolean tensor) belong to frames (``E x T`` boolean tensor).

    Those of priors always do.
    """
    rows = (frames & line.batch.mask).flatten()
    return torch.nn.functional.pad(rows, (0, line.residual.shape[0] - rows.shape[0]), value=True)


def restrict(line: Linearisation, frames: Bool[Tensor, "experiments frames"]) -> Linearisation:
    """The same sensitivities with the rows of all other frames set to zero.

    Args:
        line: local sensitivities at a fit.
        frames: ``E x T`` boolean tensor, frames that stay. With correlated noise a frame stands for
            what it adds to the frames before it.
    """
    keep = kept_rows(line, frames).to(line.residual)
    return replace(line, residual=line.residual * keep, fitted=line.fitted * keep[:, None])


def refit(line: Linearisation) -> tuple[Float[Tensor, "fitted"], Float[Tensor, "fitted rows"]]:
    """The linear refit to the rows of a linearisation.

    Returns:
        ``k`` tensor, the shift of everything that was fitted (gel controls, then nuisances), and
        the ``k x N`` matrix that makes it from a residual; its product with its transpose is the
        shift's covariance.
    """
    return line.to_shift @ line.residual, line.to_shift


def moved(
    fit: ModelFit,
    line: Linearisation,
    shift: Float[Tensor, "fitted"],
    batch: ExperimentBatch,
    simulator: Simulator,
) -> Linearisation:
    """Local sensitivities at the point that a linear refit leads to.

    Args:
        fit: the fit that ``line`` is of.
        line: local sensitivities there, returned when the new point cannot be simulated.
        shift: ``k`` tensor from :func:`refit`.
        batch: the data.
        simulator: makes the bubbles.
    """
    mean, nuisances = shifted(fit, batch, shift[None])
    new = linearise_at(Point(mean[0], nuisances[0]), fit.prior, batch, simulator)
    return (
        new if bool(torch.isfinite(new.fitted).all() & torch.isfinite(new.residual).all()) else line
    )


def draw_residuals(
    line: Linearisation, *, seed: SeedLike, count: int = BOOTSTRAP
) -> Float[Tensor, "draws rows"]:
    """``count x N`` residuals under the fitted model, before anything is refitted."""
    return torch.randn(
        count, line.residual.shape[0], generator=generator(seed), dtype=torch.float64
    )


def log_p(
    part: Linearisation,
    frames: Bool[Tensor, "experiments frames"],
    directions: Mapping[str, Float[Tensor, "_ rows"]],
    drawn: Float[Tensor, "draws rows"],
) -> tuple[Float[Tensor, "tests"], Float[Tensor, "tests draws"]]:
    """Log p-values of what a refit to some frames leaves, in several directions and in all
    (chi-square).

    Args:
        part: a linearisation restricted to ``frames``.
        frames: ``E x T`` boolean tensor.
        directions: name -> whitened rows ``k x N``, tested together.
        drawn: ``B x N`` tensor from :func:`draw_residuals`.

    Returns:
        ``n`` tensor of the data's log p-values and ``n x B`` tensor of those drawn; tests without a
        direction are left out.
    """
    keep = kept_rows(part, frames).to(part.residual)
    blocks = [block(name, rows * keep, part).directions for name, rows in directions.items()]
    rows = part.project(torch.cat((part.residual[None], drawn * keep)))
    freedom = int(keep.sum()) - part.fitted.shape[1]
    tests = [((rows @ u).square().sum(1), u.shape[1]) for u in blocks if u.shape[1]]
    if freedom > 0:
        tests.append((rows.square().sum(1), freedom))
    if not tests:
        return torch.zeros(0, dtype=torch.float64), torch.zeros(0, len(drawn), dtype=torch.float64)
    logs = torch.stack([log_survival(statistic, k) for statistic, k in tests])
    return logs[:, 0], logs[:, 1:]


def calibrate(
    observed: Sequence[Float[Tensor, "_"]], drawn: Sequence[Float[Tensor, "_ draws"]]
) -> Float[Tensor, "groups"]:
    """P-values of groups of tests, each against the smallest p-value of all tests of all groups.

    Args:
        observed: per group, ``n`` tensor of log p-values.
        drawn: per group, ``n x B`` tensor of those under the fitted model.

    Returns:
        One p-value a group, controlled for all tests together; beyond the reach of the draws it is
        Bonferroni's bound.
    """
    smallest = torch.cat(list(drawn)).amin(0)
    tests = sum(len(group) for group in observed)
    values = []
    for group in observed:
        log = group.amin() if len(group) else torch.zeros((), dtype=torch.float64)
        count = int((smallest <= log).sum())
        bound = min(1.0, tests * float(log.exp()))
        values.append(
            (1 + count) / (1 + len(smallest)) if count else min(bound, 1.0 / (1 + len(smallest)))
        )
    return torch.tensor(values, dtype=torch.float64)
