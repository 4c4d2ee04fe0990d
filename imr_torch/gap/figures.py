"""Figures of a diagnosis, from its document alone, each with the section that it stands in.

Colours are told apart by colour-blind readers, and what matters is also written.
"""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure

from imr_torch.drawing import (
    DATA,
    MODEL,
    PALE,
    SECOND,
    TRUTH,
    NamedFigure,
    add_legend,
    curve_panels,
    draw_intervals,
    floats,
    name_figure,
    new_axes,
)
from imr_torch.files import Document
from imr_torch.gap.hypotheses import in_words
from imr_torch.goodness.score import LEVEL
from imr_torch.labels import file_name, plain
from imr_torch.material import PARAMETERS
from imr_torch.record.figures import record_figure

LIGHT = "#A6CCE2"  # bars of fits that did not converge
_SMALLEST = 300.0  # -log10 p beyond which p-values are zero in float64
_LINEAR = 10.0  # -log10 p up to which axes are linear; logarithmic beyond
_BARS = 12
_ALL = 0.99  # probability of an unknown effect from which on others cannot be seen


def gap_figures(document: Document) -> Iterator[NamedFigure]:
    """Every figure that a document allows, in the order of the page.

    Args:
        document: of a diagnosis (:func:`imr_torch.gap.to_json`).
    """
    selected = " and ".join(map(in_words, document["selected"]))
    if document.get("record"):
        yield name_figure("record.record", record_figure, document["record"])
    for curve in document["curves"]:
        beside = "" if curve["selected"] is None else f" and that with {selected}"
        label = file_name(curve["id"])
        yield name_figure(
            "diagnose.curve",
            curve_figure,
            curve,
            selected,
            curve=curve,
            label=label,
            beside=beside,
        )
    tests = document["tests"]
    yield name_figure("diagnose.tests", plot_tests, tests, tests=tests, count=len(tests))
    if document["examined"]:
        yield name_figure(
            "diagnose.phases", plot_phase_residual, document, count=len(document["curves"])
        )
        onset = document["onset"]
        yield name_figure("diagnose.onset", plot_onset, onset, onset=onset)
    if posterior := document["posterior"]:
        if posterior.get("other", 0.0) > _ALL:  # what each explains by itself
            yield name_figure(
                "diagnose.explained",
                plot_explained,
                document["explained_nats"],
                document["unconverged"],
            )
        else:
            yield name_figure(
                "diagnose.causes",
                plot_causes,
                posterior,
                top=max(posterior, key=posterior.__getitem__),
            )
    if (missing := document.get("missing")) and (shots := missing["shots"]):
        yield name_figure(
            "diagnose.missing", plot_missing_pressure, shots, count=len(shots)
        )
        yield name_figure("diagnose.missing_states", plot_missing_states, shots)
    if document["shrinkage"] and document["shrinkage"]["share"]:
        yield name_figure("diagnose.shrinkage", plot_shrinkage, document["shrinkage"])
    if document["parameters_with_model_error"]:
        yield name_figure("diagnose.parameters", plot_intervals, document)


def laboratory_figures(document: Document) -> Iterator[NamedFigure]:
    """What explains several gels (:func:`imr_torch.gap.document.laboratory_document`)."""
    if shown := document["causes"][:8]:
        yield name_figure("laboratory.causes", plot_common, shown, count=len(shown))


def plot_common(causes: Sequence[Document]) -> Axes:
    """By how much one cause in all gels, and the same of each gel's own, explain them."""
    ax = new_axes((5.2, 0.9 + 0.3 * len(causes)))
    names = [plain(cause["name"]) for cause in causes]
    for name, color, marker, label in (
        ("own", SECOND, "s", "each gel its own"),
        ("one", MODEL, "o", "one in all gels"),
    ):
        nats = [sum(cause["nats"][name]) for cause in causes]
        ax.plot(nats, names, marker, color=color, label=label)
    ax.axvline(color=DATA)
    ax.invert_yaxis()
    ax.set(xlabel="nats better than without")
    add_legend(ax)
    return ax


def _strength(p_value: float) -> float:
    """How small a p-value is, in powers of ten."""
    return -math.log10(max(p_value, 10.0**-_SMALLEST))


def _bars(
    names: Sequence[str],
    lengths: Sequence[float],
    texts: Sequence[str],
    colors: Sequence[str],
) -> Axes:
    """Horizontal bars from top to bottom, each with its name and a text at its end."""
    ax = new_axes((6.0, 1.0 + 0.27 * len(names)))
    places = range(len(names) - 1, -1, -1)
    ax.bar_label(
        ax.barh(places, lengths, color=colors, height=0.7), texts, padding=2, fontsize=8
    )
    ax.set_yticks(places, [plain(name) for name in names], fontsize=8)
    return ax


def curve_figure(curve: Document, selected: str) -> Figure:
    """One mean measured curve with the base model and the model with what was selected, and
    residuals below.

    Args:
        curve: an entry of ``curves``.
        selected: what was selected, in words.
    """
    figure, ax, below = curve_panels(curve["id"])
    t, r, sd = (floats(curve[name]) for name in ("t_star", "R_star", "sd"))
    ax.plot(t, r, ".", ms=4, color=DATA, label="measured")
    shown = (
        ("base", "base model", SECOND, "--"),
        ("selected", f"with {selected}", MODEL, "-"),
    )
    for name, label, color, style in shown:
        if curve[name] is None:
            continue
        at_frames = {"t_star": curve["t_star"], "R_star": curve[name]}
        drawn = curve["drawn"].get(name, at_frames)
        times = floats(drawn["t_star"])
        ax.plot(
            times,
            floats(drawn["R_star"]),
            color=color,
            ls=style,
            lw=1.3,
            label=plain(label),
        )
        below.plot(t, (r - floats(curve[name])) / sd, color=color, ls=style, lw=1.2)
    ax.set(ylim=(0.0, None))
    add_legend(ax)
    figure.subplots_adjust(right=0.97, top=0.93)
    return figure


def plot_phase_residual(document: Document) -> Axes:
    """Size of the residual of the base model: a map over experiments and phases, 1 being noise
    alone.
    """
    phases = document["phase_residual"]["phases"]
    values = floats(document["phase_residual"]["rows"])
    ax = new_axes((5.8, 1.4 + 0.36 * len(values)))
    top = max(3.0, float(np.nan_to_num(values).max()))
    image = ax.imshow(values, cmap="Blues", vmin=0.0, vmax=top, aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if not math.isnan(value):
            color = "white" if value > 0.6 * top else "black"
            ax.text(j, i, f"{value:.1f}", ha="center", va="center", fontsize=8, color=color)
    ax.set_xticks(
        range(len(phases)), [phase.replace(" ", "\n") for phase in phases], fontsize=8
    )
    labels = [plain(curve["id"], 24) for curve in document["curves"]]
    ax.set_yticks(range(len(values)), labels, fontsize=8)
    ax.figure.colorbar(image, ax=ax, label="rms residual / noise")
    return ax


def plot_tests(tests: Sequence[Document]) -> Axes:
    """P-values of the blocks of a gap test, smallest first."""
    shown = tests[:_BARS]
    strength = [_strength(row["p_value"]) for row in shown]
    limit = -math.log10(LEVEL / len(tests))
    texts = [f"{'> ' if s == _SMALLEST else ''}{s:.3g}" for s in strength]
    colors = [TRUTH if s > limit else PALE for s in strength]
    ax = _bars([row["name"] for row in shown], strength, texts, colors)
    ax.axvline(limit, color=DATA, ls="--", lw=1)
    ax.set(xlabel="$-\\log_{10} p$  (dashed: 4 % over all)")
    ax.set_xscale("asinh", linear_width=_LINEAR)
    ax.set_xticks((0.0, 3.0, 10.0, 100.0), ("0", "3", "10", "100"))
    ax.set(xlim=(0.0, 3.0 * max(*strength, limit)))
    return ax


def plot_onset(found: Document) -> Axes:
    """P-value of a refit to the frames up to each moment.

    The first below the level is the first detection.
    """
    ax = new_axes()
    strength = [_strength(p) for p in found["p_values"]]
    level = found["level"]
    ax.plot(found["times"], strength, "o-", color=MODEL, ms=4)
    label = f"{100 * level:g} % over the whole event"
    ax.axhline(-math.log10(level), color=DATA, ls="--", lw=1, label=label)
    if found["t"] is not None:
        label = f"first detected: {found['phase']}, t* = {found['t']:.2f}"
        ax.axvline(found["t"], color=TRUTH, lw=1.5, label=label)
    ax.set_yscale("asinh", linear_width=_LINEAR)
    ax.set(xlabel="frames up to $t^*$", ylabel="$-\\log_{10} p$")
    ax.set(ylim=(0.0, 2.0 * max(*strength, _LINEAR)))
    add_legend(ax)
    return ax


def plot_causes(posterior: Mapping[str, float]) -> Axes:
    """Probability of each cause, the most probable first; none and other stand out."""
    names = sorted(posterior, key=lambda name: -posterior[name])[:_BARS]
    shown = [posterior[name] for name in names]
    colors = [{"none": PALE, "other": TRUTH}.get(name, MODEL) for name in names]
    ax = _bars(names, shown, [f"{p:.3f}" for p in shown], colors)
    ax.set(xlabel="probability", xlim=(0.0, 1.3), xticks=[0.0, 0.25, 0.5, 0.75, 1.0])
    return ax


def plot_explained(explained: Mapping[str, float], unconverged: Sequence[str] = ()) -> Axes:
    """Nats that one part more explains, the most first.

    Light where its fit did not converge, so that they may be more.
    """
    names = sorted(explained, key=lambda name: -explained[name])[:_BARS]
    lengths = [max(explained[name], 0.0) for name in names]
    texts = [f"{explained[n]:.0f}{' or more' if n in unconverged else ''}" for n in names]
    ax = _bars(names, lengths, texts, [LIGHT if n in unconverged else MODEL for n in names])
    ax.set(xlabel="log evidence gained (nats)", xlim=(0.0, 1.3 * max(1.0, *lengths)))
    return ax


def plot_missing_pressure(shots: Sequence[Document], *, most: int = 3) -> Axes:
    """The missing pressure of each shot over its time, with a 90 % band; linear up to 10 kPa,
    logarithmic beyond.
    """
    ax = new_axes((6.4, 3.2))
    for shot, color in zip(shots[:most], (MODEL, SECOND, TRUTH), strict=False):
        t, p, sd, own = (
            floats(shot[name]) for name in ("t_us", "kPa", "sd_kPa", "own_kPa")
        )
        ax.fill_between(t, p - 1.645 * sd, p + 1.645 * sd, color=color, alpha=0.25, lw=0)
        ax.plot(t, p, color=color, lw=1.2, label=plain(shot["id"], 24))
        ax.plot(t, own, color=color, lw=0.8, ls="--")
    ax.axhline(0.0, color=DATA, lw=0.8)
    ax.set_title(
        f"the first {most} of {len(shots)} shots" if len(shots) > most else "", fontsize=9
    )
    ax.set_yscale("asinh", linear_width=10.0)
    ax.set(xlabel="time (us)", ylabel="missing pressure (kPa)")
    add_legend(ax)
    return ax


def plot_missing_states(shots: Sequence[Document]) -> Axes:
    """The missing pressure over stretch and strain rate, where the bubbles went.

    Grey where it is less than 1.645 of its standard deviations: there the data do not say.
    """
    ax = new_axes((6.0, 3.6))
    names = ("stretch", "rate", "kPa", "sd_kPa")
    stretch, rate, p, sd = (np.concatenate([floats(s[n]) for s in shots]) for n in names)
    sure = np.abs(p) > 1.645 * sd
    ax.scatter(
        stretch[~sure], rate[~sure], s=6, color="#CCCCCC", label="not told from zero"
    )
    top = float(np.abs(p[sure]).max()) if sure.any() else 1.0
    colors = {"cmap": "RdBu_r", "norm": SymLogNorm(10.0, vmin=-top, vmax=top)}
    points = ax.scatter(stretch[sure], rate[sure], c=p[sure], s=10, **colors)
    ax.figure.colorbar(points, ax=ax, label="missing pressure (kPa)")
    ax.set_yscale("symlog", linthresh=1e4)
    ax.set(xlabel="stretch $R/R_\\infty$", ylabel="strain rate $U/R$ (1/s)")
    add_legend(ax)
    return ax


def plot_shrinkage(found: Document) -> Axes:
    """Part of the gap on unseen curves that is gone, beside what random effects close."""
    rows = {"all frames": found["share"]}
    if found["later"]:
        rows["after the first\nrebound"] = found["later"]
    ax = new_axes((5.2, 1.2 + 0.45 * len(rows)))
    high = max(found["placebo_95"], 0.0)
    ax.axvspan(0.0, high, color="#DDDDDD", lw=0, label="95 % of random libraries")
    places = range(len(rows) - 1, -1, -1)
    draw_intervals(ax, places, list(rows.values()), color=MODEL, capsize=3)
    for at in (0.0, 1.0):
        ax.axvline(at, color=DATA, lw=0.8)
    ax.set_yticks(places, list(rows), fontsize=8)
    ax.set(xlabel="part of the gap that is gone", ylim=(-0.5, len(rows) - 0.5))
    add_legend(ax, fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return ax


def plot_intervals(document: Document) -> Axes:
    """90 % intervals of the gel's parameters if the model is right, and with what it may lack,
    relative to the median.
    """
    right, wide = (
        {
            n: np.exp(x) if PARAMETERS[n].dimension == "ratio" else np.array(x)
            for n, x in own.items()
        }
        for own in (document["parameters"], document["parameters_with_model_error"])
    )
    ax = new_axes((5.2, 1.1 + 0.5 * len(right)))
    places = np.arange(len(right) - 1, -1, -1)
    rows = (
        (right, SECOND, 0.12, "by the model alone"),
        (wide, MODEL, -0.12, "with what it may lack"),
    )
    for values, color, offset, label in rows:
        scaled = [values[name] / right[name][1] for name in right]
        draw_intervals(ax, places + offset, scaled, color=color, capsize=3, label=label)
    ax.axvline(1.0, color=DATA, lw=0.8)
    ax.set_yticks(
        places,
        [PARAMETERS[name].label.replace("\\ln\\,", "") for name in right],
        fontsize=8,
    )
    ax.set(xlabel="over the median of the fit", ylim=(-0.5, len(right) - 0.5))
    add_legend(ax, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return ax
