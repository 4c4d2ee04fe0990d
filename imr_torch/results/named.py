"""A figure that is still to be drawn, with its name, caption and alternative text."""

from collections.abc import Callable
from dataclasses import dataclass

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imr_torch.html import Picture


@dataclass(frozen=True)
class NamedFigure:
    """A figure to be drawn.

    Args:
        name: of its file, without an extension.
        caption: what it shows.
        alt: the same for who cannot see it, with what is to be seen.
        plot: draws it, or its axes; may fail.

    >>> from matplotlib.figure import Figure
    >>> from imr_torch.results import NamedFigure
    >>> NamedFigure("curve_a", "Radius.", "Line chart.", Figure).name
    'curve_a'
    """

    name: str
    caption: str
    alt: str
    plot: Callable[[], Figure | Axes]

    def draw(self) -> Figure:
        """The figure, drawn."""
        drawn = self.plot()
        figure = drawn.figure if isinstance(drawn, Axes) else drawn
        assert isinstance(figure, Figure)
        return figure

    def picture(self) -> dict[str, str]:
        """Caption, alternative text and the figure as a data URI, for a page."""
        figure = self.draw()
        source = Picture(self.caption, self.alt, figure).source
        plt.close(figure)
        return {"caption": self.caption, "alt": self.alt, "source": source}
