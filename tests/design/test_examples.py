"""The examples in the docstrings of the design stage run and give what they say."""

import doctest
import importlib
import pkgutil

import pytest

import imr_torch.design

MODULES = [
    f"imr_torch.design.{info.name}"
    for info in pkgutil.iter_modules(imr_torch.design.__path__)
]
SHOWN = {
    "acquisition",
    "gain",
    "laplace",
    "nested",
    "search",
}


@pytest.mark.parametrize("name", MODULES)
def test_that_the_examples_of_a_module_are_right(name):
    found = doctest.testmod(
        importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE
    )
    assert found.failed == 0
    assert found.attempted > 0 or name.rpartition(".")[2] not in SHOWN
