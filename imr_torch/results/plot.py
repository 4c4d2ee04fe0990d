"""Figures: curves with their posterior predictive band, parameters, model probabilities, the
information map.

Every ``plot_*`` draws a new figure and returns its axes; nothing is shown or saved here.
"""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import gaussian_kde
from torch import Tensor

from imr_torch.calibration import envelope
from imr_torch.drawing import (
    CYCLE,
    DATA,
    MODEL,
    SECOND,
    TRUTH,
    add_axis,
    add_legend,
    floats,
    new_axes,
    set_scale,
)
from imr_torch.files import Document
from imr_torch.float64 import arange, linspace, tensor
from imr_torch.labels import REST_RADIUS, WEBER, plain
from imr_torch.material import PARAMETERS, Belief, ModelBelief

_LEVELS = linspace(0.002, 0.998, 400)  # of a density


def fill_band(ax: Axes, band: Document) -> None:
    """Draw a 90 % predictive band: ``t_star``, ``low`` and ``high``."""
    times, low, high = (floats(band[name]) for name in ("t_star", "low", "high"))
    ax.fill_between(
        times, low, high, color=MODEL, alpha=0.22, lw=0, label="90 % predictive"
    )


def plot_parameter(
    beliefs: Sequence[tuple[str, ModelBelief]],
    name: str,
    *,
    truth: float | None = None,
) -> Axes:
    """Density of one parameter under several beliefs of a model (for example prior and posterior).

    The axis is logarithmic where the widest belief spans more than a factor of 30.
    """
    ax = new_axes((4.2, 3.0))
    entry = PARAMETERS[name]
    rows = [
        belief.quantile(_LEVELS)[:, belief.names.index(name)] * entry.display_scale
        for _, belief in beliefs
    ]
    low = min(float(values[0]) for values in rows)
    high = max(float(values[-1]) for values in rows)
    logarithmic = set_scale(ax, "x", low, high)
    colors = (SECOND, MODEL, TRUTH, DATA)
    for (label, _), values, color in zip(beliefs, rows, colors, strict=False):
        ax.plot(*_scale_density(values, logarithmic), color=color, label=plain(label))
    ax.set(yticks=[], ylabel="density (scaled)", xlabel=entry.label, ylim=(0.0, 1.45))
    add_legend(ax, loc="upper left", ncols=2)
    if truth is not None:
        ax.axvline(truth * entry.display_scale, color=TRUTH, ls="--", lw=1)
    return ax


def _scale_density(values: Tensor, logarithmic: bool) -> tuple[Tensor, Tensor]:
    """Points of a density, at most 1, from its quantiles.

    Of the logarithm of the parameter on a logarithmic axis.
    """
    at = values.log() if logarithmic else values
    density = _LEVELS.diff() / at.diff().clamp_min(1e-300)
    middle = 0.5 * (at[1:] + at[:-1])
    return (middle.exp() if logarithmic else middle), density / density.max()


def draw_parameters(belief: ModelBelief, *, draws: int = 1500, seed: int = 0) -> Figure:
    """Joint plot of the parameters of a belief: a density of each, and draws with contours of every
    pair.

    Args:
        belief: of one model.
        draws: how many are shown.
        seed: of the draws.
    """
    names = belief.names
    size = len(names)
    figure, axes = plt.subplots(
        size,
        size,
        figsize=(1.2 + 2.3 * size, 1.0 + 2.1 * size),
        layout="constrained",
        squeeze=False,
    )
    labels = [PARAMETERS[name].label for name in names]
    scales = tensor([PARAMETERS[name].display_scale for name in names])
    drawn = belief.physical(belief.controls(draws, seed=seed)) * scales
    spans = (belief.quantile(_LEVELS) * scales).mT
    intervals = (belief.quantile([0.05, 0.5, 0.95]) * scales).mT.tolist()
    for (i, j), ax in np.ndenumerate(axes):
        if j > i:
            ax.set_axis_off()
            continue
        first, last = spans[j, [0, -1]].tolist()
        wide = set_scale(ax, "x", first, last)
        if i == j:
            low, middle, high = intervals[j]
            ax.plot(*_scale_density(spans[j], wide), color=MODEL)
            ax.axvspan(low, high, color=MODEL, alpha=0.12, lw=0)
            ax.set(yticks=[], ylim=(0.0, 1.1))
            symbol = PARAMETERS[names[j]].symbol or names[j]
            title = f"{symbol} = {middle:.3g} ({low:.3g} to {high:.3g})"
            ax.set_title(title, fontsize=8)
        else:
            _plot_pair(ax, drawn[:, j], drawn[:, i])
            bottom, top = spans[i, [0, -1]].tolist()
            set_scale(ax, "y", bottom, top)
            ax.set(ylim=(bottom, top), ylabel=labels[i] if j == 0 else "")
        ax.set(xlim=(first, last), xlabel=labels[j] if i == size - 1 else "")
    return figure


def _plot_pair(ax: Axes, x: Tensor, y: Tensor) -> None:
    """Draws of two parameters with smoothed contours that hold half and nine tenths of them."""
    ax.plot(x, y, ".", ms=1.5, color=MODEL, alpha=0.25)
    points = torch.stack((x, y)).numpy()
    # 1.5 times the width of Scott's rule, so that contours of draws are no coast lines
    density = gaussian_kde(points, bw_method=1.5 * len(x) ** (-1.0 / 6.0))
    levels = np.quantile(density(points), (0.1, 0.5))
    grid = np.array(np.meshgrid(*np.linspace(points.min(1), points.max(1), 60).T))
    height = density(grid.reshape(2, -1)).reshape(grid.shape[1:])
    ax.contour(*grid, height, levels=levels, colors=[DATA], linewidths=0.9)


def plot_probabilities(beliefs: Sequence[tuple[str, Belief]]) -> Axes:
    """Model probabilities as grouped bars, one group per belief."""
    ax = new_axes((4.2, 2.8))
    keys = beliefs[0][1].keys
    width = 0.8 / len(keys)
    places = np.arange(len(beliefs))
    for i, key in enumerate(keys):
        heights = [belief.probabilities[key] for _, belief in beliefs]
        label = beliefs[0][1][key].material.title
        at = places + (i - (len(keys) - 1) / 2) * width
        ax.bar(at, heights, width, color=CYCLE[i % len(CYCLE)], label=label)
    ax.set_xticks(places, [plain(label) for label, _ in beliefs])
    ax.set(ylim=(0, 1.02), ylabel="probability")
    add_legend(ax)
    return ax


def draw_information(found: Document) -> Axes:
    """Map of the expected information gain over designs, with the evaluated designs and the chosen
    one.

    Args:
        found: from :meth:`imr_torch.design.DesignSearch.to_dict`.
    """
    values = found["map"]
    chosen = found["design"]
    ax = new_axes((5.6, 4.2))
    weber, rest = floats(values["We"]), floats(values["R_inf*"])
    filled = ax.contourf(weber, rest, floats(values["nats"]), levels=15, cmap="viridis")
    ax.figure.colorbar(filled, ax=ax, label="expected information gain (nats)")
    dots = {"ms": 3.5, "color": "white", "mec": "black", "mew": 0.4, "clip_on": False}
    we, r = ([row[name] for row in found["evaluations"]] for name in ("We", "R_inf*"))
    ax.plot(we, r, "o", label="evaluated", **dots)
    star = {"ms": 16, "ls": "none", "color": TRUTH, "mec": "white", "zorder": 5}
    ax.plot(chosen["We"], chosen["R_inf*"], "*", label="chosen", **star)
    ax.margins(0.05)  # so that a star on the border is whole
    ax.use_sticky_edges = False
    ax.set(xlabel=WEBER, ylabel=REST_RADIUS)
    below = {"loc": "upper left", "bbox_to_anchor": (0.0, -0.16), "borderaxespad": 0.0}
    add_legend(ax, ncols=2, **below)
    add_axis(ax, "top", 1e6 * chosen["Rmax_m"] / chosen["We"], r"$R_\mathrm{max}$ (µm)")
    return ax


def plot_places(places: Mapping[str, Sequence[float]]) -> Axes:
    """Empirical distribution of where truths lie in their posteriors, less the diagonal.

    In the band 95 % of the time.
    """
    ax = new_axes()
    ax.set_prop_cycle(color=CYCLE)
    for name, values in places.items():
        at = torch.as_tensor(sorted(values), dtype=torch.float64)
        share = arange(1, len(at) + 1) / len(at)
        ax.step(at, share - at, where="post", lw=1.2, label=f"{plain(name)} ({len(at)})")
    if places:
        width = envelope(min(len(values) for values in places.values()))
        ax.axhspan(-width, width, color=DATA, alpha=0.12, lw=0)
    ax.set(
        xlim=(0, 1),
        xlabel="place of the truth in its posterior",
        ylabel="share below, less uniform",
    )
    add_legend(ax)
    return ax
