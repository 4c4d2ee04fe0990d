"""The population of gels in a result document: its figure."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from imr_torch.labels import plain
from imr_torch.material import PARAMETERS
from imr_torch.results.named import NamedFigure
from imr_torch.results.plot import DATA, MODEL, PALE, floats, parameter_label, set_scale

_WIDE = 5.0  # ratio of the ends of an axis from which on it is logarithmic
_ROWS = 40  # shots with a label


def population_named_figure(found: Mapping[str, Any]) -> NamedFigure:
    """The figure of a population with its caption.

    Args:
        found: ``population`` of a result document.
    """
    return NamedFigure(
        "population",
        "Each shot alone (grey) and given all shots (blue), 90 % intervals; line and band: the "
        "median of all; dotted: "
        "90 % of the shots to come.",
        "Interval charts of every parameter by shot, beside the population's median.",
        lambda: population_figure(found),
    )


def population_figure(found: Mapping[str, Any]) -> Figure:
    """Every shot alone and given all, a panel a parameter, beside the population's median and the
    shots to come.

    Args:
        found: ``population`` of a result document.
    """
    names = list(found["parameters"])
    shots = found["shots"]
    size = (0.9 + 2.9 * len(names), 1.6 + 0.24 * len(shots))
    figure, axes = plt.subplots(
        1, len(names), figsize=size, sharey=True, layout="constrained", squeeze=False
    )
    for name, ax in zip(names, axes[0], strict=True):
        entry = found["parameters"][name]
        parameter = PARAMETERS[name]
        scale = parameter.display_scale
        low, middle, high = scale * floats(entry["median"])
        to_come = scale * floats(entry["next_shot"])[[0, 2]]
        ax.axvspan(low, high, color=MODEL, alpha=0.15, lw=0)
        ax.axvline(middle, color=MODEL, lw=1.2, label="median of the population")
        for end in to_come:
            ax.axvline(end, color=MODEL, ls=":", lw=1.0)
        ends = [low, high, *to_come]
        for row, shot in enumerate(shots):
            for key, color, dot, shift, width in (
                ("alone", PALE, PALE, 0.14, 3.5),
                ("given_all", MODEL, DATA, -0.14, 1.8),
            ):
                left, centre, right = scale * floats(shot[key][name])
                at = row + shift
                ax.plot((left, right), (at, at), color=color, lw=width, solid_capstyle="butt")
                ax.plot(centre, at, "o", ms=3.5, color=dot)
                ends += [left, right]
        if set_scale(ax, "x", min(ends), max(ends), ratio=_WIDE):
            ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
            ax.xaxis.set_minor_formatter(NullFormatter())
        ax.set_xlabel(parameter_label(parameter))
        if "scatter" in entry:
            title = "scatter {1:.2f} ({0:.2f} to {2:.2f})".format(*entry["scatter"])
            ax.set_title(title, fontsize=9)
    labels = [plain(shot["id"], 24) for shot in shots]
    axes[0, 0].set_yticks(range(len(shots)), labels, fontsize=8 if len(shots) <= _ROWS else 5)
    axes[0, 0].set_ylim(len(shots) - 0.5, -0.5)
    return figure
