"""The figures of a campaign, drawn from its document alone."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from imr_torch.labels import R_STAR, T_STAR, plain
from imr_torch.material import Belief, material
from imr_torch.plot import (
    DATA,
    MODEL,
    draw_information,
    plot_parameter,
    plot_probabilities,
    with_lengths,
)
from imr_torch.results.named import NamedFigure, figure_of
from imr_torch.results.population import population_named_figure

_CAUSES, _LEAST_SHOWN = (
    6,
    0.02,
)  # causes that are drawn, and the probability that each must reach once
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
            lambda: figure_of(plot_probabilities(history)),
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
            lambda name=name, shown=shown: figure_of(
                plot_parameter(shown, name, truth=truth.get(name))
            ),
        )
    for search in document["searches"]:
        yield NamedFigure(
            f"information_{search['step']:03d}",
            f"Expected information gain before experiment {search['step']}, and the design that "
            "was chosen.",
            f"Map over We and R_inf/Rmax; chosen is We {search['design']['We']:.0f}, "
            f"{search['design']['R_inf*']:.3f}.",
            lambda s=search: figure_of(draw_information(s["map"], s["evaluations"], s["design"])),
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
    t = np.asarray(curve["t_star"])
    band = {k: _floats(curve["band"][k]) for k in ("low", "median", "high")}
    drawn = np.asarray(
        curve["band"].get("t_star", t)
    )  # older documents have the band at the frames
    alpha = 0.5 if curve["repeats"] == 1 else 0.15
    for row in curve["R_star"]:
        ax.plot(t, _floats(row), ".", ms=3, color=DATA, alpha=alpha)
    ax.fill_between(
        drawn, band["low"], band["high"], color=MODEL, alpha=0.25, lw=0, label="90 % predictive"
    )
    ax.plot(drawn, band["median"], color=MODEL, lw=1.5, label="median")
    ax.set(xlabel=T_STAR, ylabel=R_STAR, ylim=(0.0, None))
    ax.legend(frameon=False, fontsize=8)
    with_lengths(ax, curve["Rmax_m"], curve["time_scale_s"])
    figure.suptitle(plain(f"{curve['number']}: {curve['id']}"), fontsize=10)
    return figure


def causes_figure(findings: Sequence[Mapping[str, Any]]) -> Figure:
    """The probability of each cause after each experiment; a cross where no test found a gap."""
    figure, ax = plt.subplots(figsize=(5.8, 3.6), layout="constrained")
    steps = [found["step"] for found in findings]
    largest = Counter[str]()
    for found in findings:
        largest |= Counter(
            {name: p for name, p in found["probabilities"].items() if p >= _LEAST_SHOWN}
        )
    for (name, _), marker in zip(largest.most_common(_CAUSES), "osD^vP", strict=False):
        rows = [
            found["probabilities"].get(name, 0.0 if found["probabilities"] else np.nan)
            for found in findings
        ]
        known = name not in ("none", "other")
        (line,) = ax.plot(
            steps,
            rows,
            marker=marker,
            ms=5,
            ls="-" if known else "--",
            label=plain(name.replace("_", " ")),
        )
        if not known:
            line.set_color("0.5")
    without = [
        step for step, found in zip(steps, findings, strict=True) if not found["probabilities"]
    ]
    if without:
        ax.plot(without, np.zeros(len(without)), "kx", label="no gap found")
    ax.set(xlabel="experiments", ylabel="probability", ylim=(-0.03, 1.03), xticks=steps)
    ax.legend(frameon=False, fontsize=8)
    return figure


def _floats(values: Any) -> np.ndarray:
    return np.asarray([np.nan if v is None else v for v in values], dtype=float)
