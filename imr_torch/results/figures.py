"""The figures of a result document, drawn from the document alone.

``draw_figures`` lists every figure of a document with a name, a caption and an alternative text;
each is drawn on its own, so that one that fails costs no other. Frames that were not fitted are
pale.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ndtri

from imr_torch.errors import InputDataError
from imr_torch.gap.figures import gap_figures
from imr_torch.labels import R_STAR, T_STAR, file_name, plain
from imr_torch.material import Belief, material
from imr_torch.plot import (
    DATA,
    MODEL,
    PALE,
    SECOND,
    TRUTH,
    draw_information,
    draw_parameters,
    plot_parameter,
    plot_probabilities,
    with_lengths,
)
from imr_torch.results.campaign_figures import campaign_figures
from imr_torch.results.collapse import collapse_figure
from imr_torch.results.named import NamedFigure, figure_of
from imr_torch.results.population import population_named_figure
from imr_torch.results.profile import profile_named_figures
from imr_torch.results.whole import check_characterization

_FARTHER = 2.0  # fitted windows that a figure shows of a record
_OTHERS = 0.02  # probability from which on the curve of another model is drawn
_LAGS = 20


def draw_figures(document: Mapping[str, Any]) -> list[NamedFigure]:
    """The figures of a result document.

    Args:
        document: of ``characterize``, ``diagnose``, ``design``, ``campaign`` or ``simulate``.

    Raises:
        InputDataError: for a document that holds nothing to draw.

    >>> from imr_torch.results import draw_figures, header
    >>> curve = {"t_star": [0.0, 1.0], "R_star": [1.0, 0.2], "design": {"Rmax_m": 2e-4}, "time_s": [0.0, 2e-5]}
    >>> [figure.name for figure in draw_figures(header("simulate") | curve)]
    ['radius']
    """
    if "history" in document and "searches" in document:
        return list(campaign_figures(document))
    if document.get("schema", {}).get("name") == "imr_torch characterize" or (
        "curves" in document and "belief" in document
    ):
        check_characterization(document)
        return list(_of_characterization(document))
    if "curves" in document and "verdict" in document:
        return [NamedFigure(f.name, f.caption, f.alt, f.draw) for f in gap_figures(document)]
    if "evaluations" in document and "map" in document:
        return list(_of_design(document))
    if "R_star" in document and "t_star" in document:
        return [
            NamedFigure(
                "radius",
                "Radius over time.",
                "Line chart of R over t.",
                lambda: radius_figure(document),
            )
        ]
    name = document.get("schema", {}).get("name", "without a schema")
    raise InputDataError(
        f"The document ({name}) holds no curves or map to draw; figures are drawn from results of "
        "characterize, diagnose, "
        "design, campaign and simulate."
    )


def _of_characterization(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    for curve in document["curves"]:
        frames = curve["frames"]
        yield NamedFigure(
            f"curve_{file_name(curve['id'])}",
            f"{curve['id']}: measured radius, the fitted model and, below, residuals over their "
            "noise (grey: up to 2). "
            f"{frames['fitted']} of {frames['recorded']} frames were fitted; the others are pale.",
            f"Line chart of radius over time of {curve['id']} with its residuals.",
            lambda curve=curve: curve_figure(curve, document),
        )
    best = max(document["model_probabilities"], key=document["model_probabilities"].__getitem__)
    if document["curves"]:
        yield NamedFigure(
            "residuals",
            "Residuals over the noise of the fit: over time, over radius, their autocorrelation "
            "and their quantiles. A model "
            "that explains the curves leaves no pattern.",
            "Four charts of standardised residuals.",
            lambda: residuals_figure(document),
        )
    if document.get("collapse_times"):
        yield NamedFigure(
            "collapse_times",
            "Collapse time of each shot of which no more is known, less that of the most probable "
            "model, over maximum radius "
            "and stretch; bars: its error with the estimated scatter. A model that explains them "
            "leaves no trend.",
            "Two scatter charts of the residuals of collapse times.",
            lambda: collapse_figure(document),
        )
    prior = Belief.from_dict(document["prior"])
    belief = Belief.from_dict(document["belief"])
    names = belief[best].names
    for name in names:
        yield NamedFigure(
            f"parameter_{name}",
            f"Density of {name} before and after the data.",
            f"Line chart of the densities of {name}.",
            lambda name=name: figure_of(
                plot_parameter((("prior", prior[best]), ("posterior", belief[best])), name)
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
        beliefs = (("prior", prior), ("posterior", belief))
        yield NamedFigure(
            "models",
            "Probability of each model before and after the data.",
            "Bar chart of model probabilities.",
            lambda: figure_of(plot_probabilities(beliefs)),
        )


def _of_design(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    steps = [document, *document.get("further", ())]
    for number, step in enumerate(steps, start=1):
        yield NamedFigure(
            "information" if number == 1 else f"information_{number}",
            "Expected information gain over designs; dots: evaluated, star: chosen.",
            f"Map; the star is at We {step['design']['We']:.0f}, R_inf* "
            f"{step['design']['R_inf*']:.3f}.",
            lambda step=step: figure_of(
                draw_information(step["map"], step["evaluations"], step["design"])
            ),
        )


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
    figure, (ax, below) = plt.subplots(
        2, 1, figsize=(5.8, 4.8), height_ratios=[3, 1], sharex=True, layout="constrained"
    )
    probabilities = document["model_probabilities"]
    best = curve["band"]["model"]
    t, r, fitted = _measured(curve)
    band = curve["band"]
    low = _floats(band["low"])
    high = _floats(band["high"])
    ax.fill_between(
        _floats(band["t_star"]), low, high, color=MODEL, alpha=0.22, lw=0, label="90 % predictive"
    )
    colors = iter((SECOND, TRUTH, "#009E73", "#CC79A7"))
    for key in sorted(curve["models"], key=lambda key: -probabilities[key]):
        if key != best and probabilities[key] < _OTHERS:
            continue
        style = (
            {"color": MODEL, "lw": 1.5}
            if key == best
            else {"color": next(colors, PALE), "lw": 1.0, "ls": "--"}
        )
        model = curve["models"][key]
        ax.plot(
            _floats(model["t_star"]),
            _floats(model["R_star"]),
            label=f"{material(key).title}",
            zorder=3,
            **style,
        )
    ax.plot(
        t[~fitted],
        r[~fitted],
        ".",
        ms=4,
        color=PALE,
        label=f"not fitted ({int((~fitted).sum())})",
        zorder=2,
    )
    ax.plot(
        t[fitted],
        r[fitted],
        ".",
        ms=4.5,
        color=DATA,
        label=f"fitted ({int(fitted.sum())})",
        zorder=4,
    )
    if "asphericity" in curve["measured"]:
        shape = ax.twinx()
        shape.plot(t, _floats(curve["measured"]["asphericity"]), "x", ms=3, color=SECOND)
        shape.set_ylabel("asphericity $a/b - 1$", color=SECOND)
    end = float(t[fitted].max())
    start = float(min(t.min(), 0.0))
    shown = min(float(t.max()), _FARTHER * end)
    start = max(start, -0.25 * end)
    hidden = int(((t > shown + 1e-12) | (t < start - 1e-12)).sum())
    if hidden:
        ax.annotate(
            f"{hidden} more frames not shown",
            (0.99, 0.03),
            xycoords="axes fraction",
            ha="right",
            fontsize=7,
        )
    margin = 0.02 * (shown - start)
    ax.set(
        ylabel=R_STAR,
        ylim=(0.0, 1.08 * max(1.0, float(r.max()))),
        xlim=(start - margin, shown + margin),
    )
    ax.legend(frameon=False, fontsize=8, ncols=2, loc="upper right")
    if shown > 1.02 * end:
        for panel in (ax, below):
            panel.axvspan(end, shown + margin, color="#F4F4F4", lw=0, zorder=0)
    with_lengths(ax, curve["Rmax_m"], curve["time_scale_s"])
    left = _floats(curve["models"][best]["residual_over_sd"])
    below.axhspan(-2.0, 2.0, color="#E2E2E2", lw=0)
    below.axhline(0.0, color=DATA, lw=0.6)
    below.vlines(t[fitted], 0.0, left, color=MODEL, lw=0.8)
    below.plot(t[fitted], left, ".", ms=4, color=MODEL)
    below.set(xlabel=T_STAR, ylabel="residual\n/ noise")
    figure.suptitle(plain(curve["id"]), fontsize=10)
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
        rows.append(
            (t[fitted], r[fitted] - _floats(model["residual"]), _floats(model["residual_over_sd"]))
        )
    marker = {"marker": ".", "ls": "none", "ms": 4, "alpha": 0.7}
    for column, label in ((0, T_STAR), (1, f"{R_STAR} of the model")):
        ax = axes[0][column]
        ax.axhspan(-2.0, 2.0, color="#E2E2E2", lw=0)
        ax.axhline(0.0, color=DATA, lw=0.6)
        for number, row in enumerate(rows):
            ax.plot(
                row[column],
                row[2],
                color=(MODEL, SECOND, TRUTH, "#009E73", "#CC79A7")[number % 5],
                **marker,
            )
        ax.set(xlabel=label, ylabel="residual / noise")
    _autocorrelation(rows, float(document["noise"]["correlation_time"]), axes[1][0])
    _quantiles(np.concatenate([row[2] for row in rows]), axes[1][1])
    return figure


def _autocorrelation(
    rows: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], memory: float, ax: Axes
) -> None:
    """Autocorrelation over lags in frames, pooled over curves, with what the noise law assumes."""
    count = min(_LAGS, max(len(row[0]) for row in rows) - 2)
    lags = np.arange(1, count + 1)
    total = np.zeros(count)
    pairs = np.zeros(count)
    power = sum(float(np.nansum(z**2)) for _, _, z in rows) / max(
        1, sum(int(np.isfinite(z).sum()) for _, _, z in rows)
    )
    for _, _, z in rows:
        for i, lag in enumerate(lags):
            if lag < len(z):
                product = z[lag:] * z[:-lag]
                total[i] += np.nansum(product)
                pairs[i] += np.isfinite(product).sum()
    values = total / np.maximum(pairs, 1) / max(power, 1e-300)
    ax.axhline(0.0, color=DATA, lw=0.6)
    width = 1.96 / np.sqrt(np.maximum(pairs, 1))
    ax.fill_between(lags, -width, width, color="#E2E2E2", lw=0, label="95 % if independent")
    ax.vlines(lags, 0.0, values, color=MODEL, lw=1.2)
    ax.plot(lags, values, ".", color=MODEL, ms=6, label="residuals")
    if memory > 0.0:
        step = float(np.median(np.concatenate([np.diff(t) for t, _, _ in rows])))
        assumed = f"noise law, {memory:.3g} in $t^*$"
        ax.plot(lags, np.exp(-lags * step / memory), color=TRUTH, ls="--", lw=1.2, label=assumed)
    ax.set(xlabel="lag (frames)", ylabel="autocorrelation", ylim=(-1.0, 1.05))
    ax.legend(frameon=False, fontsize=7)


def _quantiles(values: np.ndarray, ax: Axes) -> None:
    z = np.sort(values[np.isfinite(values)])
    expected = ndtri((np.arange(len(z)) + 0.5) / len(z))
    reach = 1.1 * max(3.0, float(np.abs(z).max()), float(np.abs(expected).max()))
    ax.plot((-reach, reach), (-reach, reach), color=DATA, lw=0.8)
    ax.plot(expected, z, ".", ms=4, color=MODEL)
    inner = 1.15 * float(np.abs(expected).max())
    ax.set(
        xlabel="quantile of the standard normal",
        ylabel="residual / noise",
        xlim=(-inner, inner),
        ylim=(-reach, reach),
    )


def _measured(curve: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    seen = curve["measured"]
    return _floats(seen["t_star"]), _floats(seen["R_star"]), np.asarray(seen["fitted"], dtype=bool)


def _floats(values: Sequence[float | None]) -> np.ndarray:
    return np.asarray([math.nan if v is None else v for v in values], dtype=float)
