"""The figures of a campaign, drawn from its document alone."""

from collections.abc import Iterator, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from imr_torch.labels import R_STAR, T_STAR, plain
from imr_torch.material import Belief, material
from imr_torch.plot import DATA, MODEL, draw_information, plot_parameter, plot_probabilities, with_lengths
from imr_torch.results.named import NamedFigure, figure_of

_STEPS = 3  # beliefs beside the prior in the figure of a parameter


def campaign_figures(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    """Model probabilities and parameters step by step, the maps of the searches, and the curves."""
    history = [(step["label"], Belief.from_dict(step["belief"])) for step in document["history"]]
    best, truth = history[-1][1].best, document.get("truth") or {}
    yield NamedFigure(
        "models",
        "Probability of each model before the first experiment and after each.",
        "Bar chart of model probabilities.",
        lambda: figure_of(plot_probabilities(history)),
    )
    for name in best.names:
        shown = [(label, belief[best.model]) for label, belief in (history[0], *history[1:][-_STEPS:])]
        yield NamedFigure(
            f"parameter_{name}",
            f"Density of {name} before the first experiment and after the last ones." + " Dashed: the truth." * (name in truth),
            f"Line chart of the densities of {name}.",
            lambda name=name, shown=shown: figure_of(plot_parameter(shown, name, truth=truth.get(name))),
        )
    for search in document["searches"]:
        yield NamedFigure(
            f"information_{search['step']:03d}",
            f"Expected information gain before experiment {search['step']}, and the design that was chosen.",
            f"Map over We and R_inf/Rmax; chosen is We {search['design']['We']:.0f}, {search['design']['R_inf*']:.3f}.",
            lambda s=search: figure_of(draw_information(s["map"], s["evaluations"], s["design"])),
        )
    for curve in document["curves"]:
        yield NamedFigure(
            f"curve_{curve['number']:03d}",
            f"Experiment {curve['number']} ({curve['id']}): {curve['repeats']} curve(s), and the 90 % predictive band of "
            f"{material(curve['band']['model']).title}.",
            f"Line chart of radius over time of experiment {curve['number']}.",
            lambda curve=curve: campaign_curve_figure(curve),
        )


def campaign_curve_figure(curve: Mapping[str, Any]) -> Figure:
    """The curves of one experiment with the predictive band."""
    figure, ax = plt.subplots(figsize=(5.8, 3.8), layout="constrained")
    t, band = np.asarray(curve["t_star"]), {k: _floats(curve["band"][k]) for k in ("low", "median", "high")}
    alpha = 0.5 if curve["repeats"] == 1 else 0.15
    for row in curve["R_star"]:
        ax.plot(t, _floats(row), ".", ms=3, color=DATA, alpha=alpha)
    ax.fill_between(t, band["low"], band["high"], color=MODEL, alpha=0.25, lw=0, label="90 % predictive")
    ax.plot(t, band["median"], color=MODEL, lw=1.5, label="median")
    ax.set(xlabel=T_STAR, ylabel=R_STAR, ylim=(0.0, None))
    ax.legend(frameon=False, fontsize=8)
    with_lengths(ax, curve["Rmax_m"], curve["time_scale_s"])
    figure.suptitle(plain(f"{curve['number']}: {curve['id']}"), fontsize=10)
    return figure


def _floats(values: Any) -> np.ndarray:
    return np.asarray([np.nan if v is None else v for v in values], dtype=float)
