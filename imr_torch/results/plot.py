"""Figures: curves with their posterior predictive band, parameters, model probabilities, the
information map.

Every ``plot_*`` draws into ``ax`` (a new figure when None) and returns the axes; nothing is shown
or saved here.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from imr_torch.calibration import Reliability, envelope
from imr_torch.design import DesignSearch
from imr_torch.labels import R_STAR, REST_RADIUS, T_STAR, WEBER, plain, symbol, with_unit
from imr_torch.material import PARAMETERS, Belief, ModelBelief, Parameter
from imr_torch.observe import Experiment
from imr_torch.simulate import Solution
from imr_torch.units import Surroundings

DATA = "#222222"
MODEL = "#0072B2"
SECOND = "#E69F00"
TRUTH = "#D55E00"
PALE = "#B8B8B8"  # frames that were not fitted
CYCLE = (MODEL, TRUTH, "#009E73", SECOND, "#CC79A7", "#56B4E9", DATA)
"""Several curves in one panel, safe for colour-blind readers (Okabe and Ito 2008)."""

NOISE_BAND: dict[str, Any] = {"color": "#E2E2E2", "lw": 0}
"""Style of the band that noise alone stays in."""

_CURVES_SHOWN = 12
_WIDE = 30.0  # ratio of the largest to the smallest value from which on an axis is logarithmic
_LINE = 0.06  # part of an axis below which a density is a line, and is drawn again in an inset
_DRAWS = 1500  # of a joint plot
_GRID = 60
_LEVELS = torch.linspace(0.002, 0.998, 400, dtype=torch.float64)  # of a density

floats = partial(np.asarray, dtype=float)
"""Numbers of a document as an array; None is NaN."""


def _axes(ax: Axes | None, size: tuple[float, float] = (5.2, 3.4)) -> Axes:
    return ax or plt.subplots(figsize=size, layout="constrained")[1]


def curve_panels(title: str) -> tuple[Figure, Axes, Axes]:
    """A figure with a panel for radius over time and, below, one for residuals over their noise."""
    figure, (ax, below) = plt.subplots(
        2, 1, figsize=(5.8, 4.8), height_ratios=[3, 1], sharex=True, layout="constrained"
    )
    ax.set_ylabel(R_STAR)
    below.axhspan(-2.0, 2.0, **NOISE_BAND)
    below.set(xlabel=T_STAR, ylabel="residual\n/ noise")
    figure.suptitle(plain(title), fontsize=10)
    return figure, ax, below


def fill_band(ax: Axes, band: Mapping[str, Any]) -> None:
    """Draw a 90 % predictive band: ``t_star``, ``low`` and ``high``, and ``median`` if it is to be
    drawn.
    """
    times, low, high = (floats(band[name]) for name in ("t_star", "low", "high"))
    ax.fill_between(times, low, high, color=MODEL, alpha=0.22, lw=0, label="90 % predictive")


def set_scale(ax: Axes, axis: str, low: float, high: float, *, ratio: float = _WIDE) -> bool:
    """Make an axis logarithmic where its values span more than a ratio; whether it is."""
    logarithmic = low > 0.0 and high > ratio * low
    if logarithmic:
        ax.set(**{f"{axis}scale": "log"})
    return logarithmic


def plot_solution(
    solution: Solution, *, ax: Axes | None = None, labels: Sequence[str] | None = None
) -> Axes:
    """Radius over time of each bubble of a flat batch (``B x n_t``)."""
    ax = _axes(ax)
    ax.set_prop_cycle(color=CYCLE)
    for i, (times, radius) in enumerate(zip(solution.times, solution.radius, strict=True)):
        ax.plot(times, radius, lw=1.5, label=plain(labels[i]) if labels else None)
    ax.set(xlabel=T_STAR, ylabel=R_STAR, ylim=(0.0, None))
    if labels:
        ax.legend(frameon=False, fontsize=8)
    return ax


def with_lengths(ax: Axes, max_radius_m: float, time_scale_s: float) -> None:
    """Add us above and um at the right of axes in t* and R*.

    Args:
        ax: the axes.
        max_radius_m: Rmax, m.
        time_scale_s: Rmax/U_c, s.
    """
    ax.secondary_xaxis("top", functions=_scaled(1e6 * time_scale_s)).set_xlabel("$t$ (µs)")
    ax.secondary_yaxis("right", functions=_scaled(1e6 * max_radius_m)).set_ylabel("$R$ (µm)")


def _scaled(factor: float) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """From an axis to a second one in other units, and back."""
    return lambda x: x * factor, lambda x: x / factor


def plot_experiment(
    experiment: Experiment,
    band: tuple[Float[Tensor, "dense"], Float[Tensor, "dense"], Float[Tensor, "dense"]]
    | None = None,
    *,
    ax: Axes | None = None,
    times: Float[Tensor, "dense"] | None = None,
    surroundings: Surroundings | None = None,
) -> Axes:
    """Measured curves of one experiment and, if given, the 5, 50 and 95 % posterior predictive
    quantiles (``n_t`` each).

    Args:
        experiment: the curves.
        band: the quantiles, R/Rmax.
        ax: where to draw.
        times: ``n_t`` tensor at which the band is given, dimensionless; the frames when not given.
        surroundings: the liquid side; with it, us and um are second axes.
    """
    ax = _axes(ax)
    alpha = 0.5 if experiment.repeats == 1 else 0.15
    curves = experiment.radius[:_CURVES_SHOWN].mT
    ax.plot(experiment.times, curves, ".", ms=3, color=DATA, alpha=alpha)
    if band is not None:
        at = experiment.times if times is None else times
        low, middle, high = (x[: len(at)] for x in band)
        fill_band(ax, {"t_star": at, "low": low, "high": high})
        ax.plot(at, middle, color=MODEL, lw=1.5, label="median")
        ax.legend(frameon=False, fontsize=8)
    ax.set(xlabel=T_STAR, ylabel=R_STAR, ylim=(0.0, None))
    if surroundings is not None:
        size = float(surroundings.max_radius(experiment.design[0]))
        with_lengths(ax, size, float(surroundings.time_scale(size)))
    ax.set_title(plain(experiment.label), fontsize=9)
    return ax


def parameter_label(entry: Parameter) -> str:
    """Symbol and unit of a parameter, for an axis."""
    return with_unit(symbol(entry.name), entry.display_unit or entry.unit)


def plot_parameter(
    beliefs: Sequence[tuple[str, ModelBelief]],
    name: str,
    *,
    truth: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Density of one parameter under several beliefs of a model (for example prior and posterior).

    The axis is logarithmic where the widest belief spans more than a factor of 30; a density that
    is a line there too is drawn again in an inset.
    """
    ax = _axes(ax, (4.2, 3.0))
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
        ax.plot(*_density(values, logarithmic), color=color, label=plain(label))
    ax.set(yticks=[], ylabel="density (scaled)", xlabel=parameter_label(entry), ylim=(0.0, 1.45))
    ax.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)
    last = rows[-1]
    panels = [ax]
    ends = torch.stack((last[0], last[-1], torch.tensor(low), torch.tensor(high)))
    first, final, left, right = (ends.log() if logarithmic else ends).tolist()
    if final - first < _LINE * (right - left):
        on_the_right = 0.5 * (first + final) > 0.5 * (left + right)
        inset = ax.inset_axes((0.08 if on_the_right else 0.62, 0.36, 0.32, 0.36))
        inset.plot(*_density(last, False), color=colors[len(rows) - 1])
        inset.set(yticks=[], ylim=(0.0, 1.1), xlim=(float(last[0]), float(last[-1])))
        inset.set_xticks(last[[20, 379]].tolist(), [f"{x:.3g}" for x in last[[20, 379]].tolist()])
        inset.tick_params(labelsize=7)
        panels.append(inset)
    if truth is not None:
        for panel in panels:
            panel.axvline(truth * entry.display_scale, color=TRUTH, ls="--", lw=1)
    return ax


def _density(values: Tensor, logarithmic: bool) -> tuple[Tensor, Tensor]:
    """Points of a density, at most 1, from its quantiles.

    Of the logarithm of the parameter on a logarithmic axis.
    """
    at = values.log() if logarithmic else values
    density = _LEVELS.diff() / at.diff().clamp_min(1e-300)
    middle = 0.5 * (at[1:] + at[:-1])
    return (middle.exp() if logarithmic else middle), density / density.max()


def draw_parameters(belief: ModelBelief, *, seed: int = 0) -> Figure:
    """Joint plot of the parameters of a belief: a density of each, and draws with contours of every
    pair.

    Args:
        belief: of one model.
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
    entries = [PARAMETERS[name] for name in names]
    scales = torch.tensor([entry.display_scale for entry in entries], dtype=torch.float64)
    draws = belief.physical(belief.controls(_DRAWS, seed=seed)) * scales
    spans = (belief.quantile(_LEVELS) * scales).mT
    intervals = (belief.quantile([0.05, 0.5, 0.95]) * scales).mT.tolist()
    for i in range(size):
        for j in range(size):
            ax = axes[i][j]
            if j > i:
                ax.set_axis_off()
                continue
            wide = set_scale(ax, "x", float(spans[j, 0]), float(spans[j, -1]))
            if i == j:
                low, middle, high = intervals[j]
                ax.plot(*_density(spans[j], wide), color=MODEL)
                ax.axvspan(low, high, color=MODEL, alpha=0.12, lw=0)
                ax.set(yticks=[], ylim=(0.0, 1.1))
                title = f"{symbol(names[j])} = {middle:.3g} ({low:.3g} to {high:.3g})"
                ax.set_title(title, fontsize=8)
            else:
                _plot_pair(ax, draws[:, j], draws[:, i])
                set_scale(ax, "y", float(spans[i, 0]), float(spans[i, -1]))
                ax.set_ylim(float(spans[i, 0]), float(spans[i, -1]))
            ax.set_xlim(float(spans[j, 0]), float(spans[j, -1]))
            if i == size - 1:
                ax.set_xlabel(parameter_label(entries[j]))
            if j == 0 and i > 0:
                ax.set_ylabel(parameter_label(entries[i]))
    return figure


def _plot_pair(ax: Axes, x: Tensor, y: Tensor) -> None:
    """Draws of two parameters with smoothed contours that hold half and nine tenths of them."""
    ax.plot(x, y, ".", ms=1.5, color=MODEL, alpha=0.25)
    points = torch.stack((x, y))
    centre = points.mean(1, keepdim=True)
    spread = points.std(1, keepdim=True).clamp_min(1e-300)
    z = (points - centre) / spread
    grid = torch.linspace(-3.5, 3.5, _GRID, dtype=torch.float64)
    width = 1.5 * len(x) ** (-1.0 / 6.0)
    kx, ky = (torch.exp(-0.5 * ((grid[:, None] - row) / width).square()) for row in z)
    density = ky @ kx.mT
    ordered = density.flatten().sort(descending=True).values
    held = ordered.cumsum(0) / ordered.sum()
    levels = [float(ordered[int((held < share).sum())]) for share in (0.9, 0.5)]
    ax.contour(
        grid * spread[0] + centre[0],
        grid * spread[1] + centre[1],
        density,
        levels=levels,
        colors=[DATA],
        linewidths=0.9,
    )


def plot_probabilities(beliefs: Sequence[tuple[str, Belief]], *, ax: Axes | None = None) -> Axes:
    """Model probabilities as grouped bars, one group per belief."""
    ax = _axes(ax, (4.2, 2.8))
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
    ax.legend(frameon=False, fontsize=8)
    return ax


def information_map(search: DesignSearch) -> dict[str, Any]:
    """The surrogate's expected information gain over the design space, JSON-ready: We, R_inf*, and
    rows of nats over We.
    """
    low, high = search.optimizer.space.bounds
    weber, rest = (
        torch.linspace(float(low[i]), float(high[i]), _GRID, dtype=torch.float64) for i in (0, 1)
    )
    grid = torch.stack(torch.meshgrid(weber, rest, indexing="xy"), dim=-1)
    model = search.optimizer.model()
    with torch.no_grad():
        mean = model.posterior(grid.reshape(-1, 2)).mean.reshape(_GRID, _GRID)
    return {"We": weber.tolist(), "R_inf*": rest.tolist(), "nats": mean.tolist()}


def plot_information(
    search: DesignSearch, *, ax: Axes | None = None, surroundings: Surroundings | None = None
) -> Axes:
    """Map of the expected information gain over designs, with the evaluated designs and the chosen
    one.

    Args:
        search: a finished search.
        ax: where to draw.
        surroundings: the liquid side, which fixes Rmax of a Weber number; the default one when not
            given.
    """
    evaluated = [{"We": float(we), "R_inf*": float(rest)} for we, rest in search.designs]
    weber, rest = search.recommendation.design.tolist()
    per_weber = float((surroundings or Surroundings()).max_radius(1.0))
    chosen = {"We": weber, "R_inf*": rest, "Rmax_m": per_weber * weber}
    return draw_information(information_map(search), evaluated, chosen, ax=ax)


def draw_information(
    values: Mapping[str, Any],
    evaluated: Sequence[Mapping[str, float]],
    chosen: Mapping[str, float],
    *,
    ax: Axes | None = None,
) -> Axes:
    """The same from the numbers of a result document.

    Args:
        values: the map, from :func:`information_map`.
        evaluated: designs that were evaluated, with ``We`` and ``R_inf*``.
        chosen: the chosen design, with ``Rmax_m`` if Rmax is to be a second axis.
        ax: where to draw.
    """
    ax = _axes(ax, (5.6, 4.2))
    weber, rest = floats(values["We"]), floats(values["R_inf*"])
    filled = ax.contourf(weber, rest, floats(values["nats"]), levels=15, cmap="viridis")
    ax.figure.colorbar(filled, ax=ax, label="expected information gain (nats)")
    dots = {"ms": 3.5, "color": "white", "mec": "black", "mew": 0.4, "clip_on": False}
    we, r = ([row[name] for row in evaluated] for name in ("We", "R_inf*"))
    ax.plot(we, r, "o", label="evaluated", **dots)
    star = {"ms": 16, "ls": "none", "color": TRUTH, "mec": "white", "zorder": 5}
    ax.plot(chosen["We"], chosen["R_inf*"], "*", label="chosen", **star)
    ax.margins(0.05)  # so that a star on the border is whole
    ax.use_sticky_edges = False
    ax.set(xlabel=WEBER, ylabel=REST_RADIUS)
    below = {"loc": "upper left", "bbox_to_anchor": (0.0, -0.16), "borderaxespad": 0.0}
    ax.legend(frameon=False, fontsize=8, ncols=2, **below)
    if "Rmax_m" in chosen:
        factor = 1e6 * chosen["Rmax_m"] / chosen["We"]
        second = ax.secondary_xaxis("top", functions=_scaled(factor))
        second.set_xlabel(r"$R_\mathrm{max}$ (µm)")
    return ax


def plot_places(places: Mapping[str, Sequence[float]], *, ax: Axes | None = None) -> Axes:
    """Empirical distribution of where truths lie in their posteriors, less the diagonal.

    In the band 95 % of the time.
    """
    ax = _axes(ax)
    ax.set_prop_cycle(color=CYCLE)
    for name, values in places.items():
        at = torch.as_tensor(sorted(values), dtype=torch.float64)
        share = torch.arange(1, len(at) + 1, dtype=torch.float64) / len(at)
        ax.step(at, share - at, where="post", lw=1.2, label=f"{plain(name)} ({len(at)})")
    if places:
        width = envelope(min(len(values) for values in places.values()))
        ax.axhspan(-width, width, color=DATA, alpha=0.12, lw=0)
    ax.set(
        xlim=(0, 1),
        xlabel="place of the truth in its posterior",
        ylabel="share below, less uniform",
    )
    ax.legend(frameon=False, fontsize=8)
    return ax


def plot_reliability(result: Reliability, *, ax: Axes | None = None) -> Axes:
    """Share of cases that came true over the probability that was stated, with 95 % intervals."""
    ax = _axes(ax, (4.0, 3.6))
    share = floats(result.share)
    reach = np.clip((share - result.low, floats(result.high) - share), 0.0, None)
    ax.plot((0, 1), (0, 1), color=DATA, lw=1, alpha=0.4)
    ax.errorbar(result.stated, share, yerr=reach, fmt="o", color=MODEL, ms=4, capsize=2)
    for x, y, count in zip(result.stated, share, result.counts, strict=True):
        ax.annotate(str(count), (x, y), xytext=(5, -9), textcoords="offset points", fontsize=7)
    ax.set(xlabel="stated probability", ylabel="share that came true")
    ax.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    title = f"calibration error {result.error:.3f}, by chance {result.by_chance:.3f}"
    ax.set_title(title, fontsize=9)
    return ax
