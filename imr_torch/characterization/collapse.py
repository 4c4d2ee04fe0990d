"""Shots of which the collapse time alone is known, measured and predicted, and patterns in their
residuals.
"""

from collections.abc import Sequence

from imr_torch.assimilate import ModelFit
from imr_torch.files import Document
from imr_torch.float64 import tensor
from imr_torch.observe import CollapseTime, ExperimentBatch
from imr_torch.observe.collapse import serial_correlation
from imr_torch.units import Surroundings


def collapse_rows(
    fit: ModelFit, batch: ExperimentBatch, surroundings: Surroundings
) -> list[Document]:
    """Each shot of which the collapse time alone is known: measured and, by a fit, predicted, over
    t*.
    """
    return [
        {
            "id": e.label,
            "We": e.design[0],
            "R_inf*": e.design[1],
            "Rmax_m": surroundings.max_radius(e.design[0]),
            "t_star": e.time,
            "sd": e.sd,
            "scatter": e.scatter,
            "predicted": float(fit.prediction[i, 0]),
        }
        for i, e in enumerate(batch.experiments)
        if isinstance(e, CollapseTime)
    ]


def find_patterns(
    shots: Sequence[Document], *, fewest: int = 12, largest: float = 2.6
) -> list[str]:
    """Where residuals of collapse times follow the size or the stretch of a bubble: they are no
    independent errors.

    Args:
        shots: from :func:`collapse_rows`.
        fewest: shots from which on a pattern is looked for.
        largest: correlation that is none yet, in standard deviations; one set in 200 has more by
            chance.
    """
    said = []
    if len(shots) < fewest:
        return []
    left = tensor([x["t_star"] - x["predicted"] for x in shots])
    for key, words in (("Rmax_m", "maximum radius"), ("R_inf*", "stretch")):
        order = tensor([x[key] for x in shots])
        found = serial_correlation(left, order)
        if found > largest:
            said.append(
                f"Residuals of the collapse times are correlated in the order of {words} "
                f"({found:.1f} standard "
                "deviations): they are no independent errors, intervals are too narrow, and the "
                "model or a calibration "
                "misses something."
            )
    return said
