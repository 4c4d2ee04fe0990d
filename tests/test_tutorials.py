"""Every tutorial runs from top to bottom, in a smoke mode that only makes it small."""

import importlib.util

import pytest

from tests.processes import ROOT

TUTORIALS = sorted((ROOT / "tutorials").glob("[0-9]*.py"))
NEEDS = {"16_on_a_cluster": "distributed", "17_neural_posterior_with_sbi": "sbi"}


def test_there_are_tutorials():
    assert len(TUTORIALS) >= 4


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_the_tutorial_runs(path, processes):
    if (needed := NEEDS.get(path.stem)) and importlib.util.find_spec(needed) is None:
        pytest.skip(f"{needed} is not installed")
    done = processes.run(path, env={"IMR_TORCH_SMOKE": "1"})
    assert done.returncode == 0, done.stderr[-3000:]
    assert len(done.stdout) > 200
