"""Figures of a diagnosis, from its document alone, each with the section that it stands in.

Colours are told apart by colour-blind readers, and what matters is also written.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imr_torch.gap.text import RECORD, SHRINKS, Document
from imr_torch.goodness.score import LEVEL
from imr_torch.labels import R_STAR, T_STAR, file_name, plain
from imr_torch.material import PARAMETERS
from imr_torch.record import figures as record_figures

DATA = "#222222"
BASE = "#E69F00"
AFTER = "#0072B2"
ALARM = "#D55E00"
PALE = "#AAAAAA"
_SMALLEST = 300.0  # -log10 p beyond which p-values are zero in float64
_LINEAR = 10.0  # -log10 p up to which axes are linear; logarithmic beyond
_BARS = 12
_ALL = 0.99  # probability of an unknown effect from which on others cannot be seen
_CURVES = 6  # that a page shows


@dataclass(frozen=True)
class GapFigure:
    """A figure of a diagnosis.

    Args:
        section: heading of the section that it stands in; ``"The curves"`` for those.
        name: for a file.
        caption: what it shows.
        alt: the same for who cannot see it.
        draw: makes the figure.

    >>> from imr_torch.gap.figures import GapFigure
    >>> GapFigure("The curves", "curve_1", "Measured.", "Line chart.", lambda: None).name
    'curve_1'
    """

    section: str
    name: str
    caption: str
    alt: str
    draw: Callable[[], Figure]


def gap_figures(document: Document, *, curves: int | None = None) -> Iterator[GapFigure]:
    """Every figure that a document allows, in the order of the page.

    Args:
        document: of a diagnosis (:func:`imr_torch.gap.to_json`).
        curves: that are drawn, at most; all by default.
    """
    if document.get("record"):
        yield GapFigure(
            RECORD,
            "record",
            record_figures.CAPTION,
            record_figures.ALT,
            lambda: record_figures.record_figure(document["record"]),
        )
    for curve in document["curves"][:curves]:
        beside = "" if curve["selected"] is None else f" and that with {_selected(document)}"
        yield GapFigure(
            "The curves",
            f"curve_{file_name(curve['id'])}",
            f"{curve['id']}: measured, the base model{beside}; below, residuals over noise (grey: "
            "up to 2).",
            f"Line chart of radius over time of {curve['id']}, with residuals.",
            lambda curve=curve: curve_figure(curve, _selected(document)),
        )
    yield _figure(
        "Is there a gap?",
        "tests",
        "Tests of the base model's residual: longer bars are smaller p; beyond the dashed line one "
        "test shows a gap.",
        f"Bar chart of {len(document['tests'])} tests; the longest bar is "
        f"{document['tests'][0]['name']}.",
        lambda ax: plot_tests(document["tests"], ax=ax),
    )
    if document["examined"]:
        yield from _of_place(document)
    if document["posterior"]:
        yield _of_causes(document)
    if document["shrinkage"] and document["shrinkage"]["share"]:
        yield _figure(
            SHRINKS,
            "shrinkage",
            "Part of the gap on unseen curves that goes with what was selected (dot, 90 % "
            "interval), and up to where 95 % of random libraries close it (grey).",
            "Intervals on a line from 0 to 1; the sentences above give the numbers.",
            lambda ax: plot_shrinkage(document["shrinkage"], ax=ax),
        )
    if document["parameters_with_model_error"]:
        yield _figure(
            "Verdict",
            "parameters",
            "Parameters of the gel: 90 % intervals if the model is right, and with what it may "
            "lack, relative to the median.",
            "Two intervals a parameter; the sentences above give the numbers.",
            lambda ax: plot_intervals(document, ax=ax),
        )


def _selected(document: Document) -> str:
    return " and ".join(document["selected"]).replace("gel_scatter", "differences between shots")


def _figure(
    section: str, name: str, caption: str, alt: str, draw: Callable[[Axes | None], Axes]
) -> GapFigure:
    def made() -> Figure:
        figure = draw(None).figure
        assert isinstance(figure, Figure)
        return figure

    return GapFigure(section, name, caption, alt, made)


def _of_place(document: Document) -> Iterator[GapFigure]:
    """Where the gap lies."""
    where = "Where does it lie?"
    yield _figure(
        where,
        "phases",
        "Residual of the base model by experiment and phase; 1 is noise alone. Where a residual "
        "sits is not where its cause acts, because the fit spreads it.",
        f"Map of residuals over {len(document['curves'])} experiments and five phases.",
        lambda ax: plot_phase_residual(document, ax=ax),
    )
    yield _figure(
        where,
        "onset",
        "Refits to the frames up to each moment: the first that rejects the model is the first "
        "detection.",
        f"Line chart. {document['onset']['sentence']}",
        lambda ax: plot_onset(document["onset"], ax=ax),
    )
    if document["acts"]:
        yield _figure(
            where,
            "acts",
            "Share of the signal of the named effects by phase, with its 90 % interval.",
            f"Bar chart. {document['acts']['sentence']}",
            lambda ax: plot_acts(document["acts"]["shares"], ax=ax),
        )


def _of_causes(document: Document) -> GapFigure:
    """Probability of each cause; where none is known to be likely, what each explains by itself."""
    posterior = document["posterior"]
    section = "Which effect causes it?"
    if posterior.get("other", 0.0) > _ALL:
        return _figure(
            section,
            "causes",
            "What one part more explains; none is enough. Light: its fit did not converge.",
            "Bar chart of log evidence gained.",
            lambda ax: plot_explained(document["explained_nats"], document["unconverged"], ax=ax),
        )
    top = max(posterior, key=posterior.__getitem__)
    return _figure(
        section,
        "causes",
        "Probability of each cause.",
        f"Bar chart of probabilities; the largest is that of {top}.",
        lambda ax: plot_causes(posterior, ax=ax),
    )


def _axes(ax: Axes | None, size: tuple[float, float] = (5.2, 3.4)) -> Axes:
    return ax if ax is not None else plt.subplots(figsize=size, layout="constrained")[1]


def _strength(p_value: float) -> float:
    """How small a p-value is, in powers of ten."""
    return -math.log10(max(p_value, 10.0**-_SMALLEST))


def curve_figure(curve: Mapping[str, Any], selected: str) -> Figure:
    """One mean measured curve with the base model and the model with what was selected, and
    residuals below.

    Args:
        curve: an entry of ``curves``.
        selected: what was selected, in words.
    """
    figure, (ax, below) = plt.subplots(
        2, 1, figsize=(5.2, 4.4), height_ratios=[2, 1], sharex=True, layout="constrained"
    )
    t, r, sd = (_floats(curve[name]) for name in ("t_star", "R_star", "sd"))
    ax.plot(t, r, ".", ms=4, color=DATA, label="measured")
    below.axhspan(-2.0, 2.0, color="#E2E2E2", lw=0)
    shown = (("base", "base model", BASE, "--"), ("selected", f"with {selected}", AFTER, "-"))
    for name, label, color, style in shown:
        if curve.get(name) is None:
            continue
        at_frames = {"t_star": curve["t_star"], "R_star": curve[name]}
        drawn = curve.get("drawn", {}).get(name, at_frames)
        times = _floats(drawn["t_star"])
        ax.plot(times, _floats(drawn["R_star"]), color=color, ls=style, lw=1.3, label=plain(label))
        below.plot(t, (r - _floats(curve[name])) / sd, color=color, ls=style, lw=1.2)
    ax.set(ylabel=R_STAR, ylim=(0.0, None))
    ax.set_title(plain(curve["id"]), fontsize=10)
    ax.legend(frameon=False, fontsize=8)
    below.set(xlabel=T_STAR, ylabel="residual / noise")
    return figure


def _floats(values: Sequence[float | None]) -> np.ndarray:
    return np.array([math.nan if value is None else value for value in values], dtype=float)


def plot_phase_residual(document: Document, *, ax: Axes | None = None) -> Axes:
    """Size of the residual of the base model: a map over experiments and phases, 1 being noise
    alone.
    """
    phases = document["phase_residual"]["phases"]
    values = np.array([_floats(row) for row in document["phase_residual"]["rows"]])
    ax = _axes(ax, (5.8, 1.4 + 0.36 * len(values)))
    top = max(3.0, float(np.nan_to_num(values).max()))
    image = ax.imshow(values, cmap="Blues", vmin=0.0, vmax=top, aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if not math.isnan(value):
            color = "white" if value > 0.6 * top else "black"
            ax.text(j, i, f"{value:.1f}", ha="center", va="center", fontsize=8, color=color)
    ax.set_xticks(range(len(phases)), [phase.replace(" ", "\n") for phase in phases], fontsize=8)
    labels = [plain(curve["id"], 24) for curve in document["curves"]]
    ax.set_yticks(range(len(values)), labels, fontsize=8)
    ax.figure.colorbar(image, ax=ax, label="rms residual / noise")
    return ax


def plot_tests(tests: Sequence[Mapping[str, Any]], *, ax: Axes | None = None) -> Axes:
    """P-values of the blocks of a gap test, smallest first."""
    shown = tests[:_BARS]
    ax = _axes(ax, (6.4, 1.0 + 0.27 * len(shown)))
    strength = [_strength(row["p_value"]) for row in shown]
    limit = -math.log10(LEVEL / len(tests))
    places = range(len(shown) - 1, -1, -1)
    colors = [ALARM if s > limit else PALE for s in strength]
    ax.barh(places, strength, color=colors, height=0.7)
    ax.axvline(limit, color=DATA, ls="--", lw=1)
    for place, s in zip(places, strength, strict=True):
        ax.text(s, place, f" {'> ' if s == _SMALLEST else ''}{s:.3g}", va="center", fontsize=7)
    ax.set_yticks(places, [plain(row["name"]) for row in shown], fontsize=8)
    ax.set(xlabel="$-\\log_{10} p$  (dashed: 4 % over all)")
    ax.set(xlim=(0.0, 10.0 * max(*strength, limit)))
    ax.set_xscale("symlog", linthresh=_LINEAR)
    return ax


def plot_onset(found: Mapping[str, Any], *, ax: Axes | None = None) -> Axes:
    """P-value of a refit to the frames up to each moment.

    The first below the level is the first detection.
    """
    ax = _axes(ax)
    strength = [_strength(p) for p in found["p_values"]]
    level = found["level"]
    ax.plot(found["times"], strength, "o-", color=AFTER, ms=4)
    label = f"{100 * level:g} % over the whole event"
    ax.axhline(-math.log10(level), color=DATA, ls="--", lw=1, label=label)
    if found["t"] is not None:
        label = f"first detected: {found['phase']}, t* = {found['t']:.2f}"
        ax.axvline(found["t"], color=ALARM, lw=1.5, label=label)
    ax.set_yscale("symlog", linthresh=_LINEAR)
    ax.set(xlabel="frames up to $t^*$", ylabel="$-\\log_{10} p$")
    ax.set(ylim=(0.0, 2.0 * max(*strength, _LINEAR)))
    ax.legend(frameon=False, fontsize=8)
    return ax


def plot_acts(shares: Mapping[str, Sequence[float]], *, ax: Axes | None = None) -> Axes:
    """Share of the signal of the named effects by phase, with its 90 % interval."""
    ax = _axes(ax, (5.2, 2.6))
    low, middle, high = np.array(list(shares.values())).T
    places = range(len(middle))
    ax.bar(places, middle, color=AFTER, width=0.6)
    ax.errorbar(places, middle, yerr=(middle - low, high - middle), fmt="none", color=DATA)
    ax.set_xticks(places, [phase.replace(" ", "\n") for phase in shares], fontsize=8)
    ax.set(ylabel="share of the signal", ylim=(0.0, 1.0))
    return ax


def plot_causes(posterior: Mapping[str, float], *, ax: Axes | None = None) -> Axes:
    """Probability of each cause, the most probable first; none and other stand out."""
    shown = sorted(posterior.items(), key=lambda item: -item[1])[:_BARS]
    ax = _axes(ax, (5.6, 1.0 + 0.27 * len(shown)))
    places = range(len(shown) - 1, -1, -1)
    colors = [{"none": PALE, "other": ALARM}.get(name, AFTER) for name, _ in shown]
    ax.barh(places, [p for _, p in shown], color=colors, height=0.7)
    for place, (_, probability) in zip(places, shown, strict=True):
        ax.text(probability, place, f" {probability:.3f}", va="center", fontsize=8)
    ax.set_yticks(places, [plain(name, 40) for name, _ in shown], fontsize=8)
    ax.set(xlabel="probability", xlim=(0.0, 1.3), xticks=[0.0, 0.25, 0.5, 0.75, 1.0])
    return ax


def plot_explained(
    explained: Mapping[str, float], unconverged: Sequence[str] = (), *, ax: Axes | None = None
) -> Axes:
    """Nats that one part more explains, the most first.

    Light where its fit did not converge, so that they may be more.
    """
    shown = sorted(explained.items(), key=lambda item: -item[1])[:_BARS]
    ax = _axes(ax, (5.6, 1.0 + 0.27 * len(shown)))
    top = max(1.0, *(nats for _, nats in shown))
    places = range(len(shown) - 1, -1, -1)
    for place, (name, nats) in zip(places, shown, strict=True):
        loose = name in unconverged
        ax.barh(place, max(nats, 0.0), color=AFTER, alpha=0.35 if loose else 1.0, height=0.7)
        said = f"{nats:.0f}{' or more' if loose else ''}"
        ax.text(max(nats, 0.0) + 0.02 * top, place, said, va="center", fontsize=8)
    ax.set_yticks(places, [plain(name, 40) for name, _ in shown], fontsize=8)
    ax.set(xlabel="log evidence gained (nats)", xlim=(0.0, 1.3 * top))
    return ax


def plot_shrinkage(found: Mapping[str, Any], *, ax: Axes | None = None) -> Axes:
    """Part of the gap on unseen curves that is gone, beside what random effects close."""
    rows = [("all frames", found["share"])]
    if found["later"] is not None:
        rows.append(("after the first\nrebound", found["later"]))
    ax = _axes(ax, (5.2, 1.2 + 0.45 * len(rows)))
    high = max(found["placebo_95"], 0.0)
    ax.axvspan(0.0, high, color="#DDDDDD", lw=0, label="95 % of random libraries")
    places = range(len(rows) - 1, -1, -1)
    for place, (_, (low, middle, top)) in zip(places, rows, strict=True):
        error = ([middle - low], [top - middle])
        ax.errorbar([middle], [place], xerr=error, fmt="o", color=AFTER, capsize=3)
    for at in (0.0, 1.0):
        ax.axvline(at, color=DATA, lw=0.8)
    ax.set_yticks(places, [name for name, _ in rows], fontsize=8)
    ax.set(xlabel="part of the gap that is gone", ylim=(-0.5, len(rows) - 0.5))
    ax.legend(frameon=False, fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return ax


def plot_intervals(document: Document, *, ax: Axes | None = None) -> Axes:
    """90 % intervals of the gel's parameters if the model is right, and with what it may lack,
    relative to the median.
    """
    right = document["parameters"]
    wide = document["parameters_with_model_error"]
    ax = _axes(ax, (5.2, 1.1 + 0.5 * len(right)))
    places = np.arange(len(right) - 1, -1, -1)
    rows = (
        (right, BASE, 0.12, "if the model is right"),
        (wide, AFTER, -0.12, "with what it may lack"),
    )
    for values, color, offset, label in rows:
        scaled = [np.array(values[name]) / right[name][1] for name in right]
        low, middle, high = np.array(scaled).T
        error = (middle - low, high - middle)
        ax.errorbar(
            middle, places + offset, xerr=error, fmt="o", color=color, capsize=3, label=label
        )
    ax.axvline(1.0, color=DATA, lw=0.8)
    ax.set_yticks(places, [PARAMETERS[name].label for name in right], fontsize=8)
    ax.set(xlabel="over the median of the fit", ylim=(-0.5, len(right) - 0.5))
    ax.legend(frameon=False, fontsize=8, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return ax
