"""Figures: axes in laboratory units, densities that are no lines, a star that is whole, labels as they are."""

import matplotlib.pyplot as plt
import pytest
import torch

from imr_torch import wide_prior
from imr_torch.float64 import linspace
from imr_torch.observe import Experiment
from imr_torch.results.plot import (
    draw_information,
    draw_parameters,
    plot_parameter,
    plot_probabilities,
)


@pytest.fixture(autouse=True)
def close():
    yield
    plt.close("all")


def narrow(prior, factor: float):
    return prior.with_gaussian(prior.mean + 0.5, factor * prior.chol)


def experiment(label: str = "$x_{bad$") -> Experiment:
    times = linspace(0.0, 2.0, 21)
    return Experiment(label, (300.0, 0.2), times, (1.0 - 0.2 * times)[None])


def test_that_a_wide_density_has_a_logarithmic_axis():
    prior = wide_prior(["nhkv"])["nhkv"]
    ax = plot_parameter((("prior", prior), ("posterior", narrow(prior, 0.01))), "G")
    assert ax.get_xscale() == "log"
    assert ax.get_xlabel() == "$G$ (kPa)"


def test_that_a_narrow_density_has_a_linear_axis():
    belief = narrow(wide_prior(["nhkv"])["nhkv"], 0.05)
    ax = plot_parameter((("posterior", belief),), "mu", truth=0.1)
    assert ax.get_xscale() == "linear"


def test_that_the_joint_plot_has_every_pair_once():
    belief = narrow(wide_prior(["gen_qkv"])["gen_qkv"], 0.1)
    figure = draw_parameters(belief)
    drawn = [ax for ax in figure.axes if ax.axison]
    assert len(drawn) == 6
    labels = {ax.get_xlabel() for ax in drawn} | {ax.get_ylabel() for ax in drawn}
    assert labels >= {"$G$ (kPa)", r"$\mu$ (Pa s)", r"$\alpha$"}


@pytest.mark.parametrize("place", [(100.0, 0.14), (1000.0, 0.30)])
def test_that_a_star_on_the_border_is_inside_the_axes(place):
    axis = torch.linspace(0.0, 1.0, 10)
    values = {
        "We": (100 + 900 * axis).tolist(),
        "R_inf*": (0.14 + 0.16 * axis).tolist(),
        "nats": (axis[:, None] + axis).tolist(),
    }
    chosen = {"We": place[0], "R_inf*": place[1], "Rmax_m": 1e-6 * place[0]}
    evaluated = [{"We": 300.0, "R_inf*": 0.2}]
    ax = draw_information({"map": values, "evaluations": evaluated, "design": chosen})
    ax.figure.canvas.draw()
    x, y = ax.transAxes.inverted().transform(ax.transData.transform(place))
    assert 0.03 < x < 0.97
    assert 0.03 < y < 0.97
    (top,) = ax.child_axes
    assert top.get_xlim() == pytest.approx(ax.get_xlim())  # here 1 um for each unit of We
    assert "R_\\mathrm{max}" in top.get_xlabel()


def test_that_labels_of_beliefs_are_not_mathematics():
    prior = wide_prior(["newtonian", "nhkv"])
    ax = plot_probabilities((("$a$", prior), ("$b$", prior)))
    assert [t.get_text() for t in ax.get_xticklabels()] == [r"\$a\$", r"\$b\$"]
