"""A figure that is still to be drawn, with its name, caption and alternative text."""

from collections.abc import Callable
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure


@dataclass(frozen=True)
class NamedFigure:
    """A figure to be drawn.

    Args:
        name: of its file, without an extension.
        caption: what it shows.
        alt: the same for who cannot see it, with what is to be seen.
        draw: draws it; may fail.

    >>> from matplotlib.figure import Figure
    >>> from imr_torch.results import NamedFigure
    >>> NamedFigure("curve_a", "Radius.", "Line chart.", Figure).name
    'curve_a'
    """

    name: str
    caption: str
    alt: str
    draw: Callable[[], Figure]


def figure_of(ax: Axes) -> Figure:
    """The figure of some axes."""
    figure = ax.figure
    assert isinstance(figure, Figure)
    return figure
