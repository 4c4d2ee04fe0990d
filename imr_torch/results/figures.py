"""The figures of a result document, drawn from the document alone.

``draw_figures`` lists every figure of a document with a name, a caption and an alternative text;
each is drawn on its own, so that one that fails costs no other. Frames that were not fitted are
pale.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ndtri

from imr_torch.errors import InputDataError
from imr_torch.gap.figures import gap_figures
from imr_torch.labels import R_STAR, T_STAR, file_name
from imr_torch.material import Belief, material
from imr_torch.record import figures as record_figures
from imr_torch.results.campaign_figures import campaign_figures
from imr_torch.results.compared import compared_figures
from imr_torch.results.named import NamedFigure
from imr_torch.results.plot import (
    CYCLE,
    DATA,
    MODEL,
    NOISE_BAND,
    PALE,
    curve_panels,
    draw_information,
    draw_parameters,
    fill_band,
    floats,
    plot_parameter,
    plot_probabilities,
    with_lengths,
)
from imr_torch.results.population import population_named_figure
from imr_torch.results.profile import profile_named_figures
from imr_torch.results.shots import shots_figures
from imr_torch.results.whole import check_characterization

_FARTHER = 2.0  # fitted windows that a figure shows of a record
_OTHERS = 0.02  # probability from which on the curve of another model is drawn
_LAGS = 20


def draw_figures(document: Mapping[str, Any]) -> list[NamedFigure]:
    """The figures of a result document.

    Args:
        document: of any command that writes one.

    Raises:
        InputDataError: for a document that holds nothing to draw.

    >>> from imr_torch.results import draw_figures, header
    >>> curve = {"t_star": [0.0, 1.0], "R_star": [1.0, 0.2], "design": {"Rmax_m": 2e-4}, "time_s": [0.0, 2e-5]}
    >>> [figure.name for figure in draw_figures(header("simulate") | curve)]
    ['radius']
    """
    name = document.get("schema", {}).get("name", "without a schema")
    if name == "imr_torch characterize":
        return list(_characterization_figures(document))
    for keys, figures in _KINDS:
        if keys <= document.keys():
            return list(figures(document))
    raise InputDataError(
        f"The document ({name}) holds no curves or map to draw; figures are drawn from results of "
        "characterize, diagnose, design, campaign, batch, compare and simulate."
    )


def _characterization_figures(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    check_characterization(document)
    if document.get("record"):
        yield NamedFigure(
            "record",
            record_figures.CAPTION,
            record_figures.ALT,
            lambda: record_figures.record_figure(document["record"]),
        )
    for curve in document["curves"]:
        frames = curve["frames"]
        yield NamedFigure(
            f"curve_{file_name(curve['id'])}",
            f"{curve['id']}: measured radius, the fitted model and, below, residuals over their "
            f"noise (grey: up to 2). {frames['fitted']} of {frames['recorded']} frames were "
            "fitted; the others are pale.",
            f"Line chart of radius over time of {curve['id']} with its residuals.",
            lambda curve=curve: curve_figure(curve, document),
        )
    best = max(document["model_probabilities"], key=document["model_probabilities"].__getitem__)
    if document["curves"]:
        yield NamedFigure(
            "residuals",
            "Residuals over the noise of the fit: over time, over radius, their autocorrelation "
            "and their quantiles. A model that explains the curves leaves no pattern.",
            "Four charts of standardised residuals.",
            lambda: residuals_figure(document),
        )
    if document.get("collapse_times"):
        yield NamedFigure(
            "collapse_times",
            "Collapse time of each shot of which no more is known, less that of the most probable "
            "model, over maximum radius and stretch; bars: its error with the estimated scatter. A "
            "model that explains them leaves no trend.",
            "Two scatter charts of the residuals of collapse times.",
            lambda: collapse_figure(document),
        )
    prior, belief = (Belief.from_dict(document[name]) for name in ("prior", "belief"))
    names = belief[best].names
    for name in names:
        yield NamedFigure(
            f"parameter_{name}",
            f"Density of {name} before and after the data.",
            f"Line chart of the densities of {name}.",
            lambda name=name: plot_parameter(
                (("prior", prior[best]), ("posterior", belief[best])), name
            ),
        )
    if len(names) > 1:
        yield NamedFigure(
            "parameters",
            f"Posterior of the parameters of {material(best).title} together; contours hold 50 % "
            "and 90 %.",
            "Scatter plots of every pair of parameters.",
            lambda: draw_parameters(belief[best]),
        )
    yield from profile_named_figures(document)
    if document.get("population"):
        yield population_named_figure(document["population"])
    if len(belief.keys) > 1:
        yield NamedFigure(
            "models",
            "Probability of each model before and after the data.",
            "Bar chart of model probabilities.",
            lambda: plot_probabilities((("prior", prior), ("posterior", belief))),
        )


def _design_figures(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    for number, step in enumerate([document, *document.get("further", ())], start=1):
        design = step["design"]
        yield NamedFigure(
            "information" if number == 1 else f"information_{number}",
            "Expected information gain over designs; dots: evaluated, star: chosen.",
            f"Map; the star is at We {design['We']:.0f}, R_inf* {design['R_inf*']:.3f}.",
            lambda step=step: draw_information(step["map"], step["evaluations"], step["design"]),
        )


def _simulation_figures(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    yield NamedFigure(
        "radius",
        "Radius over time.",
        "Line chart of R over t.",
        lambda: radius_figure(document),
    )


def _diagnosis_figures(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    for figure in gap_figures(document):
        yield NamedFigure(figure.name, figure.caption, figure.alt, figure.draw)


_KINDS: tuple[tuple[set[str], Callable[[Mapping[str, Any]], Iterable[NamedFigure]]], ...] = (
    ({"history", "searches"}, campaign_figures),
    ({"curves", "belief"}, _characterization_figures),
    ({"curves", "verdict"}, _diagnosis_figures),
    ({"evaluations", "map"}, _design_figures),
    ({"R_star", "t_star"}, _simulation_figures),
    ({"shots"}, shots_figures),
    ({"log_bayes_factor", "parameters"}, compared_figures),
)
"""Keys of a document -> its figures; the first whose keys it has."""


def radius_figure(document: Mapping[str, Any]) -> Figure:
    """The curve of a simulated bubble, in t* and R* with us and um as second axes."""
    figure, ax = plt.subplots(figsize=(5.8, 3.6), layout="constrained")
    ax.plot(document["t_star"], document["R_star"], color=MODEL, lw=1.5)
    ax.set(xlabel=T_STAR, ylabel=R_STAR, ylim=(0.0, None))
    last = document["t_star"][-1]
    with_lengths(ax, document["design"]["Rmax_m"], document["time_s"][-1] / last if last else 1.0)
    return figure


def curve_figure(curve: Mapping[str, Any], document: Mapping[str, Any]) -> Figure:
    """One measured curve with the fitted models, the predictive band, and the residuals below.

    Args:
        curve: an entry of ``curves``.
        document: the whole document.
    """
    figure, ax, below = curve_panels(curve["id"])
    probabilities = document["model_probabilities"]
    best = curve["band"]["model"]
    t, r, fitted = _measured(curve)
    fill_band(ax, curve["band"])
    shown = {"color": MODEL, "lw": 1.5}
    colors = iter(CYCLE[1:])
    for key in sorted(curve["models"], key=lambda key: -probabilities[key]):
        if key != best and probabilities[key] < _OTHERS:
            continue
        model = curve["models"][key]
        style = shown if key == best else {"color": next(colors, PALE), "lw": 1.0, "ls": "--"}
        times, radius = floats(model["t_star"]), floats(model["R_star"])
        ax.plot(times, radius, label=material(key).title, zorder=3, **style)
    for chosen, color, label, order in (
        (~fitted, PALE, "not fitted", 2),
        (fitted, DATA, "fitted", 4),
    ):
        label = f"{label} ({int(chosen.sum())})"
        ax.plot(t[chosen], r[chosen], ".", ms=4, color=color, label=label, zorder=order)
    if "asphericity" in curve["measured"]:
        shape = ax.twinx()
        shape.plot(t, floats(curve["measured"]["asphericity"]), "x", ms=3, color=CYCLE[1])
        shape.set_ylabel("asphericity $a/b - 1$", color=CYCLE[1])
    end = float(t[fitted].max())
    last = min(float(t.max()), _FARTHER * end)
    first = max(min(float(t.min()), 0.0), -0.25 * end)
    if hidden := int(((t > last + 1e-12) | (t < first - 1e-12)).sum()):
        text = f"{hidden} more frames not shown"
        ax.annotate(text, (0.99, 0.03), xycoords="axes fraction", ha="right", fontsize=7)
    margin = 0.02 * (last - first)
    ax.set(ylim=(0.0, 1.08 * max(1.0, float(r.max()))), xlim=(first - margin, last + margin))
    ax.legend(frameon=False, fontsize=8, ncols=2, loc="upper right")
    if last > 1.02 * end:
        for panel in (ax, below):
            panel.axvspan(end, last + margin, color="#F4F4F4", lw=0, zorder=0)
    with_lengths(ax, curve["Rmax_m"], curve["time_scale_s"])
    left = floats(curve["models"][best]["residual_over_sd"])
    below.axhline(0.0, color=DATA, lw=0.6)
    below.vlines(t[fitted], 0.0, left, color=MODEL, lw=0.8)
    below.plot(t[fitted], left, ".", ms=4, color=MODEL)
    return figure


def residuals_figure(document: Mapping[str, Any]) -> Figure:
    """Standardised residuals of the most probable model over t* and R*, their autocorrelation, and
    their quantiles.
    """
    figure, axes = plt.subplots(2, 2, figsize=(5.8, 5.0), layout="constrained")
    rows = []
    for curve in document["curves"]:
        t, r, fitted = _measured(curve)
        model = curve["models"][curve["band"]["model"]]
        predicted = r[fitted] - floats(model["residual"])
        rows.append((t[fitted], predicted, floats(model["residual_over_sd"])))
    for column, label in ((0, T_STAR), (1, f"{R_STAR} of the model")):
        ax = axes[0][column]
        ax.axhspan(-2.0, 2.0, **NOISE_BAND)
        ax.axhline(0.0, color=DATA, lw=0.6)
        ax.set_prop_cycle(color=CYCLE)
        for row in rows:
            ax.plot(row[column], row[2], ".", ms=4, alpha=0.7)
        ax.set(xlabel=label, ylabel="residual / noise")
    _plot_autocorrelation(rows, float(document["noise"]["correlation_time"]), axes[1][0])
    _plot_quantiles(np.concatenate([row[2] for row in rows]), axes[1][1])
    return figure


def _plot_autocorrelation(
    rows: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], memory: float, ax: Axes
) -> None:
    """Autocorrelation over lags in frames, pooled over curves, with what the noise law assumes."""
    count = min(_LAGS, max(len(row[0]) for row in rows) - 2)
    total = np.zeros(count + 1)
    pairs = np.zeros(count + 1)
    for _, _, z in rows:
        for sums, values in ((total, np.nan_to_num(z)), (pairs, np.isfinite(z).astype(float))):
            lagged = np.correlate(values, values, "full")[len(z) - 1 :][: count + 1]
            sums[: len(lagged)] += lagged
    pairs = np.maximum(pairs, 1.0)
    values = total / pairs / max(total[0] / pairs[0], 1e-300)
    lags = np.arange(1, count + 1)
    width = 1.96 / np.sqrt(pairs[1:])
    ax.axhline(0.0, color=DATA, lw=0.6)
    ax.fill_between(lags, -width, width, label="95 % if independent", **NOISE_BAND)
    ax.vlines(lags, 0.0, values[1:], color=MODEL, lw=1.2)
    ax.plot(lags, values[1:], ".", color=MODEL, ms=6, label="residuals")
    if memory > 0.0:
        step = float(np.median(np.concatenate([np.diff(t) for t, _, _ in rows])))
        assumed = f"noise law, {memory:.3g} in $t^*$"
        ax.plot(lags, np.exp(-lags * step / memory), color=CYCLE[1], ls="--", lw=1.2, label=assumed)
    ax.set(xlabel="lag (frames)", ylabel="autocorrelation", ylim=(-1.0, 1.05))
    ax.legend(frameon=False, fontsize=7)


def _plot_quantiles(values: np.ndarray, ax: Axes) -> None:
    z = np.sort(values[np.isfinite(values)])
    expected = ndtri((np.arange(len(z)) + 0.5) / len(z))
    ax.axline((0.0, 0.0), slope=1.0, color=DATA, lw=0.8)
    ax.plot(expected, z, ".", ms=4, color=MODEL)
    inner = 1.15 * float(expected[-1])
    reach = 1.1 * max(3.0, float(np.abs(z).max()))
    ax.set(xlim=(-inner, inner), ylim=(-reach, reach))
    ax.set(xlabel="quantile of the standard normal", ylabel="residual / noise")


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
    left = [x["t_star"] - x["predicted"] for x in shots]
    sd = [np.hypot(x["sd"], x["scatter"]) for x in shots]
    for ax, values, label in (
        (axes[0], [1e6 * x["Rmax_m"] for x in shots], r"$R_\mathrm{max}$ (µm)"),
        (axes[1], [1.0 / x["R_inf*"] for x in shots], r"$R_\mathrm{max}/R_\infty$"),
    ):
        ax.axhline(0.0, color=DATA, lw=0.6)
        ax.errorbar(values, left, sd, fmt=".", ms=5, color=MODEL, elinewidth=0.7)
        ax.set_xlabel(label)
    axes[0].set_ylabel(f"collapse time, measured less\nmodel ({T_STAR})")
    return figure


def _measured(curve: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    seen = curve["measured"]
    return floats(seen["t_star"]), floats(seen["R_star"]), np.asarray(seen["fitted"], dtype=bool)
