"""What one would do without this diagnosis, on the same data: five usual ways, each as its authors
mean it to be used.

A chi-square test with the best evidence of a closed library; a Gaussian-process discrepancy of the
output (Kennedy & O'Hagan, J. R. Stat. Soc. B 63, 2001); a generic state closure; parameters over
moving windows (Chu et al. 2026, arXiv 2606.13584); the discrepancy of the data to the prior
predictive, as sbi scores it.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from botorch.exceptions import InputDataWarning, ModelFittingError
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.models.transforms import Normalize, Standardize
from gpytorch.mlls import ExactMarginalLogLikelihood
from torch import Tensor

from benchmarks.gap.mmd import prior_predictive_mmd
from imr_torch.gap import Effect, GapReport
from imr_torch.gap.hypotheses import Hypothesis, fit_hypotheses, laplace_evidence
from imr_torch.gap.windows import moving_windows
from imr_torch.goodness.linear import Linearisation
from imr_torch.goodness.score import LEVEL, STATE_LAW
from imr_torch.observe import ExperimentBatch
from imr_torch.simulate import Simulator

_FOLDS = 3  # designs that the Gaussian process predicts, one after the other
_POINTS = 400  # frames that it learns from, at most


def baselines(
    report: GapReport,
    line: Linearisation,
    offered: Sequence[Effect],
    simulator: Simulator,
    *,
    seed: int,
) -> dict[str, Any]:
    """All baselines on the data of a report, ready for JSON.

    Args:
        report: the diagnosis, whose null fit (and closed-set fits, where it has them) they share.
        line: the null fit's neighbourhood.
        offered: the library.
        simulator: as in the diagnosis.
        seed: of further fits.
    """
    p_chi_square = next(b.p_value for b in report.gap.blocks if b.name.startswith("everything"))
    windows = moving_windows(report.null, line, report.batch, simulator)
    return {
        "chi_square_p": p_chi_square,
        "closed_set": _closed_set(report, offered, simulator, seed)
        if p_chi_square < LEVEL
        else None,
        "gp_closed": gp_discrepancy(report.batch, line),
        "closure_p": next((b.p_value for b in report.gap.blocks if b.name == STATE_LAW), 1.0),
        "windows_p": min(1.0, len(windows.names) * float(windows.p_constant.min())),
        "mmd_p": prior_predictive_mmd(report.null.prior, report.batch, simulator, seed=seed),
    }


def _closed_set(
    report: GapReport, offered: Sequence[Effect], simulator: Simulator, seed: int
) -> str:
    """The single effect of largest evidence.

    Fitted here where the diagnosis saw no gap and so fitted none.
    """
    if report.attribution is not None:
        return report.attribution.winner.split("+")[0]  # selection starts with that effect
    hypotheses = [Hypothesis(report.null.prior, (effect,)) for effect in offered]
    fits = fit_hypotheses(hypotheses, report.null, report.batch, simulator, seed=seed)
    return max(fits, key=lambda name: laplace_evidence(fits[name]))


def gp_discrepancy(batch: ExperimentBatch, line: Linearisation) -> float | None:
    """Share of the held-out gap that a Gaussian process over (t*, log We, R_inf*) closes.

    It learns the null fit's residual on all designs but one and predicts that one, for up to three
    designs in turn. The null fit has seen all of them, to the advantage of neither.

    Args:
        batch: the data.
        line: the null fit's neighbourhood.

    Returns:
        ``1 - D_gp/D_null`` with the squared bias ``D`` of :mod:`imr_torch.gap.shrinkage`; None with
        one design, or where the null fit leaves no gap.
    """
    count = len(batch.experiments)
    if count < 2:
        return None
    residual = batch.mean - line.prediction
    variance = line.sd.square() / batch.counts
    place = torch.stack((batch.designs[:, 0].log(), batch.designs[:, 1]), 1)[:, None].expand(
        -1, batch.times.shape[1], -1
    )
    inputs = torch.cat((batch.times[..., None], place), -1)
    before = after = 0.0
    for out in range(min(_FOLDS, count)):
        learn = batch.mask.clone()
        learn[out] = False
        held = batch.mask[out]
        stride = -(-int(learn.sum()) // _POINTS)
        guess = _predicted(
            inputs[learn][::stride],
            residual[learn][::stride],
            variance[learn][::stride],
            inputs[out][held],
        )
        before += _square_bias(residual[out][held], variance[out][held])
        after += _square_bias(residual[out][held] - guess, variance[out][held])
    return 1.0 - after / before if before > 0.0 else None


def _square_bias(residual: Tensor, variance: Tensor) -> float:
    """Sum of squares over that of the noise of the mean, less its expectation."""
    return float((residual.square() / variance - 1.0).sum())


def _predicted(X: Tensor, Y: Tensor, Yvar: Tensor, where: Tensor) -> Tensor:
    """Posterior mean of a Gaussian process with known noise; of zero where its fit fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputDataWarning)
        model = SingleTaskGP(
            X,
            Y[:, None],
            Yvar[:, None],
            outcome_transform=Standardize(1),
            input_transform=Normalize(X.shape[1]),
        )
        try:
            fit_gpytorch_mll(
                ExactMarginalLogLikelihood(model.likelihood, model),
                optimizer_kwargs={"options": {"maxiter": 60}},
            )
        except ModelFittingError:
            return torch.zeros(len(where), dtype=where.dtype)
        with torch.no_grad():
            return model.posterior(where).mean[:, 0]
