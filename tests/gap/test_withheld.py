"""The whole diagnosis of one effect: named where it is offered, "other" where it was withheld, with
what came nearest.
"""

import re

import pytest

from tests.gap.synthetic import DESIGNS, diagnose_offered, shoot

TRUTH = "gas_loss"
RIVALS = ["wall", "refraction"]


@pytest.fixture(scope="module")
def experiments():
    return shoot({TRUTH: 0.3}, DESIGNS).experiments


def test_that_an_effect_is_named_where_it_is_offered(experiments):
    report = diagnose_offered(experiments, [TRUTH, *RIVALS], seed=1)
    assert (report.verdict, report.cause) == ("effect", (TRUTH,))
    assert report.converged


def test_that_it_is_other_where_it_was_withheld(experiments):
    report = diagnose_offered(experiments, RIVALS, seed=1)
    assert (report.verdict, report.cause) == ("other", ())
    said = re.fullmatch(
        r"No effect of the library is enough; nearest comes (.+) \((\d+) nats; the misfit in R\* goes from (.+) to (.+); "
        r"adequacy p ([=<]) (.+)\)\.",
        report.reason,
    )
    assert set(said[1].split(" and ")) <= set(RIVALS)
    assert float(said[2]) > 3.0
    assert float(said[4]) < float(said[3]) == round(report.gap.bias_radius, 4)
    assert said[5] == "<" or float(said[6]) < 1e-4
