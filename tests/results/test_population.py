"""The population in a result document: figure and part of the page, and the command that makes it."""

import re

import matplotlib.pyplot as plt

from imr_torch import characterize, wide_prior
from imr_torch.cli import main
from imr_torch.files import read_json
from imr_torch.html import _make_environment
from imr_torch.material import PARAMETERS
from imr_torch.observe import Noise
from imr_torch.results import draw_figures
from imr_torch.results.intervals import population_figure
from tests.refusals import refused
from tests.results.documents import BAYES, SIMULATOR, population, traces, write_table


def test_that_every_shot_is_drawn_twice_beside_the_median():
    figure = population_figure(population())
    (ax,) = figure.axes
    bars = [bar for found in ax.containers for bar in found[2]]
    ends = [segment[:, 0].tolist() for bar in bars for segment in bar.get_segments()]
    assert ends == [[3.0, 7.0]] * 2 + [[4.0, 6.0]] * 2  # kPa: alone, given all
    assert [text.get_text() for text in ax.get_yticklabels()] == [r"\$x_{bad\$", "b"]
    assert ax.get_title() == "scatter 0.20 (0.10 to 0.40)"
    figure.canvas.draw()
    plt.close(figure)


def page_part(found: dict) -> str:
    names = {"parameters": PARAMETERS, "Noise": Noise}
    module = _make_environment().get_template("population.html").make_module(names)
    return str(module.population_part(found))


def test_that_the_page_states_median_scatter_and_evidence():
    text = page_part(population(cautions=["mu rises."]))
    cells = re.findall("<td>(.*?)</td>", text)
    assert cells[1:4] == [
        "6 kPa (90 %: 5 to 7)",
        "0.200 (90 %: 0.100 to 0.400) of ln G",
        "4.0 +- 0.1 nats",
    ]
    assert "Caution: mu rises." in text
    assert f"Noise of every shot: {Noise(scale=1.2)}." in text
    first, _ = page_part(population(log_bayes_factor=BAYES | {"value": 80.0})).split(
        "half-normal"
    )
    assert "above 30 nats" in first


def test_that_the_command_writes_report_json_figure_and_page(
    rendered, few_deviations, tmp_path, capsys
):
    out = tmp_path / "out"
    page = tmp_path / "page.html"
    known = "--physics polytropic --rest-radius 0.2:0.01 --noise published"
    options = f"--models nhkv --population {known} --quiet --out {out} --html {page}"
    gel = write_table(traces(("a", "b", "c")), tmp_path / "gel.csv")
    assert main(["characterize", str(gel), *options.split()]) == 0
    document = read_json(out / "characterize.json")
    found = document["population"]
    assert found["verdict"] in ("none", "undecided")  # three shots of one gel
    assert [shot["id"] for shot in found["shots"]] == ["a", "b", "c"]
    low, _, high = found["parameters"]["G"]["median"]
    assert low < 8310.0 < high
    assert (
        "Log evidence that a parameter scatters, over none"
        in (out / "report.txt").read_text()
    )
    assert (out / "population.png").stat().st_size > 5000
    assert "population" in [figure.name for figure in draw_figures(document)]
    assert "Does the gel differ from shot to shot?" in page.read_text()
    assert "standard deviation between shots of ln G" in capsys.readouterr().out


def test_that_a_population_of_one_curve_is_refused(monkeypatch):
    with refused("A population is inferred from curves, and there is 1"):
        characterize(traces(("a",)), simulator=SIMULATOR, population=True)
    monkeypatch.setattr("imr_torch.characterization.request.MOST", 2)
    with refused(
        "gen_qkv has 3 parameters of the gel, and at most 2 can differ between shots"
    ):
        characterize(
            traces(("a", "b")),
            prior=wide_prior(["gen_qkv"]),
            simulator=SIMULATOR,
            population=True,
        )
