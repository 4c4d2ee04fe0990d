"""Every benchmark can be started: what it imports from the package is there."""

import importlib

import pytest

from tests.processes import ROOT

MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "benchmarks").rglob("*.py")
    if path.stem != "pyimr_worker"  # which runs in an environment of its own
)


@pytest.mark.parametrize("module", MODULES)
def test_that_it_imports(module):
    assert importlib.import_module(module).__doc__
