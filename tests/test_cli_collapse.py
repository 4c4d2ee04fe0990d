"""Tables of collapse times on the command line: result, figure and page. What is refused beside them:
benchmarks/bad_inputs/collapse_tables.py.
"""

from pathlib import Path

import pytest

from imr_torch.cli import main
from imr_torch.files import read_json
from imr_torch.observe import load_collapse_times
from imr_torch.results import document_page, draw_figures

DATA = Path(__file__).parents[1] / "imr_torch" / "data"
QUICK = ["--physics", "polytropic", "--models", "nhkv", "--quiet"]
TABLE = DATA / "pimr_pa_05.csv"


def test_that_a_table_gives_result_figure_and_page(tmp_path, capsys):
    names = ",".join(f"pimr_pa_05_{i:02d}" for i in range(1, 14))
    page = tmp_path / "page.html"
    out = tmp_path / "out"
    code = main(
        [
            "characterize",
            str(TABLE),
            *QUICK,
            "--experiments",
            names,
            *f"--html {page} --out {out}".split(),
        ]
    )
    assert code == 0
    said = capsys.readouterr().out
    document = read_json(out / "characterize.json")
    assert "13 shot(s) of which the collapse time alone is known" in said
    stated = said[said.index("Medium: density 998.2 kg/m^3, ") :]  # in the JSON beside
    assert stated.index("(polyacrylamide, ") < stated.index("(assumed)")
    assert [x["id"] for x in document["collapse_times"]] == names.split(",")
    assert document["curves"] == []
    assert document["collapse_times"][0]["Rmax_m"] == pytest.approx(3.4017647e-4, rel=1e-6)
    assert (
        abs(
            document["collapse_times"][0]["t_star"]
            - document["collapse_times"][0]["predicted"]
        )
        < 0.03
    )
    low, middle, high = document["models"]["nhkv"]["intervals"]["G"]
    assert 500.0 < low < middle < high < 20e3
    assert "Error of a collapse time" in page.read_text()
    assert "root mean square" in page.read_text()
    assert (out / "collapse_times.png").exists()
    assert "collapse_times" in [figure.name for figure in draw_figures(document)]
    assert (
        "It was not tested whether the model explains the collapse times"
        in document_page(document)
    )


@pytest.mark.parametrize(("name", "count"), [("pimr_pa_05", 52), ("pimr_pa_10", 39)])
def test_that_the_data_carry_their_notice(name, count):
    document = read_json(DATA / f"{name}.json")
    assert document["licence"] == "BSD-3-Clause, Copyright (c) 2025, Zhiren Zhu"
    assert (
        "Redistributions of source code must retain the above copyright notice"
        in document["licence_text"]
    )
    assert len(load_collapse_times(DATA / f"{name}.csv")) == count
