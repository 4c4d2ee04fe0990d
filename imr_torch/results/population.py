"""The population of gels in a result document: its figure, and its part of the page."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from imr_torch.html import Table
from imr_torch.labels import plain, symbol, with_unit
from imr_torch.material import PARAMETERS
from imr_torch.plot import DATA, MODEL, PALE
from imr_torch.population.result import LARGEST_SHOWN
from imr_torch.results.named import NamedFigure

_WIDE = 5.0  # ratio of the ends of an axis from which on it is logarithmic
_ROWS = 40  # shots with a label


def population_named_figure(found: Mapping[str, Any]) -> NamedFigure:
    """The figure of a population with its caption.

    Args:
        found: ``population`` of a result document.
    """
    return NamedFigure(
        "population",
        "Each shot alone (grey) and given all shots (blue), 90 % intervals; line and band: the "
        "median of all; dotted: "
        "90 % of the shots to come.",
        "Interval charts of every parameter by shot, beside the population's median.",
        lambda: population_figure(found),
    )


def population_figure(found: Mapping[str, Any]) -> Figure:
    """Every shot alone and given all, a panel a parameter, beside the population's median and the
    shots to come.

    Args:
        found: ``population`` of a result document.
    """
    names = list(found["parameters"])
    shots = found["shots"]
    height = 1.6 + 0.24 * len(shots)
    figure, axes = plt.subplots(
        1, len(names), figsize=(0.9 + 2.9 * len(names), height), sharey=True, layout="constrained"
    )
    for name, ax in zip(names, axes if len(names) > 1 else [axes], strict=True):
        entry = found["parameters"][name]
        parameter = PARAMETERS[name]
        scale = parameter.display_scale
        low, middle, high = (scale * x for x in entry["median"])
        ax.axvspan(low, high, color=MODEL, alpha=0.15, lw=0)
        ax.axvline(middle, color=MODEL, lw=1.2, label="median of the population")
        ends = [low, high]
        for x in (entry["next_shot"][0], entry["next_shot"][2]):
            ax.axvline(scale * x, color=MODEL, ls=":", lw=1.0)
            ends.append(scale * x)
        for row, shot in enumerate(shots):
            for key, color, shift, width in (
                ("alone", PALE, 0.14, 3.5),
                ("given_all", MODEL, -0.14, 1.8),
            ):
                left, centre, right = (scale * x for x in shot[key][name])
                ax.plot(
                    (left, right), (row + shift,) * 2, color=color, lw=width, solid_capstyle="butt"
                )
                ax.plot(
                    centre, row + shift, "o", ms=3.5, color=DATA if key == "given_all" else color
                )
                ends += [left, right]
        if min(ends) > 0.0 and max(ends) > _WIDE * min(ends):
            ax.set_xscale("log")
            ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
            ax.xaxis.set_minor_formatter(NullFormatter())
        ax.set_xlabel(with_unit(symbol(name), parameter.display_unit or parameter.unit))
        if "scatter" in entry:
            ax.set_title(
                "scatter {1:.2f} ({0:.2f} to {2:.2f})".format(*entry["scatter"]), fontsize=9
            )
    first = axes[0] if len(names) > 1 else axes
    first.set_yticks(
        range(len(shots)),
        [plain(shot["id"], 24) for shot in shots],
        fontsize=8 if len(shots) <= _ROWS else 5,
    )
    first.set_ylim(len(shots) - 0.5, -0.5)
    return figure


def population_lines(found: Mapping[str, Any]) -> list[str]:
    """The population as text: whether shots differ, then median and scatter of each parameter.

    Args:
        found: ``population`` of a result document.
    """
    lines = [
        f"{found['sentence']} Scatter of any parameter against none: "
        f"{_nats(found['log_bayes_factor'])}."
    ]
    for name, entry in found["parameters"].items():
        scatter = "the same in all shots"
        if "scatter" in entry:
            scatter = (
                "scatter {1:.3f} ({0:.3f} to {2:.3f})".format(*entry["scatter"])
                + f" of {entry['scatter_of']}"
            )
        lines.append(f"  {name}: median {PARAMETERS[name].interval(*entry['median'])}; {scatter}")
    return [*lines, *(f"Caution: {text}" for text in found["cautions"])]


def population_block(found: Mapping[str, Any]) -> tuple[str | Table, ...]:
    """Sentences and a table for the page.

    Args:
        found: ``population`` of a result document.
    """
    rows = []
    for name, entry in found["parameters"].items():
        scatter = "the same in all shots"
        evidence = ""
        if "scatter" in entry:
            low, middle, high = entry["scatter"]
            scatter = f"{middle:.3f} (90 %: {low:.3f} to {high:.3f}) of {entry['scatter_of']}"
            evidence = _nats(entry["log_bayes_factor"])
        low, middle, high = entry["next_shot"]
        rows.append(
            (
                name,
                PARAMETERS[name].interval(*entry["median"]),
                scatter,
                evidence,
                PARAMETERS[name].interval(low, middle, high),
            )
        )
    heads = (
        "parameter",
        "median of the population",
        "standard deviation between shots",
        "evidence for it",
        "a shot to come",
    )
    other = "; ".join(
        f"scale {check['scale']:g}: {_nats(check['log_bayes_factor'])}" for check in found["scales"]
    )
    lines = (
        f"{found['sentence']} Evidence of scatter of any parameter against none: "
        f"{_nats(found['log_bayes_factor'])}.",
        f"The prior of each scatter is half-normal with scale {found['prior']['scale']:g}; with "
        f"another ({other}).",
        f"The noise of these fits, one a shot, is {found['noise']['scale']:.2f} x the published "
        "law.",
    )
    return (*lines, Table(tuple(rows), heads), *(f"Caution: {text}" for text in found["cautions"]))


def _nats(found: Mapping[str, Any]) -> str:
    """A log Bayes factor as text."""
    if abs(found["value"]) > LARGEST_SHOWN:
        return f"{'below -' if found['value'] < 0 else 'above '}{LARGEST_SHOWN:.0f} nats"
    return f"{found['value']:.1f} +- {max(found['error'], 0.05):.1f} nats" + (
        "" if found["reliable"] else " (not reliable)"
    )
