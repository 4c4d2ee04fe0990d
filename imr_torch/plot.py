"""Figures: curves with their posterior predictive band, parameters, model probabilities, the
information map.

Every ``plot_*`` draws into ``ax`` (a new figure when None) and returns the axes; nothing is shown
or saved here.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from imr_torch.calibration import Reliability, envelope
from imr_torch.design import DesignSearch
from imr_torch.labels import R_STAR, REST_RADIUS, T_STAR, WEBER, plain, symbol, with_unit
from imr_torch.material import Belief, ModelBelief, Parameter
from imr_torch.observe import Experiment
from imr_torch.simulate import Solution
from imr_torch.units import Surroundings

DATA, MODEL, SECOND, TRUTH = (
    "#222222",
    "#0072B2",
    "#E69F00",
    "#D55E00",
)  # safe for colour-blind readers
PALE = "#B8B8B8"  # frames that were not fitted
CYCLE = (
    MODEL,
    TRUTH,
    "#009E73",
    SECOND,
    "#CC79A7",
    "#56B4E9",
    DATA,
)  # several curves in one panel (Okabe and Ito 2008)
_CURVES_SHOWN = 12
_WIDE = 30.0  # ratio of the largest to the smallest value from which on an axis is logarithmic
_LINE = 0.06  # part of an axis below which a density is a line, and is drawn again in an inset
_DRAWS = 1500  # of a joint plot
_GRID = 60


def _axes(ax: Axes | None, size: tuple[float, float] = (5.2, 3.4)) -> Axes:
    if ax is not None:
        return ax
    return plt.subplots(figsize=size, layout="constrained")[1]


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
    style = {
        "ms": 3,
        "color": DATA,
        "alpha": 0.5 if experiment.repeats == 1 else 0.15,
        "ls": "none",
        "marker": ".",
    }
    for curve in experiment.radius[:_CURVES_SHOWN]:
        ax.plot(experiment.times, curve, **style)
    if band is not None:
        at = experiment.times if times is None else times
        low, middle, high = (x[: len(at)] for x in band)
        ax.fill_between(at, low, high, color=MODEL, alpha=0.25, lw=0, label="90 % predictive")
        ax.plot(at, middle, color=MODEL, lw=1.5, label="median")
        ax.legend(frameon=False, fontsize=8)
    ax.set(xlabel=T_STAR, ylabel=R_STAR, ylim=(0.0, None))
    if surroundings is not None:
        size = float(surroundings.max_radius(experiment.design[0]))
        with_lengths(ax, size, float(surroundings.time_scale(size)))
    ax.set_title(plain(experiment.label), fontsize=9)
    return ax


def _label(entry: Parameter) -> str:
    return with_unit(symbol(entry.name), entry.display_unit or entry.unit)


def _entry(belief: ModelBelief, name: str) -> Parameter:
    return belief.material.parameters[belief.material.names.index(name)]


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
    levels = torch.linspace(0.002, 0.998, 400, dtype=torch.float64)
    rows = [
        (
            plain(label),
            belief.quantile(levels)[:, belief.names.index(name)]
            * _entry(belief, name).display_scale,
            color,
        )
        for (label, belief), color in zip(beliefs, (SECOND, MODEL, TRUTH, DATA), strict=False)
    ]
    low, high = (
        float(f(torch.stack([values for _, values, _ in rows]))) for f in (torch.amin, torch.amax)
    )
    logarithmic = low > 0.0 and high > _WIDE * low
    for label, values, color in rows:
        ax.plot(*_density(values, levels, logarithmic), color=color, label=label)
    scale = _entry(beliefs[0][1], name).display_scale
    if truth is not None:
        ax.axvline(truth * scale, color=TRUTH, ls="--", lw=1)
    if logarithmic:
        ax.set_xscale("log")
    ax.set(
        yticks=[],
        ylabel="density (scaled)",
        xlabel=_label(_entry(beliefs[0][1], name)),
        ylim=(0.0, 1.45),
    )
    ax.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)
    last = rows[-1][1]
    width = (
        math.log(float(last[-1] / last[0])) / math.log(high / low)
        if logarithmic
        else float(last[-1] - last[0]) / (high - low)
    )
    if width < _LINE:
        middle = 0.5 * float(last[0] + last[-1])
        place = (
            math.log(middle / low) / math.log(high / low)
            if logarithmic
            else (middle - low) / (high - low)
        )
        inset = ax.inset_axes((0.08 if place > 0.5 else 0.62, 0.36, 0.32, 0.36))
        inset.plot(*_density(last, levels, False), color=rows[-1][2])
        inset.set(yticks=[], ylim=(0.0, 1.1))
        if truth is not None and float(last[0]) < truth * scale < float(last[-1]):
            inset.axvline(truth * scale, color=TRUTH, ls="--", lw=1)
        inset.set_xticks(last[[20, 379]].tolist(), [f"{x:.3g}" for x in last[[20, 379]].tolist()])
        inset.tick_params(labelsize=7)
    return ax


def _density(values: Tensor, levels: Tensor, logarithmic: bool) -> tuple[Tensor, Tensor]:
    """Points of a density, at most 1, from its quantiles.

    Of the logarithm of the parameter on a logarithmic axis.
    """
    at = values.log() if logarithmic else values
    density = levels.diff() / at.diff().clamp_min(1e-300)
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
    scales = torch.tensor(
        [_entry(belief, name).display_scale for name in names], dtype=torch.float64
    )
    draws = belief.physical(belief.controls(_DRAWS, seed=seed)) * scales
    levels = torch.linspace(0.002, 0.998, 400, dtype=torch.float64)
    marginals = belief.quantile(levels) * scales
    for i in range(size):
        for j in range(size):
            ax = axes[i][j]
            if j > i:
                ax.set_axis_off()
                continue
            span = marginals[:, j]
            wide = float(span[0]) > 0.0 and float(span[-1]) > _WIDE * float(span[0])
            if i == j:
                ax.plot(*_density(span, levels, wide), color=MODEL)
                low, middle, high = (belief.quantile([0.05, 0.5, 0.95])[:, j] * scales[j]).tolist()
                ax.axvspan(low, high, color=MODEL, alpha=0.12, lw=0)
                ax.set(yticks=[], ylim=(0.0, 1.1))
                ax.set_title(
                    f"{symbol(names[j])} = {middle:.3g} ({low:.3g} to {high:.3g})", fontsize=8
                )
            else:
                _pair(ax, draws[:, j], draws[:, i])
                tall = float(marginals[0, i]) > 0.0 and float(marginals[-1, i]) > _WIDE * float(
                    marginals[0, i]
                )
                ax.set(
                    ylim=(float(marginals[0, i]), float(marginals[-1, i])),
                    yscale="log" if tall else "linear",
                )
            ax.set(xlim=(float(span[0]), float(span[-1])), xscale="log" if wide else "linear")
            if i == size - 1:
                ax.set_xlabel(_label(_entry(belief, names[j])))
            if j == 0 and i > 0:
                ax.set_ylabel(_label(_entry(belief, names[i])))
    return figure


def _pair(ax: Axes, x: Tensor, y: Tensor) -> None:
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
    for i, key in enumerate(keys):
        heights = [belief.probabilities[key] for _, belief in beliefs]
        places = [j + (i - (len(keys) - 1) / 2) * width for j in range(len(beliefs))]
        ax.bar(
            places,
            heights,
            width,
            color=CYCLE[i % len(CYCLE)],
            label=beliefs[0][1][key].material.title,
        )
    ax.set(
        xticks=range(len(beliefs)),
        xticklabels=[plain(label) for label, _ in beliefs],
        ylim=(0, 1.02),
        ylabel="probability",
    )
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
    weber = torch.tensor(values["We"])
    rest = torch.tensor(values["R_inf*"])
    filled = ax.contourf(weber, rest, torch.tensor(values["nats"]), levels=15, cmap="viridis")
    ax.figure.colorbar(filled, ax=ax, label="expected information gain (nats)")
    places = [[row[name] for row in evaluated] for name in ("We", "R_inf*")]
    ax.plot(
        *places, "o", ms=3.5, color="white", mec="black", mew=0.4, label="evaluated", clip_on=False
    )
    at = (chosen["We"], chosen["R_inf*"])
    ax.plot(*at, "*", ms=16, ls="none", color=TRUTH, mec="white", label="chosen", zorder=5)
    for setter, axis in ((ax.set_xlim, weber), (ax.set_ylim, rest)):
        margin = 0.05 * float(axis[-1] - axis[0])  # so that a star on the border is whole
        setter(float(axis[0]) - margin, float(axis[-1]) + margin)
    ax.set(xlabel=WEBER, ylabel=REST_RADIUS)
    ax.legend(
        frameon=False,
        fontsize=8,
        ncols=2,
        loc="upper left",
        bbox_to_anchor=(0.0, -0.16),
        borderaxespad=0.0,
    )
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
    share = torch.tensor(result.share)
    reach = torch.stack(
        (share - torch.tensor(result.low), torch.tensor(result.high) - share)
    ).clamp_min(0.0)
    ax.plot((0, 1), (0, 1), color=DATA, lw=1, alpha=0.4)
    ax.errorbar(result.stated, result.share, yerr=reach, fmt="o", color=MODEL, ms=4, capsize=2)
    for x, y, count in zip(result.stated, result.share, result.counts, strict=True):
        ax.annotate(str(count), (x, y), xytext=(5, -9), textcoords="offset points", fontsize=7)
    title = f"calibration error {result.error:.3f}, by chance {result.by_chance:.3f}"
    ax.set(
        xlabel="stated probability",
        ylabel="share that came true",
        xlim=(-0.02, 1.02),
        ylim=(-0.02, 1.02),
    )
    ax.set_title(title, fontsize=9)
    return ax
