"""Collapse times alone in a result document: their figure, and their rows of the page."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from imr_torch.labels import T_STAR
from imr_torch.plot import DATA, MODEL


def collapse_figure(document: Mapping[str, Any]) -> Figure:
    """Measured less predicted collapse time of each shot, over its maximum radius and over its
    stretch.

    Errors are those of the time with the scatter; the errors of Rmax and R_inf are fitted and not
    drawn.

    Args:
        document: of ``characterize``.
    """
    shots = document["collapse_times"]
    figure, axes = plt.subplots(1, 2, figsize=(5.8, 2.9), sharey=True, layout="constrained")
    left = np.array([x["t_star"] - x["predicted"] for x in shots])
    sd = np.array([np.hypot(x["sd"], x["scatter"]) for x in shots])
    for ax, values, label in (
        (axes[0], [1e6 * x["Rmax_m"] for x in shots], r"$R_\mathrm{max}$ (µm)"),
        (axes[1], [1.0 / x["R_inf*"] for x in shots], r"$R_\mathrm{max}/R_\infty$"),
    ):
        ax.axhline(0.0, color=DATA, lw=0.6)
        ax.errorbar(values, left, sd, fmt=".", ms=5, color=MODEL, elinewidth=0.7)
        ax.set_xlabel(label)
    axes[0].set_ylabel(f"collapse time, measured less\nmodel ({T_STAR})")
    return figure


def collapse_rows(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What is assumed of shots of which the collapse time alone is known, a row each.

    None where there is none.
    """
    shots = document.get("collapse_times") or []
    if not shots:
        return []
    stated = sum(x["sd"] for x in shots) / len(shots)
    scatter = shots[0]["scatter"]
    found = (
        f"; {scatter:.2g} more, estimated from the scatter about the fit and plugged in"
        if scatter
        else ""
    )
    return [
        (
            "Collapse times",
            f"{len(shots)} shot(s), taken to be of the same gel; Rmax and R_inf are uncertain in "
            "the fit",
        ),
        ("Error of a collapse time", f"{stated:.2g} in t* as stated{found}"),
    ]
