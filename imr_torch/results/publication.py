"""Figures at the size at which they are printed: one or two columns wide, text of 6 to 8 points,
thin lines.

A figure that is made small by the typesetting has text that cannot be read. Here it is drawn again
at its printed width, so that points are points. Colours are those of :mod:`imr_torch.drawing` (Okabe
and Ito 2008), which colour-blind readers can tell apart.
"""

from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Text

from imr_torch.errors import InputDataError

WIDTHS = {"one": 86.0, "two": 178.0}
"""Number of columns -> width in mm, as most journals have them."""

TEXT = 8.0
SMALL = 7.0
"""Points: of axes and titles, and of ticks and legends."""

LEAST = 6.0
"""Points: of text that would not fit."""

STYLE: dict[Any, Any] = {
    "font.size": TEXT,
    "axes.titlesize": TEXT,
    "axes.labelsize": TEXT,
    "figure.titlesize": TEXT,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "legend.fontsize": SMALL,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.handlelength": 1.4,
    "legend.columnspacing": 1.0,
}
"""Settings of matplotlib under which figures are drawn."""

_MM = 1.0 / 25.4  # inches
_WIDER = 1.1  # than its axes, from which on a label takes two lines
_LEAST_HEIGHT = 0.62  # of the width of one column


def for_publication(draw: Callable[[], Figure], columns: str) -> Figure:
    """Draw a figure at its printed size.

    Args:
        draw: draws it at any size, with constrained layout.
        columns: ``"one"`` or ``"two"``.

    Raises:
        InputDataError: for another number of columns.

    >>> import matplotlib.pyplot as plt
    >>> from imr_torch.results import for_publication
    >>> figure = for_publication(lambda: plt.subplots(layout="constrained")[0], "one")
    >>> [round(25.4 * x) for x in figure.get_size_inches().tolist()]  # mm
    [86, 64]
    """
    if columns not in WIDTHS:
        raise InputDataError(f"columns is {columns!r}; expected {' or '.join(WIDTHS)}.")
    with plt.rc_context(STYLE):
        figure = draw()
        width, height = figure.get_size_inches()
        wanted = WIDTHS[columns] * _MM
        share = height / width if columns == "one" else min(height / width, height / wanted)
        figure.set_size_inches(wanted, max(share * wanted, _LEAST_HEIGHT * WIDTHS["one"] * _MM))
        _shrink(figure, TEXT)
        if columns == "one":
            _legend_below(figure)
        for legend in figure.findobj(Legend):
            _shrink(legend, SMALL)
        _break_long_labels(figure)
        figure.draw_without_rendering()  # makes the ticks under these settings
    return figure


def _shrink(artist: Artist, largest: float) -> None:
    """Make all text of a part of a figure as small as ``largest`` points at most."""
    for text in artist.findobj(Text):
        text.set_fontsize(min(float(text.get_fontsize()), largest))


def _break_long_labels(figure: Figure) -> None:
    """Put titles and labels that are wider than their axes into two lines, and make them smaller
    where that is not enough.
    """
    figure.draw_without_rendering()
    for ax in figure.axes:
        room = _WIDER * ax.get_window_extent().width
        for text in (ax.title, ax.xaxis.label):
            if text.get_window_extent().width > room:
                text.set_text(in_two_lines(text.get_text()))
                _shrink(text, max(LEAST, TEXT * room / text.get_window_extent().width))


def in_two_lines(text: str) -> str:
    r"""The text, broken before a parenthesis or else at the blank next to its middle, never within
    a formula.

    >>> from imr_torch.results.publication import in_two_lines
    >>> in_two_lines("$G = 8$ (7 to 9)")
    '$G = 8$\n(7 to 9)'
    """
    blanks = [i for i, letter in enumerate(text) if letter == " " and text[:i].count("$") % 2 == 0]
    outside = [i for i in blanks if text[:i].count("(") == text[:i].count(")")] or blanks
    places = [i for i in outside if text[i + 1 : i + 2] == "("] or outside
    if not places:
        return text
    at = min(places, key=lambda i: abs(i - len(text) / 2))
    return f"{text[:at]}\n{text[at + 1 :]}"


def _legend_below(figure: Figure) -> None:
    """Put the only legend of a small figure below it, where it hides no data."""
    legends = figure.findobj(Legend)
    if len(legends) != 1 or figure.legends:
        return
    (legend,) = legends
    handles = [handle for handle in legend.legend_handles if handle is not None]
    labels = [text.get_text() for text in legend.get_texts()]
    legend.remove()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    width, height = figure.get_size_inches()
    rows = (len(labels) + 1) // 2
    figure.set_size_inches(width, height + rows * 1.5 * SMALL / 72.0)
