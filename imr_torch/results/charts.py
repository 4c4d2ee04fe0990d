"""Charts of curves and their residuals, drawn from a result document. Frames that were not fitted
are pale.
"""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imr_torch.drawing import (
    CYCLE,
    DATA,
    MODEL,
    NOISE_BAND,
    PALE,
    add_legend,
    add_lengths,
    curve_panels,
    floats,
    mark_zero,
    new_axes,
)
from imr_torch.files import Document
from imr_torch.labels import R_STAR, T_STAR, plain
from imr_torch.material import material
from imr_torch.results.plot import fill_band


def radius_chart(document: Document) -> Axes:
    """The curve of a simulated bubble, in t* and R* with us and um as second axes."""
    ax = new_axes((5.8, 3.6))
    ax.plot(document["t_star"], document["R_star"], color=MODEL, lw=1.5)
    ax.set(xlabel=T_STAR, ylabel=R_STAR, ylim=(0.0, None))
    last = document["t_star"][-1]
    add_lengths(
        ax, document["design"]["Rmax_m"], document["time_s"][-1] / last if last else 1.0
    )
    return ax


def campaign_curve(curve: Document) -> Axes:
    """The curves of one experiment of a campaign with the predictive band."""
    ax = new_axes((5.8, 3.8))
    rows = floats(curve["R_star"])
    alpha = 0.5 if len(rows) == 1 else 0.15
    ax.plot(curve["t_star"], rows.T, ".", ms=3, color=DATA, alpha=alpha)
    band = curve["band"]
    fill_band(ax, band)
    ax.plot(
        floats(band["t_star"]), floats(band["median"]), color=MODEL, lw=1.5, label="median"
    )
    add_legend(ax)
    ax.set(xlabel=T_STAR, ylabel=R_STAR, ylim=(0.0, None))
    add_lengths(ax, curve["Rmax_m"], curve["time_scale_s"])
    ax.set_title(plain(f"{curve['number']}: {curve['id']}"), fontsize=10)
    return ax


def curve_figure(curve: Document, document: Document) -> Figure:
    """One measured curve with the fitted models, the predictive band, and the residuals below.

    Args:
        curve: an entry of ``curves``.
        document: the whole document.
    """
    figure, ax, below = curve_panels(curve["id"])
    t, r, fitted = _measured_frames(curve)
    fill_band(ax, curve["band"])
    _plot_models(curve, document["model_probabilities"], ax)
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
    last = min(float(t.max()), 2.0 * end)  # as long again as the fitted window
    first = max(min(float(t.min()), 0.0), -0.25 * end)
    if hidden := int(((t > last + 1e-12) | (t < first - 1e-12)).sum()):
        text = f"{hidden} more frames not shown"
        ax.annotate(text, (0.99, 0.03), xycoords="axes fraction", ha="right", fontsize=7)
    margin = 0.02 * (last - first)
    ax.set(
        ylim=(0.0, 1.08 * max(1.0, float(r.max()))), xlim=(first - margin, last + margin)
    )
    add_legend(ax, ncols=2, loc="upper right")
    if last > 1.02 * end:
        for panel in (ax, below):
            panel.axvspan(end, last + margin, color="#F4F4F4", lw=0, zorder=0)
    add_lengths(ax, curve["Rmax_m"], curve["time_scale_s"])
    left = floats(curve["models"][curve["band"]["model"]]["residual_over_sd"])
    mark_zero(below)
    below.vlines(t[fitted], 0.0, left, color=MODEL, lw=0.8)
    below.plot(t[fitted], left, ".", ms=4, color=MODEL)
    return figure


def _plot_models(curve: Document, probabilities: Mapping[str, float], ax: Axes) -> None:
    """The most probable model, and dashed those that are not improbable."""
    colors = iter(CYCLE[1:])
    for key in sorted(curve["models"], key=lambda key: -probabilities[key]):
        style: Document = {"color": MODEL, "lw": 1.5}
        if key != curve["band"]["model"]:
            if probabilities[key] < 0.02:  # too improbable to be drawn
                continue
            style = {"color": next(colors, PALE), "lw": 1.0, "ls": "--"}
        times, radius = (
            floats(curve["models"][key][name]) for name in ("t_star", "R_star")
        )
        ax.plot(times, radius, label=material(key).title, zorder=3, **style)


def residuals_figure(document: Document) -> Figure:
    """Standardised residuals of the most probable model over t* and R*."""
    figure, axes = plt.subplots(1, 2, figsize=(5.8, 2.7), sharey=True, layout="constrained")
    for ax, label in zip(axes, (T_STAR, f"{R_STAR} of the model"), strict=True):
        ax.axhspan(-2.0, 2.0, **NOISE_BAND)
        mark_zero(ax)
        ax.set_prop_cycle(color=CYCLE)
        ax.set_xlabel(label)
    axes[0].set_ylabel("residual / noise")
    for curve in document["curves"]:
        t, r, fitted = _measured_frames(curve)
        model = curve["models"][curve["band"]["model"]]
        left = floats(model["residual_over_sd"])
        axes[0].plot(t[fitted], left, ".", ms=4, alpha=0.7)
        axes[1].plot(r[fitted] - floats(model["residual"]), left, ".", ms=4, alpha=0.7)
    return figure


def collapse_figure(document: Document) -> Figure:
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
        mark_zero(ax)
        ax.errorbar(values, left, sd, fmt=".", ms=5, color=MODEL, elinewidth=0.7)
        ax.set_xlabel(label)
    axes[0].set_ylabel(f"collapse time, measured less\nmodel ({T_STAR})")
    return figure


def causes_chart(findings: Sequence[Document]) -> Axes:
    """The probability of each cause after each experiment; a cross where no test found a gap."""
    ax = new_axes((5.8, 3.6))
    steps = [found["step"] for found in findings]
    rows = [found["probabilities"] for found in findings]
    largest = {
        name: max(row.get(name, 0.0) for row in rows) for row in rows for name in row
    }
    shown = sorted((n for n in largest if largest[n] >= 0.02), key=lambda n: -largest[n])
    for name, marker in zip(shown, "osD^vP", strict=False):
        values = [row.get(name, 0.0) if row else np.nan for row in rows]
        style: Document = {"ls": "--", "color": "0.5"} if name in ("none", "other") else {}
        label = plain(name.replace("_", " "))
        ax.plot(steps, values, marker=marker, ms=5, label=label, **style)
    without = [step for step, row in zip(steps, rows, strict=True) if not row]
    if without:
        ax.plot(without, np.zeros(len(without)), "kx", label="no gap found")
    ax.set(xlabel="experiments", ylabel="probability", ylim=(-0.03, 1.03), xticks=steps)
    add_legend(ax)
    return ax


def _measured_frames(curve: Document) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    seen = curve["measured"]
    return (
        floats(seen["t_star"]),
        floats(seen["R_star"]),
        np.asarray(seen["fitted"], dtype=bool),
    )
