"""``--medium`` on the command line: stated values reach the bubbles and the documents. What cannot be
is refused: benchmarks/bad_inputs/options.txt and stated.py.
"""

import json
import math
from pathlib import Path

import pytest

from imr_torch.cli import main
from imr_torch.files import read_json
from imr_torch.results import document_report
from imr_torch.units import Surroundings
from tests.results.documents import shot, write_table

pytestmark = pytest.mark.usefixtures("few_deviations")
QUICK = ["--physics", "polytropic", "--quiet"]
DENSE = Surroundings(density=1150.0)


def write_shot(folder: Path, medium: object = None, *, dense: Surroundings = DENSE) -> Path:
    """A curve in a gel of 1150 kg/m^3, and what the JSON beside it states."""
    if medium is not None:
        (folder / "shot.json").write_text(json.dumps({"medium": medium}))
    return write_table(shot(medium=dense), folder / "shot.csv")


def fit(path: Path, *more: str) -> list[str]:
    return [
        *f"characterize {path} --models nhkv --rest-radius 0.21:0.002".split(),
        *QUICK,
        *more,
    ]


def test_that_a_stated_density_gives_the_gel_and_another_one_is_inferred(
    tmp_path, capsys, said_by
):
    path = write_shot(tmp_path)
    result = tmp_path / "fit.json"
    page = tmp_path / "fit.html"
    said = said_by(
        [*fit(path, "--medium", "density=1150"), *f"--json {result} --html {page}".split()]
    )
    document = read_json(result)
    assert "Medium: density 1150 kg/m^3 (--medium); pressure" in said
    assert document["medium"]["density"] == {
        "value": 1150.0,
        "unit": "kg/m^3",
        "sd": None,
        "stated": True,
        "source": "--medium",
    }
    assert document["curves"][0]["time_scale_s"] == pytest.approx(
        float(DENSE.time_scale(300e-6)), rel=0.01
    )
    assert document["models"]["nhkv"]["intervals"]["G"][1] == pytest.approx(8310.0, rel=0.1)
    assert "density 1150 kg/m^3 (--medium)" in page.read_text()
    assert "--medium density=1150" in document["fit_test"]["command"]
    assert main([*fit(path), *f"--json {result} --html {page}".split()]) in (0, 1)
    said = capsys.readouterr().out
    assert "density was assumed 1060 +- 30 kg/m^3 and is" in said
    assumed = read_json(result)
    first = "Not stated, and inferred with the gel from a wide prior: density (1060 +- 30 kg/m^3)"
    # polytropic is said before
    assert document_report(assumed).splitlines()[1].startswith(first)
    assert first in page.read_text()
    assert assumed["medium"]["density"]["stated"] is False
    assert "density" not in [found["name"] for found in assumed["medium_sensitivities"]]


def test_that_an_unstated_density_of_a_gel_leaves_the_truth_inside(tmp_path):
    path = write_shot(tmp_path, dense=Surroundings(density=1100.0))
    main([*fit(path), "--json", str(tmp_path / "fit.json")])
    document = read_json(tmp_path / "fit.json")
    low, _, high = document["models"]["nhkv+density"]["intervals"]["G"]
    assert low < 8310.0 < high
    assert high > 1.3 * low  # a known density gives +- 5 %


def test_that_the_file_states_the_medium_and_the_command_counts_first(tmp_path, capsys):
    path = write_shot(tmp_path, {"density": [1150, 30]})
    result = tmp_path / "fit.json"
    assert main([*fit(path), "--json", str(result)]) == 0
    document = read_json(result)
    assert list(document["models"]) == ["nhkv+density"]
    assert document["medium"]["density"]["sd"] == 30.0
    assert "density was stated 1150 +- 30 kg/m^3 and is" in capsys.readouterr().out
    assert main([*fit(path, "--medium", "density=1100"), "--json", str(result)]) in (0, 1)
    assert (
        "Stated twice, density: 1100 (--medium) and 1150 +- 30" in capsys.readouterr().out
    )


def test_that_simulate_makes_the_bubble_of_the_medium(tmp_path):
    seconds = []
    for medium in (["--medium", "density=1150"], []):
        name = tmp_path / "bubble.json"
        command = f"simulate --set G=8310,mu=0.093 --json {name}"
        assert main([*command.split(), *medium, *QUICK]) == 0
        seconds.append(read_json(name)["time_s"][-1])
    assert seconds[0] / seconds[1] == pytest.approx(math.sqrt(1150.0 / 1060.0))


def test_that_diagnose_fits_in_the_stated_medium(tmp_path, said_by):
    path = write_shot(tmp_path)
    result = tmp_path / "gap.json"
    base = [
        *f"diagnose {path} --rest-radius 0.21:0.002 --effects sound_speed".split(),
        *QUICK,
        "--json",
        str(result),
    ]
    assert "Medium: density 1150 kg/m^3 (--medium)" in said_by(
        [*base, "--medium", "density=1150"]
    )
    document = read_json(result)
    assert document["verdict"] == "none"
    assert document["medium"]["density"]["value"] == 1150.0


def test_that_a_campaign_is_of_one_medium(tmp_path, said_by):
    out = tmp_path / "gel"
    base = (
        f"campaign --models nhkv --policy space-filling --repeats 1 --out {out}".split()
        + QUICK
    )
    rest = ["--rest-radius", "0.21:0.005"]
    assert main([*base, "--medium", "density=1150:10"]) == 0
    start = json.loads((out / "journal.jsonl").read_text().splitlines()[0])
    assert start["note"]["medium"]["density"]["value"] == 1150.0
    assert start["prior"]["models"][0]["model"] == "nhkv+density"
    assert "another campaign" in (
        said := said_by([*base, "--resume", "--medium", "density=1100:10"], 2)
    )
    assert "note.medium.density.value" in said
    path = write_shot(tmp_path, {"density": 1150, "temperature": 310})
    assert "states a temperature of 310 K" in said_by(
        [*base, *rest, *f"--resume --medium density=1150:10 --tell {path}".split()], 2
    )
    path = write_shot(tmp_path, {"density": 1140, "pressure": 101325})  # as assumed
    assert "Stated twice, density: 1150 +- 10 (--medium) and 1140" in said_by(
        [*base, *rest, *f"--resume --medium density=1150:10 --tell {path}".split()]
    )
    assert read_json(out / "campaign.json")["medium"]["density"]["sd"] == 10.0


def test_that_a_batch_takes_the_medium_of_each_file_or_that_of_all(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    write_shot(folder, {"density": 1150})
    base = [
        *f"batch {folder} --models nhkv --rest-radius 0.21:0.002 --workers 1".split(),
        *QUICK,
    ]
    values = []
    for more in ([], ["--medium", "density=1100"], []):
        assert main([*base, "--out", str(tmp_path / "out"), *more]) in (0, 1)
        values.append(
            read_json(tmp_path / "out" / "shots" / "shot.json")["medium"]["density"][
                "value"
            ]
        )
    assert values == [1150.0, 1100.0, 1150.0]
