"""One file and one model give one value of each parameter, whatever command is asked."""

import csv
import math

import pytest

from imr_torch.cli import main
from imr_torch.files import read_json
from tests.fewer import sum_few_deviations
from tests.results.documents import GEL, traces, write_table

COMMON = [
    "--medium",
    "density=1060",
    "--rest-radius",
    "0.2:0.002",
    "--physics",
    "polytropic",
    "--quiet",
]


@pytest.fixture(scope="module")
def cheap_noise():
    with pytest.MonkeyPatch.context() as patch:
        sum_few_deviations(patch)
        yield


@pytest.fixture(scope="module")
def values(tmp_path_factory, cheap_noise):
    """Command -> parameter -> 5, 50, 95 %."""
    here = tmp_path_factory.mktemp("one_value")
    file = str(write_table(traces(("a", "b", "c"), noise=0.003), here / "gel.csv"))
    model = ["--models", "nhkv", *COMMON]
    of_gel = f"--population --json {here}/result.json".split()
    assert main(["characterize", file, *model, *of_gel]) == 0
    assert main(["batch", file, *model, *f"--workers 1 --out {here}/batch".split()]) == 0
    tried = f"--effects sound_speed --json {here}/gap.json".split()
    assert main(["diagnose", file, *COMMON, *tried]) == 0
    gel = read_json(here / "result.json")
    gap = read_json(here / "gap.json")
    assert gel["fit_test"]["explained"]
    assert gap["verdict"] == "none"
    with open(here / "batch" / "summary.csv", newline="") as table:
        (row,) = csv.DictReader(table)
    ends = ("_low", "", "_high")
    return {
        "characterize": gel["models"]["nhkv"]["intervals"],
        "batch": {name: [float(row[name + end]) for end in ends] for name in GEL},
        "diagnose": gap["parameters"],
        "population": {
            name: gel["population"]["parameters"][name]["median"] for name in GEL
        },
    }


@pytest.mark.parametrize("name", GEL)
def test_that_all_commands_agree_within_half_a_standard_deviation(values, name):
    low, middle, high = map(math.log, values["characterize"][name])
    sd = (high - low) / 3.29
    for command in ("batch", "diagnose", "population"):
        own = list(map(math.log, values[command][name]))
        assert abs(own[1] - middle) < 0.5 * max(sd, (own[2] - own[0]) / 3.29), command
        assert abs(own[1] - math.log(GEL[name])) < 3.0 * (own[2] - own[0]) / 3.29
    for command in ("batch", "diagnose"):  # the same posterior, so that widths agree too
        own = list(map(math.log, values[command][name]))
        assert 0.7 < (own[2] - own[0]) / (high - low) < 1.4, command
