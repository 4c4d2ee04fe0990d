"""The figure of a comparison of two gels, drawn from its document alone."""

from collections.abc import Iterator, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from imr_torch.labels import symbol
from imr_torch.results.named import NamedFigure
from imr_torch.results.plot import DATA, MODEL, set_scale


def compared_figures(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    """The ratio of every parameter of the two gels."""
    yield NamedFigure(
        "ratios",
        f"Each parameter of {document['a']} over that of {document['b']}, with its 90 % interval.",
        "Interval chart of the ratios; the table gives the numbers.",
        lambda: plot_ratios(document),
    )


def plot_ratios(document: Mapping[str, Any]) -> Axes:
    """Ratio of every parameter with its 90 % interval, on a logarithmic axis.

    Args:
        document: of ``compare``.
    """
    rows = document["parameters"]
    low, middle, high = np.array(
        [[row[f"ratio_{end}"] for end in ("low", "median", "high")] for row in rows]
    ).T
    size = (5.2, 1.2 + 0.4 * len(rows))
    ax = plt.subplots(figsize=size, layout="constrained")[1]
    places = range(len(rows))
    reach = (middle - low, high - middle)
    ax.errorbar(middle, places, xerr=reach, fmt="o", capsize=3, color=MODEL)
    ax.axvline(1.0, color=DATA, lw=0.8, ls="--")
    ax.set_yticks(places, [symbol(row["parameter"]) for row in rows])
    if set_scale(ax, "x", low.min(), high.max(), ratio=5.0):
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("{x:g}")
    ax.set(xlabel="a / b", ylim=(len(rows) - 0.5, -0.5))
    return ax
