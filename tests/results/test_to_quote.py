"""The last sentence of a report says what may be quoted, or that nothing can be, and the page says the
same first.
"""

import copy
import re

import pytest

from imr_torch.gap import MediumSensitivity
from imr_torch.results import document_page, document_report
from tests.results.documents import documented, population, traces
from tests.results.test_misfit import MISSED

APART = {"parts": {"agree": False, "sentences": ["Parts of the records disagree."]}}
ASSUMED = MediumSensitivity(
    "far_field_pressure", "101 kPa", 1.02, {"G": -0.1}, {"G": -1.2}
).to_dict()


@pytest.fixture(scope="module")
def found():
    return documented(traces(("a", "b"), noise=0.003))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, "Quote for NHKV: G "),
        (
            {"model_probabilities": {"nhkv": 0.7}},
            "say that the model has a probability of 0.70",
        ),
        ({"fit_test": None}, "say that it was not tested whether it explains the data"),
        ({"medium_unstated": "Not stated."}, "say that the density was not measured"),
        (
            {"medium_sensitivities": [ASSUMED]},
            "; it holds for the assumed pressure 101 kPa.",
        ),
        (
            {"physics": "polytropic"},
            "say that the gas was polytropic, which biases G and mu",
        ),
        (APART, "say that parts of the records disagree"),
        (
            {"fit_test": MISSED} | APART,
            "Quote nothing of these curves: NHKV does not explain them",
        ),
        ({"converged": False}, "Quote nothing: the fit of NHKV has not converged"),
        (
            {"verdict": "refused"},
            "Quote nothing: the computation of the intervals of NHKV is not",
        ),
        ({"collapse_patterns": ["a pattern"]}, "Quote medians alone"),
        (
            {"fit_test": MISSED, "population": population(verdict="scatter")},
            "Quote the population, since the shots differ and the model explains each by itself: median G 6 kPa",
        ),
        ({"population": population(verdict="undecided")}, "Quote for NHKV: G "),
        (
            {
                "fit_test": MISSED,
                "population": population(verdict="scatter", cautions=["missed."]),
            },
            "no interval holds the error of a wrong model, the population",
        ),
    ],
)
def test_that_the_last_sentence_says_what_to_quote(found, change, said):
    document = copy.deepcopy(found)
    model = document["models"]["nhkv"]
    model["verdict"] = change.get("verdict", "trusted")
    model["certificate"]["converged"] = change.get("converged", True)
    kept = {k: v for k, v in change.items() if k not in ("verdict", "converged")}
    if change.get("fit_test"):
        kept["fit_test"] = document["fit_test"] | MISSED
    if change.get("parts"):
        kept["parts"] = document["parts"] | change["parts"]
    document |= {"physics": "transport"} | kept
    first, *_, last = document_report(document).splitlines()
    assert said in last
    undecided = change.get("population", {}).get("verdict") == "undecided"
    assert (
        "differs from shot to shot, if at all, by" in document_report(document)
    ) is undecided
    if "parts" in change:
        missed = "fit_test" in change
        assert first.startswith(
            "Misfit" if missed else "Parts of the records disagree. The model"
        )
    assert (
        ("polytropic" in first)
        == ("polytropic" in last)
        == (document["physics"] == "polytropic")
    )
    assert said in document_page(document).partition("<section>")[0]


def of_two_models(found, probability, error):
    """The document of a characterisation whose second model is the first again."""
    document = copy.deepcopy(found)
    document["models"]["newtonian"] = document["models"]["nhkv"]
    document["model_probabilities"] = {"nhkv": probability, "newtonian": 1.0 - probability}
    document["model_probability_errors"] = {"nhkv": error, "newtonian": error}
    return document


def test_that_no_probability_is_said_to_be_sure(found):
    text = document_report(of_two_models(found, 0.99999, 1e-6))
    assert "probability above 0.999" in text
    assert "probability below 0.001" in text
    assert "1.000" not in text


def test_that_an_undecided_probability_is_quoted_nowhere(found):
    document = of_two_models(found, 0.9, 0.87)
    for text in (document_report(document), document_page(document)):
        assert "probability undecided (0.90 +- 0.87; --effort thorough draws more)" in text
        assert "say that too few draws decide between the 2 candidates" in text
        assert not re.search(r"0\.90(?! \+-)", text.partition("data:image")[0])
