"""Charts of intervals, drawn from a result document: parameters over shots, of a population and of
two gels.
"""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imr_torch.drawing import (
    DATA,
    MODEL,
    PALE,
    TRUTH,
    draw_intervals,
    floats,
    new_axes,
    set_scale,
)
from imr_torch.files import Document
from imr_torch.labels import T_STAR, plain
from imr_torch.material import PARAMETERS

MANY_SHOTS = 40
"""Shots from which on their names do not fit beside a plot in full size."""

NARROW = 5.0
"""Ratio of the ends of an axis of ratios or shots from which on it is logarithmic."""


def is_usable(row: Document) -> bool:
    """Whether the intervals of a shot may be quoted: its fit converged, its intervals are reliable,
    and the model explains its curves or that was not tested.
    """
    return (
        row["status"] == "done"
        and row.get("verdict") != "refused"
        and row.get("explained", "yes") != "no"
    )


def parameters_of(rows: Sequence[Document]) -> list[str]:
    """Parameters that some shot has."""
    return [
        name for name in PARAMETERS.names if any(row.get(name) is not None for row in rows)
    ]


def plot_shots(rows: Sequence[Document], name: str) -> Axes:
    """A parameter with its 90 % interval over the shots that have it; those that are not to be
    quoted are orange.

    >>> from imr_torch.results.intervals import plot_shots
    >>> row = {"shot": "a", "status": "done", "G_low": 4e3, "G": 5e3, "G_high": 6e3}
    >>> plot_shots([row], "G").get_ylabel()
    '$G$ (kPa)'
    """
    scale = PARAMETERS[name].display_scale
    rows = [row for row in rows if row.get(name) is not None]
    ax = new_axes((min(4.0 + 0.22 * len(rows), 12.0), 3.4))
    values = scale * floats(
        [[row[f"{name}_low"], row[name], row[f"{name}_high"]] for row in rows]
    )
    good = np.array([is_usable(row) for row in rows])
    places = np.arange(len(rows))
    for color, chosen in ((MODEL, good), (TRUTH, ~good)):
        style = {"ms": 4, "capsize": 2, "color": color}
        draw_intervals(ax, places[chosen], values[chosen], upright=True, **style)
    quoted = values[good, 1]
    if len(quoted) > 1:
        ax.axhline(np.median(quoted), color=DATA, lw=1, ls="--")
    if len(quoted):
        set_scale(ax, "y", quoted.min(), quoted.max(), ratio=NARROW)
    if len(rows) <= MANY_SHOTS:
        names = [plain(row["shot"]) for row in rows]
        ax.set_xticks(places, names, rotation=60, ha="right", fontsize=7)
    ax.set(xlabel="shot", ylabel=PARAMETERS[name].label)
    return ax


def plot_ratios(document: Document) -> Axes:
    """Ratio of every parameter of two gels with its 90 % interval.

    Args:
        document: of ``compare``.
    """
    rows = document["parameters"]
    values = floats(
        [[row[f"ratio_{end}"] for end in ("low", "median", "high")] for row in rows]
    )
    ax = new_axes((5.2, 1.2 + 0.4 * len(rows)))
    places = range(len(rows))
    draw_intervals(ax, places, values, capsize=3, color=MODEL)
    ax.axvline(1.0, color=DATA, lw=0.8, ls="--")
    names = [row["parameter"] for row in rows]
    ax.set_yticks(places, [PARAMETERS[name].symbol or name for name in names])
    set_scale(ax, "x", values.min(), values.max(), ratio=NARROW)
    ax.set(xlabel="a / b", ylim=(len(rows) - 0.5, -0.5))
    return ax


def parts_figure(parts: Document) -> Figure:
    """Each parameter by all frames, and without each part of the records, 90 % intervals.

    Args:
        parts: of :meth:`imr_torch.goodness.PartsTest.to_dict`.
    """
    rows = [("all frames", parts["whole"])]
    rows += [(f"without {part['name']}", part["without"]) for part in parts["parts"]]
    names = list(parts["whole"])
    size = (5.8, 0.9 + 0.3 * len(rows))
    figure, axes = plt.subplots(
        1, len(names), figsize=size, sharey=True, squeeze=False, layout="constrained"
    )
    for ax, name in zip(axes[0], names, strict=True):
        values = PARAMETERS[name].display_scale * floats([row[name] for _, row in rows])
        draw_intervals(ax, range(len(rows)), values, capsize=3, color=MODEL)
        ax.axvspan(*values[0, [0, 2]], color=PALE, alpha=0.3, lw=0)
        ax.set(xlabel=PARAMETERS[name].label, ylim=(len(rows) - 0.5, -0.5))
    axes[0, 0].set_yticks(range(len(rows)), [label for label, _ in rows])
    return figure


def over_time_figure(stretches: Sequence[Document], whole: Document) -> Figure:
    """Each parameter of one stretch after another, each fitted alone, 90 % intervals, and of all
    frames.

    Args:
        stretches: of :func:`imr_torch.goodness.follow_gel`.
        whole: parameter -> interval of all frames, SI.
    """
    names = list(stretches[0]["intervals"])
    size = (5.8, 0.6 + 1.8 * len(names))
    figure, axes = plt.subplots(
        len(names), 1, figsize=size, sharex=True, squeeze=False, layout="constrained"
    )
    times = floats([row["t_star"] for row in stretches])
    middle = times.mean(1)
    for ax, name in zip(axes[:, 0], names, strict=True):
        scale = PARAMETERS[name].display_scale
        values = scale * floats([row["intervals"][name] for row in stretches])
        draw_intervals(ax, middle, values, upright=True, capsize=2, color=MODEL)
        ax.hlines(values[:, 1], *times.T, color=MODEL, lw=1.0)
        ax.axhspan(
            scale * whole[name][0], scale * whole[name][2], color=PALE, alpha=0.4, lw=0
        )
        set_scale(ax, "y", values.min(), values.max(), ratio=NARROW)
        ax.set_ylabel(PARAMETERS[name].label)
    axes[-1, 0].set_xlabel(T_STAR)
    return figure


def population_figure(found: Document) -> Figure:
    """Every shot alone and given all, a panel a parameter, beside the population's median and the
    shots to come.

    Args:
        found: ``population`` of a result document.
    """
    names = list(found["parameters"])
    shots = found["shots"]
    rows = -(-len(names) // 2)
    size = (3.8 + 2.9 * (len(names) > 1), rows * (1.6 + 0.24 * len(shots)))
    figure, axes = plt.subplots(
        rows,
        min(len(names), 2),
        figsize=size,
        sharey=True,
        layout="constrained",
        squeeze=False,
    )
    for ax in axes.flat[len(names) :]:
        ax.remove()
    for name, ax in zip(names, axes.flat, strict=False):
        entry = found["parameters"][name]
        scale = PARAMETERS[name].display_scale
        low, middle, high = scale * floats(entry["median"])
        to_come = scale * floats(entry["next_shot"])[[0, 2]]
        ax.axvspan(low, high, color=MODEL, alpha=0.15, lw=0)
        ax.axvline(middle, color=MODEL, lw=1.2)
        for end in to_come:
            ax.axvline(end, color=MODEL, ls=":", lw=1.0)
        ends = [low, high, *to_come]
        for key, line, dot, shift, width in (
            ("alone", PALE, PALE, 0.14, 3.5),
            ("given_all", MODEL, DATA, -0.14, 1.8),
        ):
            values = scale * floats([shot[key][name] for shot in shots])
            style = {"color": dot, "ecolor": line, "elinewidth": width, "ms": 3.5}
            draw_intervals(ax, np.arange(len(shots)) + shift, values, **style)
            ends += [values.min(), values.max()]
        set_scale(ax, "x", min(ends), max(ends), ratio=NARROW)
        ax.set_xlabel(PARAMETERS[name].label)
        if "scatter" in entry:
            title = "scatter {1:.2f} ({0:.2f} to {2:.2f})".format(*entry["scatter"])
            ax.set_title(title, fontsize=9)
    labels = [plain(shot["id"], 24) for shot in shots]
    axes[0, 0].set_yticks(
        range(len(shots)), labels, fontsize=8 if len(shots) <= MANY_SHOTS else 5
    )
    axes[0, 0].set_ylim(len(shots) - 0.5, -0.5)
    return figure
