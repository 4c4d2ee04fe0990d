"""A misfit follows the numbers: every text and page that shows a fit's numbers says that its model misses the curves."""

import argparse
import json
from pathlib import Path

import pytest

from imr_torch import PolytropicSimulator, reference_case, wide_prior
from imr_torch.campaign import Campaign
from imr_torch.characterization.batch import BatchSummary
from imr_torch.characterization.compare import compare
from imr_torch.characterization.saved import SavedCharacterization
from imr_torch.cli.common import belief_cautions
from imr_torch.results import campaign_document, document_page, document_report, header
from imr_torch.results.page import TITLES
from tests.results.documents import documented, traces

MISSED = {"explained": False, "sentence": "Misfit: the model does not explain the curves."}


def characterize_document(_: Path) -> dict:
    document = documented(traces(("a",)))
    return document | {"fit_test": document["fit_test"] | MISSED}


def campaign_document_of(folder: Path) -> dict:
    made = Campaign(folder, reference_case("soft-pa").prior, PolytropicSimulator())
    return campaign_document(made) | {"fit_test": MISSED}


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


@pytest.mark.parametrize("kind", TITLES)
def test_that_text_and_page_say_that_the_model_misses_the_curves(kind: str, tmp_path: Path) -> None:
    document = header(kind) | DOCUMENTS[kind](tmp_path)
    assert "does not explain" in document_report(document)
    page = document_page(document)
    assert "does not explain" in page.partition("<details>")[0]
    assert 'class="verdict warning"' in page
