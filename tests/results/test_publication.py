"""Figures at their printed size: widths, sizes of text, colours that colour-blind readers can tell
apart.
"""

from itertools import combinations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.text import Text

from imr_torch.drawing import CYCLE
from imr_torch.errors import InputDataError
from imr_torch.results import WIDTHS, for_publication

# Vienot, Brettel and Mollon 1999: linear RGB as seen without the cones of long and of medium
# wavelengths
SEEN = {
    "protanopia": [[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]],
    "deuteranopia": [[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]],
}


@pytest.fixture(autouse=True)
def close():
    yield
    plt.close("all")


def drawn():
    figure, ax = plt.subplots(figsize=(5.8, 3.6), layout="constrained")
    ax.plot([0, 1], [0, 1], label="a line")
    ax.set_title("title", fontsize=12)
    ax.legend(fontsize=9)
    return figure


@pytest.mark.parametrize("columns", WIDTHS)
def test_that_a_figure_has_the_width_of_its_columns_and_text_that_can_be_read(columns):
    figure = for_publication(drawn, columns)
    assert 25.4 * figure.get_size_inches()[0] == pytest.approx(WIDTHS[columns])
    sizes = [text.get_fontsize() for text in figure.findobj(Text) if text.get_text()]
    assert len(sizes) > 8
    assert 6.0 <= min(sizes) <= max(sizes) <= 8.0


def test_that_the_legend_of_a_small_figure_hides_no_data():
    figure = for_publication(drawn, "one")
    (legend,), (ax,) = figure.legends, figure.axes
    assert [text.get_text() for text in legend.get_texts()] == ["a line"]
    assert legend.get_window_extent().y1 <= ax.get_window_extent().y0
    assert for_publication(drawn, "two").axes[0].get_legend() is not None


def test_that_a_label_wider_than_its_axes_takes_two_lines():
    def two():
        figure, axes = plt.subplots(1, 2, figsize=(5.8, 3.0), layout="constrained")
        axes[1].set(xlabel="quantile of the standard normal distribution", title="short")
        return figure

    right = for_publication(two, "one").axes[1]
    assert right.get_xlabel().splitlines() == ["quantile of the standard", "normal distribution"]
    assert right.get_title() == "short"


def test_that_settings_do_not_leak():
    before = plt.rcParams["font.size"]
    for_publication(drawn, "one")
    assert plt.rcParams["font.size"] == before


def test_that_another_number_of_columns_is_refused():
    with pytest.raises(InputDataError, match="columns is 'three'; expected one or two"):
        for_publication(drawn, "three")


@pytest.mark.parametrize("eye", ["normal", *SEEN])
def test_that_the_colours_of_curves_can_be_told_apart(eye):
    linear = np.array([to_rgb(colour) for colour in CYCLE]) ** 2.2
    seen = np.clip(linear @ np.array(SEEN[eye]).T if eye in SEEN else linear, 0.0, 1.0) ** (1 / 2.2)
    nearest = min(float(np.linalg.norm(a - b)) for a, b in combinations(seen[:4], 2))
    assert nearest > 0.15
    red, green = (
        np.clip((np.array(x) ** 2.2) @ np.array(SEEN["deuteranopia"]).T, 0, 1) ** (1 / 2.2)
        for x in ([0.8, 0.3, 0], [0.45, 0.45, 0])
    )
    assert (
        np.linalg.norm(red - green) < 0.15
    )  # the measure sees that a red and a green may look the same
