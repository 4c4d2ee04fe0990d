"""The figures of a diagnosis, drawn from its document alone."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from matplotlib.figure import Figure

from imr_torch.gap.plots import (
    BESIDE,
    DrawnStep,
    only_other,
    plot_causes,
    plot_explained,
    plot_scores,
    plot_selection,
)
from imr_torch.goodness.score import BlockResult, GapTest
from imr_torch.labels import file_name
from imr_torch.results.named import NamedFigure
from imr_torch.results.plot import DATA, MODEL, SECOND, curve_panels, floats


def diagnosis_figures(document: Mapping[str, Any]) -> Iterator[NamedFigure]:
    """Curves, tests, causes and effects together."""
    for curve in document["curves"]:
        yield NamedFigure(
            f"curve_{file_name(curve['id'])}",
            f"{curve['id']}: measured, the base model, and that with the cause or additions; "
            "below, residuals over noise.",
            f"Line chart of radius over time of {curve['id']}.",
            lambda curve=curve: diagnosis_figure(curve),
        )
    blocks = tuple(
        BlockResult(**row | {"power": math.nan if row["power"] is None else row["power"]})
        for row in document["tests"]
    )
    yield NamedFigure(
        "tests",
        "Tests of the base model's residual.",
        f"Bar chart of {len(blocks)} tests.",
        lambda: plot_scores(GapTest(document["p_gap"], blocks, document["bias_sigma"], 0.0)),
    )
    if (
        document["posterior"]
        and only_other(document["posterior"])
        and document.get("explained_nats")
    ):
        yield NamedFigure(
            "causes",
            "What a single further effect explains; none is enough. Light: its fit did not "
            "converge.",
            "Bar chart of log evidence gained.",
            lambda: plot_explained(document["explained_nats"], document["unconverged"]),
        )
    elif document["posterior"]:
        yield NamedFigure(
            "causes",
            "Probability of each cause.",
            "Bar chart of probabilities.",
            lambda: plot_causes(document["posterior"]),
        )
    if document.get("ladder"):
        steps = [
            DrawnStep(*(row[name] for name in DrawnStep._fields)) for row in document["ladder"]
        ]
        yield NamedFigure(
            "effects_together",
            "Misfit from the base model to the last effect added, and the share of the held-out "
            "gap that each step closes.",
            f"Bar chart of {len(steps)} misfits.",
            lambda: plot_selection(steps),
        )


def diagnosis_figure(curve: Mapping[str, Any]) -> Figure:
    """One mean measured curve with the base model and the model with the cause or with additions,
    and residuals below.
    """
    figure, ax, below = curve_panels(curve["id"])
    t, r, sd = (floats(curve[name]) for name in ("t_star", "R_star", "sd"))
    ax.plot(t, r, ".", ms=4, color=DATA, label="measured")
    for name, label in {"base": "base model", **BESIDE}.items():
        if curve.get(name) is None:
            continue
        color, style = (SECOND, "--") if name == "base" else (MODEL, "-")
        at_frames = {"t_star": curve["t_star"], "R_star": curve[name]}
        drawn = curve.get("drawn", {}).get(name, at_frames)
        times, radius = floats(drawn["t_star"]), floats(drawn["R_star"])
        ax.plot(times, radius, color=color, ls=style, lw=1.3, label=label)
        below.plot(t, (r - floats(curve[name])) / sd, color=color, ls=style, lw=1.2)
    ax.set_ylim(0.0, None)
    ax.legend(frameon=False, fontsize=8)
    return figure
