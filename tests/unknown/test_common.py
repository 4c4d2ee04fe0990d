"""Several gels at once: what one cause in all of them is told from, and how it is said."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from imr_torch.cli import main
from imr_torch.files import example_gel
from imr_torch.float64 import eye, randn, zeros
from imr_torch.gap import compare_gels, library
from imr_torch.gap.document import laboratory_document
from imr_torch.gap.hypotheses import Inquiry
from imr_torch.material import LIBRARY
from imr_torch.random import generator
from imr_torch.results import document_page, document_report, draw_figures, header
from imr_torch.unknown import CommonCause, CommonUnknown
from imr_torch.unknown.common import Causes
from tests.gap.synthetic import BASE, DESIGNS, SIMULATOR, UNSURE, shoot

DRAG = CommonCause(
    "size_drag", 0.97, {"one": [12.0], "own": [6.0, 5.0]}, [[1e6, 2e6, 3e6]] * 3
)


def test_that_the_evidence_of_an_effect_is_the_gaussian_integral_over_its_strength():
    """Of a prior without bounds, from inner products of its column and the residual."""
    effect = LIBRARY["clock"]
    rows = randn(9, 2, generator=generator(3))
    column, residual = rows.unbind(1)
    causes = Causes({}, [(effect, ())])
    found = float(causes.weigh(rows.mT @ rows)[0])
    law = MultivariateNormal(zeros(9), eye(9) + torch.outer(column, column))
    none = MultivariateNormal(zeros(9), eye(9))
    assert found == pytest.approx(
        float(law.log_prob(residual) - none.log_prob(residual)), abs=1e-3
    )


@pytest.mark.parametrize(
    ("effects", "tried", "said"),
    [
        ([{"size_drag": 8e6}] * 2, ["size_drag"], {"common"}),
        ([{"size_drag": 8e6}] * 2, ["clock", "damage"], {"common"}),
        (
            [{"size_drag": 1.2e7}, {"alpha": 0.4}],
            ["size_drag", "strain_stiffening"],
            {"not shown"},
        ),
        ([{}, {}], ["size_drag", "damage"], {"none", "not shown"}),
    ],
)
def test_that_one_drag_is_common_and_other_effects_are_the_gels_own(effects, tried, said):
    """Also where the library does not hold what acts."""
    gels = {}
    for number, effect in enumerate(effects):
        batch = shoot(effect, DESIGNS[:2], repeats=10, seed=number, nuisance=UNSURE)
        gels[str(number)] = Inquiry(BASE, batch, SIMULATOR, library(tried))
    found = compare_gels(gels, seed=0)
    assert found.verdict in said
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    if tried == ["size_drag"]:
        assert found.causes[0].name == "size_drag"
        low, _, high = found.causes[0].intervals[0]
        assert low < 8e6 < high


@pytest.mark.parametrize(
    ("shares", "said"),
    [
        ({"one": 0.7, "both": 0.29, "own": 0.01}, "is missing in all of them; whether"),
        ({"own": 0.6, "law": 0.39, "one": 0.01}, "Nothing common is shown: what"),
        ({"nothing": 0.9, "shots": 0.1}, "No function and no effect is needed"),
        ({"own": 0.5, "one": 0.5}, "do not decide"),
    ],
)
def test_that_text_page_and_figure_say_the_verdict(shares, said):
    names = ("nothing", "shots", "own", "law", "one", "both")
    found = CommonUnknown(dict.fromkeys(names, 0.0) | shares, (DRAG,))
    media = {"a": "Medium: density 1030 kg/m^3 (stated).\nA note.", "b": "Medium: water."}
    document = header("laboratory") | laboratory_document(media, found)
    report = document_report(document)
    assert said in report.splitlines()[0]
    assert "  a: Medium: density 1030 kg/m^3 (stated).\n  b: Medium: water." in report
    assert ("looks most like: a drag" in report) is (shares.get("one", 0.0) > 0.6)
    page = document_page(document)
    assert "A note." in page
    assert said.split(";")[0] in page
    assert ('class="verdict warning"' in page) is (said.startswith(("do", "Nothing")))
    assert [figure.name for figure in draw_figures(document)] == ["causes"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([str(example_gel())], "give two or more"),
        (["gel.csv", "other/gel.csv"], "give two or more of different names"),
        (["gel.csv", "b.csv", "--heldout", "x"], "--heldout has no effect beside --gels"),
        (["set.npz", "b.csv"], "Sets (.npz) and files of curves cannot be mixed"),
    ],
)
def test_that_gels_need_two_files_of_other_names(arguments, said, capsys):
    assert main(["diagnose", *arguments, "--gels"]) == 2
    assert said in capsys.readouterr().err
