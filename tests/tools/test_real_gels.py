"""The page of measured gels follows from its record, and the one that is kept from the one that is kept."""

import torch

from benchmarks.real_gels import away_from_first_collapse
from benchmarks.real_gels_page import write_page
from benchmarks.records import read_record
from imr_torch.float64 import tensor
from imr_torch.observe import Experiment
from tests.figures import rendering
from tests.processes import ROOT

KEPT = ROOT / "docs" / "_static" / "measured"
ROWS = read_record(ROOT / "benchmarks" / "records" / "real_gels.jsonl")


def write(rows, folder) -> tuple[str, dict[str, bytes]]:
    page = folder / "benchmarks" / "REAL_GELS.md"
    page.parent.mkdir(parents=True)
    figures = folder / KEPT.relative_to(ROOT)
    with rendering():
        write_page(rows, page, figures)
    return page.read_text(), {path.name: path.read_bytes() for path in figures.iterdir()}


def test_that_the_page_is_that_of_the_record_and_figures_are_the_same_when_made_again(
    tmp_path,
):
    page, figures = write(ROWS, tmp_path)
    assert page == (ROOT / "benchmarks" / "REAL_GELS.md").read_text()
    assert {path.name for path in KEPT.iterdir()} == figures.keys()
    assert sum(map(len, figures.values())) < 300_000
    assert write(ROWS[:1], tmp_path / "again")[1].items() <= figures.items()


def test_that_what_may_be_quoted_follows_the_verdict(tmp_path):
    row = next(row for row in ROWS if row["key"] == "pa_stiff_estrada/diagnose")
    nothing, _ = write([row], tmp_path)
    assert (
        "Nothing can be quoted, since no cause is named: with what it may lack G" in nothing
    )
    named = {"cause": ["wall"], "parameters": {"G": [2e3, 3e3, 4e3], "mu": [1, 2, 3]}}
    page, _ = write([row | named], tmp_path / "named")
    low, _, high = row["parameters_with_model_error"]["G"]
    wide = f"{low / 1e3:.3g} to {high / 1e3:.3g} with what it may lack"
    assert f"To quote: G is 3 (2 to 4) kPa ({wide}), 1.1 times" in page


def test_which_frames_are_next_to_the_first_collapse():
    radius = tensor([1.0, 0.8, 0.5, 0.25, 0.05, 0.18, 0.35, 0.3, 0.1, 0.25])  # R_inf is .2
    shot = Experiment("shot", (300.0, 0.2), torch.arange(10.0).double(), radius[None])
    away = away_from_first_collapse(shot)
    assert away.tolist() == [True] * 3 + [False] * 3 + [True] * 4
