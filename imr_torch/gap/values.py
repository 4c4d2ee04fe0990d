"""Numbers that text, page and JSON of a diagnosis share: fits without and with what was added, and
the parameters there.
"""

from typing import NamedTuple

import torch

from imr_torch.assimilate import ModelFit
from imr_torch.gap.diagnose import GapReport
from imr_torch.gap.parts import Parts
from imr_torch.material import LIBRARY

_LEVELS = (0.05, 0.5, 0.95)


def fit_of_cause(report: GapReport) -> ModelFit | None:
    """The fit with the leading cause, where the verdict names one."""
    if report.attribution is None or report.verdict not in ("effect", "class"):
        return None
    return report.attribution.fits[report.attribution.winner]


class Beside(NamedTuple):
    """A fit that is shown beside the base model: ``"with_cause"`` or ``"with_additions"``, and what
    was added.
    """

    name: str
    effects: tuple[str, ...]
    fit: ModelFit


def fit_beside(report: GapReport, parts: Parts) -> Beside | None:
    """The fit of the named cause, else of the best step of the stepwise selection.

    None where there is neither.
    """
    if (after := fit_of_cause(report)) is not None:
        assert report.attribution is not None
        return Beside("with_cause", tuple(report.attribution.winner.split("+")), after)
    best = None if parts.selection is None else parts.selection.best
    return (
        Beside("with_additions", best.effects, best.fit)
        if best is not None and best.effects
        else None
    )


def parameters(report: GapReport) -> dict[str, list[float]]:
    """Parameter of the gel -> [5 %, 50 %, 95 %], SI: with the named cause, or of the base model
    where none is named.
    """
    fit = fit_of_cause(report) or report.null
    quantiles = fit.posterior.quantile(torch.tensor(_LEVELS, dtype=torch.float64))
    return {
        name: quantiles[:, fit.prior.names.index(name)].tolist() for name in report.null.prior.names
    }


def all_parameters(fit: ModelFit) -> dict[str, list[float]]:
    """Every parameter of a fit, those of its effects included -> [5 %, 50 %, 95 %], SI."""
    quantiles = fit.posterior.quantile(torch.tensor(_LEVELS, dtype=torch.float64))
    return {name: quantiles[:, i].tolist() for i, name in enumerate(fit.prior.names)}


def parameter_shift(report: GapReport) -> dict[str, dict[str, list[float]]] | None:
    """Parameter of the base model -> its [5 %, 50 %, 95 %] without and with the named cause, SI.

    None without a cause.
    """
    after = fit_of_cause(report)
    if after is None:
        return None
    levels = torch.tensor(_LEVELS, dtype=torch.float64)
    before = report.null.posterior.quantile(levels)
    later = after.posterior.quantile(levels)
    return {
        name: {
            "base": before[:, i].tolist(),
            "with_cause": later[:, after.prior.names.index(name)].tolist(),
        }
        for i, name in enumerate(report.null.prior.names)
    }


def cause_values(report: GapReport) -> dict[str, dict[str, list[float]]] | None:
    """Named effect -> each of its parameters -> [5 %, 50 %, 95 %], SI, at the fit with the leading
    cause; None without a cause.

    Effects of a class that the leading fit does not hold have the values of their own fits.
    """
    after = fit_of_cause(report)
    if after is None or report.attribution is None:
        return None
    values = {}
    for name in report.cause:
        fit = next(
            (
                f
                for f in (after, report.attribution.fits.get(name))
                if f is not None and _holds(f, name)
            ),
            None,
        )
        if fit is not None:
            quantiles = fit.posterior.quantile(torch.tensor(_LEVELS, dtype=torch.float64))
            values[name] = {
                p: quantiles[:, fit.prior.names.index(p)].tolist() for p in LIBRARY[name].names
            }
    return values


def _holds(fit: ModelFit, name: str) -> bool:
    return name in LIBRARY and set(LIBRARY[name].names) <= set(fit.prior.names)
