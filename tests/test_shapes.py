"""The shapes in the annotations hold: a part of the tests runs once more, with every annotated
tensor checked.
"""

import os
import re
import subprocess
import sys

import pytest

from tests.processes import ROOT

CHECKED = (
    "tests/material/test_belief.py",
    "tests/material/test_marginals.py",
    "tests/material/test_parameters.py",
    "tests/simulate/test_sensitivity.py::test_that_followers_that_fail_or_fall_behind_leave_their_leader_alone[transport]",
    "tests/observe/test_nuisance.py",
    "tests/observe/test_experiments.py",
    "tests/observe/test_noise.py",
    "tests/assimilate/test_gauss_newton.py",
    "tests/assimilate/test_posterior.py",
    "tests/design/test_eig.py::test_laplace_is_exact_for_a_linear_gaussian_model",
    "tests/design/test_response.py",
    "tests/design/test_likelihood.py",
    "tests/goodness/test_phases.py",
    "tests/goodness/test_score.py",
    "tests/gap/test_examine.py",
    "tests/gap/test_shrinkage.py::test_that_curves_held_out_before_the_fits_judge_what_was_selected_with_all",
    "tests/gap/test_shrinkage.py::test_that_the_curve_that_judges_has_no_say_in_what_is_selected",
    "tests/export/test_sbi.py",
    "tests/test_examples.py",
)
STAGES = (
    "material",
    "simulate",
    "observe",
    "assimilate",
    "goodness",
    "select",
    "calibration",
    "gap",
    "export",
)
SLOW = (
    "are_scipys",
    "silent_on",
    "as_often_as",
    "hamiltonian",
)
REFUSED = (
    "bad_input",
    "refused",
    "rejected",
    "do_not_fit",
    "need_no_data",
)  # wrong shapes, which the check meets before the code does
WRONG = """
import torch
from imr_torch.material import Draws

def test_that_fits():
    Draws(torch.zeros(3, dtype=torch.long), torch.zeros(3, 2))

def test_that_does_not_fit():
    Draws(torch.zeros(3, dtype=torch.long), torch.zeros(2, 2))
"""


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """What pytest printed of the tests to check and of a wrong shape, in one process, since the checks take long to make."""
    wrong = tmp_path_factory.mktemp("shapes") / "test_wrong.py"
    wrong.write_text(WRONG)
    examples = " or ".join(f"imr_torch.{stage}" for stage in STAGES)
    chosen = f"(not test_examples.py or prints_what_it_says and ({examples})) and not {' and not '.join((*SLOW, *REFUSED))}"
    return ran(*CHECKED, str(wrong), "-k", chosen)


def ran(*arguments: str) -> str:
    """Standard output of pytest with the shapes checked."""
    options = ("--check-shapes", "--tb=short", "-rfE", "-p", "no:cacheprovider")
    command = (sys.executable, "-m", "pytest", *options, *arguments)
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert re.search(r"\d+ passed", done.stdout), done.stdout[-8000:] + done.stderr[-2000:]
    return done.stdout


def test_that_tensors_have_the_shapes_of_their_annotations(checked):
    failed = re.findall(
        r"^(?:FAILED|ERROR) \S*?((?:::)?[^/\s]+)(?:\s|$)", checked, re.MULTILINE
    )
    # of a file outside of the project
    assert failed == ["::test_that_does_not_fit"], checked[-8000:]
    assert int(re.findall(r"(\d+) passed", checked)[-1]) > 450


def test_that_a_wrong_shape_is_found(checked):
    assert "FAILED ::test_that_does_not_fit" in checked
    assert "jaxtyping.TypeCheckError" in checked
    assert "parameters" in checked
