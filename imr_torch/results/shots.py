"""The shots of a batch: which may be quoted, and the figure of a parameter over them."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from imr_torch.labels import plain, shown_unit
from imr_torch.material import PARAMETERS
from imr_torch.results.named import NamedFigure
from imr_torch.results.plot import DATA, MODEL, TRUTH, set_scale

_NAMED = 40  # shots whose names stand below a plot


def usable(row: Mapping[str, Any]) -> bool:
    """Whether the intervals of a shot may be quoted: its fit converged, its intervals are reliable,
    and the model explains its curves or that was not tested.
    """
    return (
        row["status"] == "done"
        and row.get("verdict") != "refused"
        and row.get("explained", "yes") != "no"
    )


def parameters_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Parameters that some shot has."""
    return [name for name in PARAMETERS.names if any(row.get(name) is not None for row in rows)]


def shots_figures(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    """A figure for each parameter of the shots of a batch."""
    rows = document["shots"]
    for name in parameters_of(rows):
        yield NamedFigure(
            f"shots_{name}",
            f"{name} of each shot with its 90 % interval; dashed: the median of those to be quoted.",
            f"{name} of each shot with its 90 % interval; the table gives the numbers.",
            lambda name=name: plot_shots(rows, name),
        )


def plot_shots(rows: Sequence[Mapping[str, Any]], name: str, *, ax: Axes | None = None) -> Axes:
    """A parameter with its 90 % interval over the shots that have it; those that are not to be
    quoted are orange.

    >>> from imr_torch.results.shots import plot_shots
    >>> row = {"shot": "a", "status": "done", "G_low": 4e3, "G": 5e3, "G_high": 6e3}
    >>> plot_shots([row], "G").get_xlabel()
    'shot'
    """
    parameter = PARAMETERS[name]
    rows = [row for row in rows if row.get(name) is not None]
    width = min(4.0 + 0.22 * len(rows), 12.0)
    ax = ax or plt.subplots(figsize=(width, 3.4), layout="constrained")[1]
    low, middle, high = (
        parameter.display_scale
        * np.array([[row[f"{name}_low"], row[name], row[f"{name}_high"]] for row in rows]).T
    )
    good = np.array([usable(row) for row in rows])
    places = np.arange(len(rows))
    for color, chosen in ((MODEL, good), (TRUTH, ~good)):
        reach = np.clip((middle - low, high - middle), 0.0, None)[:, chosen]
        ax.errorbar(places[chosen], middle[chosen], reach, fmt="o", ms=4, capsize=2, color=color)
    if good.sum() > 1:
        ax.axhline(np.median(middle[good]), color=DATA, lw=1, ls="--")
    if good.any():
        set_scale(ax, "y", middle[good].min(), middle[good].max(), ratio=20.0)
    if len(rows) <= _NAMED:
        names = [plain(row["shot"]) for row in rows]
        ax.set_xticks(places, names, rotation=60, ha="right", fontsize=7)
    unit = shown_unit(parameter)
    ax.set(xlabel="shot", ylabel=f"{name} ({unit})" if unit else name)
    return ax
