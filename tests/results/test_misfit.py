"""A misfit follows the numbers: every text and page that shows a fit's numbers says that its model misses the curves."""

import argparse
import json
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from scipy.io import loadmat

from imr_torch import PolytropicSimulator, reference_case, wide_prior
from imr_torch.campaign import Campaign
from imr_torch.characterization.batch import BatchSummary
from imr_torch.characterization.compare import compare
from imr_torch.characterization.saved import SavedCharacterization
from imr_torch.cli.common import belief_cautions
from imr_torch.export import write_mat
from imr_torch.results import (
    campaign_document,
    document_page,
    document_report,
    draw_figures,
    header,
)
from imr_torch.results.page import KINDS
from tests.refusals import refused
from tests.results.documents import documented, traces

MISSED = {"explained": False, "sentence": "Misfit: the model does not explain the curves."}


def characterize_document(_: Path) -> dict:
    document = documented(traces(("a",)))
    return document | {"fit_test": document["fit_test"] | MISSED}


def campaign_document_of(folder: Path) -> dict:
    made = Campaign(folder, reference_case("soft-pa").prior, PolytropicSimulator())
    next_shot = {"We": 400.0, "R_inf*": 0.2, "Rmax_m": 5.7e-4, "R_inf_m": 1.1e-4}
    shown = next_shot | {"step": 1, "gain": None, "reason": "", "stop": None}
    return campaign_document(made) | {"fit_test": MISSED, "proposals": [shown]}


def saved() -> dict:
    belief = wide_prior(["nhkv"]).to_dict()
    return {"belief": belief, "models": {"nhkv": {}}, "fit_test": {"explained": False}}


def design_document(folder: Path) -> dict:
    path = folder / "result.json"
    path.write_text(json.dumps(saved()))
    cautions = belief_cautions(argparse.Namespace(belief=str(path)))
    design = {"We": 400.0, "R_inf*": 0.2, "Rmax_m": 5.7e-4}
    found = {"design": design, "eig": 3.2, "eig_sd": 0.1, "evaluations": [], "map": None}
    return found | {"cautions": cautions}


def batch_document(_: Path) -> dict:
    row = {
        "shot": "a",
        "status": "done",
        "explained": "no",
        "curves": 1,
        "We": 300.0,
        "R_inf*": 0.2,
    }
    fit = {"model": "nhkv", "probability": 1.0, "G_low": 4e3, "G": 5e3, "G_high": 6e3}
    return BatchSummary((row | fit,)).to_dict()


def compare_document(_: Path) -> dict:
    gel = SavedCharacterization.from_dict(saved())
    return compare(gel, gel).to_dict()


DOCUMENTS = {
    "characterize": characterize_document,
    "campaign": campaign_document_of,
    "design": design_document,
    "batch": batch_document,
    "compare": compare_document,
}


def test_that_every_kind_of_result_with_a_page_is_among_these():
    others = {"diagnose", "laboratory"}  # which tests/gap and tests/unknown read
    assert {*KINDS} == {*DOCUMENTS} | others


@pytest.mark.parametrize("kind", DOCUMENTS)
def test_that_text_and_page_say_that_the_model_misses_the_curves(kind, tmp_path):
    document = header(kind) | DOCUMENTS[kind](tmp_path)
    report = document_report(document)
    assert "does not explain" in report
    assert ("lacks first (imr-torch diagnose" in report) is (kind == "campaign")
    page = document_page(document)
    for text in (report, page):
        assert ("Quote nothing of these curves" in text) is (
            kind in ("campaign", "characterize")
        )
    assert "does not explain" in page.partition("<details>")[0]
    assert 'class="verdict warning"' in page


@pytest.fixture(scope="module")
def missed():
    return characterize_document(Path())


def test_that_every_figure_of_a_misfit_says_so(missed):
    two = header("compare") | compare_document(Path())
    for document, said in (
        (missed, True),
        (missed | {"fit_test": None}, False),
        (two, True),
    ):
        for item in draw_figures(document):
            figure = item.draw()
            fitted = item.name != "record"
            assert ("does not explain" in figure.get_supxlabel()) is (said and fitted)
            plt.close(figure)


def test_that_tables_and_matlab_files_say_so(missed, tmp_path):
    gel = SavedCharacterization.from_dict(missed)
    assert [row["explained"] for row in gel.rows()] == [False] * len(gel.intervals())
    write_mat(missed, tmp_path / "gel.mat")
    assert "does not explain" in loadmat(tmp_path / "gel.mat", squeeze_me=True)["fit"]


def test_that_the_largest_residual_of_the_sentence_is_that_of_the_figures():
    document = documented(traces(("a", "b"), noise=0.003))
    own = [
        value
        for curve in document["curves"]
        for value in curve["models"]["nhkv"]["residual_over_sd"]
    ]
    assert document["fit_test"]["sigma"] == pytest.approx(max(own, key=abs), rel=1e-6)


def test_that_a_result_that_says_something_else_of_its_fit_is_refused(missed):
    for said in (5, "no", [1], True, {"explained": "no"}):
        with refused("fit_test"):
            SavedCharacterization.from_dict(missed | {"fit_test": said})
