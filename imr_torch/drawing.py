"""What figures have in common: colours, axes in laboratory units, panels, and figures that are
still to be drawn.

Colours are told apart by colour-blind readers (Okabe and Ito 2008).
"""

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from imr_torch.files import read_table
from imr_torch.labels import R_STAR, T_STAR, plain

DATA = "#222222"
MODEL = "#0072B2"
SECOND = "#E69F00"
TRUTH = "#D55E00"
PALE = "#B8B8B8"  # frames that were not fitted
CYCLE = (MODEL, TRUTH, "#009E73", SECOND, "#CC79A7", "#56B4E9", DATA)
"""Several curves in one panel."""

NOISE_BAND: dict[str, Any] = {"color": "#E2E2E2", "lw": 0}
"""Style of the band that noise alone stays in."""

WIDE = 30.0
"""Ratio of the largest to the smallest value from which on an axis is logarithmic."""

floats = partial(np.asarray, dtype=float)
"""Numbers of a document as an array; None is NaN."""


@dataclass(frozen=True)
class NamedFigure:
    """A figure to be drawn.

    Args:
        name: of its file, without an extension.
        caption: what it shows.
        alt: the same for who cannot see it, with what is to be seen.
        plot: draws it, or its axes; may fail.
        section: heading of the section of a page that it stands in, where the page has several.
        note: what stands below it, in the colour of warnings.

    >>> from matplotlib.figure import Figure
    >>> from imr_torch.results import NamedFigure
    >>> NamedFigure("curve_a", "Radius.", "Line chart.", Figure).picture()["source"][:22]
    'data:image/png;base64,'
    """

    name: str
    caption: str
    alt: str
    plot: Callable[[], Figure | Axes]
    section: str = ""
    note: str = ""

    def draw(self) -> Figure:
        """The figure, drawn."""
        figure = self.plot().figure
        assert isinstance(figure, Figure)
        figure.supxlabel(self.note, fontsize=8, color=TRUTH)
        return figure

    def picture(self) -> dict[str, str]:
        """Caption, alternative text, section and the figure as a data URI, for a page."""
        figure = self.draw()
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=140, metadata={"Software": None})
        plt.close(figure)
        source = f"data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}"
        words = {"caption": self.caption, "alt": self.alt, "section": self.section}
        return words | {"source": source}


def name_figure(
    figure: str, plot: Callable[..., Figure | Axes], *given: Any, **words: Any
) -> NamedFigure:
    """A figure to be drawn, with name, caption and alternative text of ``data/captions.toml``.

    Args:
        figure: kind of result and key of the figure in the table, with a dot between.
        plot: draws it, or its axes.
        given: what it is drawn from, arguments of ``plot``.
        words: what is filled in for names in braces.

    >>> from imr_torch.drawing import name_figure, new_axes
    >>> name_figure("characterize.parameter", new_axes, name="G").caption
    'Prior and posterior of G.'
    """
    kind, key = figure.split(".")
    texts = {"name": key} | read_table("captions")[kind][key]
    filled = {part: text.format(**words) for part, text in texts.items()}
    return NamedFigure(**filled, plot=partial(plot, *given))


def new_axes(size: tuple[float, float] = (5.2, 3.4)) -> Axes:
    """Those of a new figure of a size in inches."""
    return plt.subplots(figsize=size, layout="constrained")[1]


def curve_panels(title: str) -> tuple[Figure, Axes, Axes]:
    """A figure with a panel for radius over time and, below, one for residuals over their noise."""
    # a layout that fits every curve: to find one takes as long as to draw
    margins = {"left": 0.15, "right": 0.88, "top": 0.83, "bottom": 0.14, "hspace": 0.08}
    figure, (ax, below) = plt.subplots(
        2, 1, figsize=(5.8, 4.8), height_ratios=[3, 1], sharex=True, gridspec_kw=margins
    )
    ax.set_ylabel(R_STAR)
    below.axhspan(-2.0, 2.0, **NOISE_BAND)
    below.set(xlabel=T_STAR, ylabel="residual\n/ noise")
    figure.suptitle(plain(title), fontsize=10)
    return figure, ax, below


def add_legend(ax: Axes, *, fontsize: int = 8, **style: Any) -> None:
    """Add a legend without a frame, in the size of small print."""
    ax.legend(frameon=False, fontsize=fontsize, **style)


def mark_zero(ax: Axes) -> None:
    """Draw the line of no residual."""
    ax.axhline(0.0, color=DATA, lw=0.6)


def set_scale(ax: Axes, axis: str, low: float, high: float, *, ratio: float = WIDE) -> bool:
    """Make an axis logarithmic where its values span more than a ratio; whether it is."""
    if not (low > 0.0 and high > ratio * low):
        return False
    ax.set(**{f"{axis}scale": "log"})
    if high < 1e3 * low:  # powers of ten alone would be too few ticks
        scale = getattr(ax, f"{axis}axis")
        scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        scale.set_major_formatter("{x:g}")
        scale.set_minor_formatter("")
    return True


def draw_intervals(
    ax: Axes,
    places: Sequence[float] | np.ndarray,
    intervals: Any,
    *,
    upright: bool = False,
    **style: Any,
) -> None:
    """Draw intervals with their medians.

    Args:
        ax: the axes.
        places: of the intervals along the other axis.
        intervals: low, median and high of each.
        upright: whether they run along the y axis.
        style: of :meth:`matplotlib.axes.Axes.errorbar`.
    """
    low, middle, high = floats(intervals).reshape(-1, 3).T
    reach = np.clip((middle - low, high - middle), 0.0, None)
    style = {"marker": "o", "ls": "none"} | style
    if upright:
        ax.errorbar(places, middle, yerr=reach, **style)
    else:
        ax.errorbar(middle, places, xerr=reach, **style)


def add_axis(ax: Axes, side: str, factor: float, label: str) -> None:
    """Add a second axis in other units.

    Args:
        ax: the axes.
        side: ``"top"`` or ``"right"``.
        factor: one unit of the axes in the other unit.
        label: of the second axis.
    """
    scaled = (lambda x: x * factor, lambda x: x / factor)
    if side == "top":
        ax.secondary_xaxis("top", functions=scaled).set_xlabel(label)
    else:
        ax.secondary_yaxis("right", functions=scaled).set_ylabel(label)


def add_lengths(ax: Axes, max_radius_m: float, time_scale_s: float) -> None:
    """Add us above and um at the right of axes in t* and R*.

    Args:
        ax: the axes.
        max_radius_m: Rmax, m.
        time_scale_s: Rmax/U_c, s.
    """
    add_axis(ax, "top", 1e6 * time_scale_s, "$t$ (µs)")
    add_axis(ax, "right", 1e6 * max_radius_m, "$R$ (µm)")
