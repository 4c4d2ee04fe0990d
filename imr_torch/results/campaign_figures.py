"""The figures of a campaign, drawn from its document alone."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from imr_torch.labels import R_STAR, T_STAR, plain
from imr_torch.material import Belief, material
from imr_torch.results.named import NamedFigure
from imr_torch.results.plot import (
    DATA,
    MODEL,
    draw_information,
    fill_band,
    floats,
    plot_parameter,
    plot_probabilities,
    with_lengths,
)
from imr_torch.results.population import population_named_figure

_CAUSES = 6  # that are drawn
_LEAST_SHOWN = 0.02  # probability that a cause must reach once
_STEPS = 3  # beliefs beside the prior in the figure of a parameter


def campaign_figures(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    """Model probabilities and parameters step by step, the maps of the searches, and the curves."""
    if any(found["probabilities"] for found in document.get("findings", ())):
        yield NamedFigure(
            "causes",
            "Probability of each cause of the gap after each experiment.",
            "Line chart of the probabilities of the causes over the number of experiments.",
            lambda: causes_figure(document["findings"]),
        )
    if document.get("population"):
        yield population_named_figure(document["population"])
    history = [(step["label"], Belief.from_dict(step["belief"])) for step in document["history"]]
    best = history[-1][1].best
    truth = document.get("truth") or {}
    if len(history[-1][1].models) > 1 or not (
        document.get("findings") or document.get("goal") == "population"
    ):
        yield NamedFigure(
            "models",
            "Probability of each model before the first experiment and after each.",
            "Bar chart of model probabilities.",
            lambda: plot_probabilities(history),
        )
    for name in best.names:
        shown = [
            (label, belief[best.model]) for label, belief in (history[0], *history[1:][-_STEPS:])
        ]
        yield NamedFigure(
            f"parameter_{name}",
            f"Density of {name} before the first experiment and after the last ones."
            + " Dashed: the truth." * (name in truth),
            f"Line chart of the densities of {name}.",
            lambda name=name, shown=shown: plot_parameter(shown, name, truth=truth.get(name)),
        )
    for search in document["searches"]:
        yield NamedFigure(
            f"information_{search['step']:03d}",
            f"Expected information gain before experiment {search['step']}, and the design that "
            "was chosen.",
            f"Map over We and R_inf/Rmax; chosen is We {search['design']['We']:.0f}, "
            f"{search['design']['R_inf*']:.3f}.",
            lambda s=search: draw_information(s["map"], s["evaluations"], s["design"]),
        )
    for curve in document["curves"]:
        yield NamedFigure(
            f"curve_{curve['number']:03d}",
            f"Experiment {curve['number']} ({curve['id']}): {curve['repeats']} curve(s), and the "
            "90 % predictive band of "
            f"{material(curve['band']['model']).title}.",
            f"Line chart of radius over time of experiment {curve['number']}.",
            lambda curve=curve: campaign_curve_figure(curve),
        )


def campaign_curve_figure(curve: Mapping[str, Any]) -> Figure:
    """The curves of one experiment with the predictive band."""
    figure, ax = plt.subplots(figsize=(5.8, 3.8), layout="constrained")
    band = curve["band"]
    alpha = 0.5 if curve["repeats"] == 1 else 0.15
    radius = floats(curve["R_star"]).T
    ax.plot(curve["t_star"], radius, ".", ms=3, color=DATA, alpha=alpha)
    fill_band(ax, band)
    ax.plot(floats(band["t_star"]), floats(band["median"]), color=MODEL, lw=1.5, label="median")
    ax.set(xlabel=T_STAR, ylabel=R_STAR, ylim=(0.0, None))
    ax.legend(frameon=False, fontsize=8)
    with_lengths(ax, curve["Rmax_m"], curve["time_scale_s"])
    figure.suptitle(plain(f"{curve['number']}: {curve['id']}"), fontsize=10)
    return figure


def causes_figure(findings: Sequence[Mapping[str, Any]]) -> Figure:
    """The probability of each cause after each experiment; a cross where no test found a gap."""
    figure, ax = plt.subplots(figsize=(5.8, 3.6), layout="constrained")
    steps = [found["step"] for found in findings]
    rows = [found["probabilities"] for found in findings]
    largest = {name: max(row.get(name, 0.0) for row in rows) for row in rows for name in row}
    shown = sorted((n for n in largest if largest[n] >= _LEAST_SHOWN), key=lambda n: -largest[n])
    for name, marker in zip(shown, "osD^vP"[:_CAUSES], strict=False):
        values = [row.get(name, 0.0) if row else np.nan for row in rows]
        style: dict[str, Any] = {"ls": "--", "color": "0.5"} if name in ("none", "other") else {}
        label = plain(name.replace("_", " "))
        ax.plot(steps, values, marker=marker, ms=5, label=label, **style)
    without = [step for step, row in zip(steps, rows, strict=True) if not row]
    if without:
        ax.plot(without, np.zeros(len(without)), "kx", label="no gap found")
    ax.set(xlabel="experiments", ylabel="probability", ylim=(-0.03, 1.03), xticks=steps)
    ax.legend(frameon=False, fontsize=8)
    return figure
