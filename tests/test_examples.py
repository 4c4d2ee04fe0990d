"""The examples in docstrings run and print what they say, and every public object has one."""

import doctest
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from types import ModuleType

import pytest
import torch

import imr_torch

STAGES = (
    "material",
    "simulate",
    "observe",
    "record",
    "assimilate",
    "select",
    "population",
    "design",
    "campaign",
    "calibration",
    "gap",
)
OTHERS = (
    "characterization",
    "export",
    "units",
    "files",
    "random",
    "labels",
    "html",
    "results",
)
PUBLIC = ("imr_torch", *(f"imr_torch.{name}" for name in (*STAGES, *OTHERS)))
NEEDS = {
    "imr_torch.export.arviz": ("xarray", "arviz_base", "h5netcdf"),
}
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def modules() -> Iterator[ModuleType]:
    yield imr_torch
    for found in pkgutil.walk_packages(imr_torch.__path__, "imr_torch."):
        if not found.name.endswith("__main__"):
            yield importlib.import_module(found.name)


def examples() -> list[doctest.DocTest]:
    """One test per docstring with an example; its globals are empty, so an example imports all that it uses.

    Those of the design stage have the names of their module.
    """
    finder = doctest.DocTestFinder(exclude_empty=True)
    return [
        test
        for module in modules()
        for test in finder.find(
            module, globs=None if module.__name__.startswith("imr_torch.design") else {}
        )
        if test.examples
    ]


def public_objects() -> dict[str, object]:
    """Name -> class or function that a package exports, wherever it is defined; type aliases and
    data are left out.
    """
    found = {}
    for package in map(importlib.import_module, PUBLIC):
        own = [
            name
            for name, value in vars(package).items()
            if getattr(value, "__module__", "") == package.__name__
        ]
        for name in getattr(
            package, "__all__", [name for name in own if not name.startswith("_")]
        ):
            value = getattr(package, name)
            if inspect.isclass(value) or inspect.isfunction(value):
                found[f"{value.__module__}.{value.__qualname__}"] = value
    return found


@pytest.mark.parametrize("example", examples(), ids=lambda example: example.name)
def test_that_the_example_prints_what_it_says(example):
    for module, needed in NEEDS.items():
        if example.name.startswith(module):
            for name in needed:
                pytest.importorskip(name)
    said: list[str] = []
    with torch.random.fork_rng(devices=[]):
        failed = (
            doctest.DocTestRunner(optionflags=OPTIONS, verbose=False)
            .run(example, out=said.append)
            .failed
        )
    assert failed == 0, "".join(said)


OBJECTS = public_objects()


@pytest.mark.parametrize("name", OBJECTS)
def test_that_the_public_object_has_an_example(name):
    assert ">>>" in (inspect.getdoc(OBJECTS[name]) or "")


def test_that_the_public_objects_are_looked_at():
    assert len(OBJECTS) > 150
    assert {
        "imr_torch.characterization.infer.characterize",
        "imr_torch.units.Surroundings",
        "imr_torch.gap.diagnose.diagnose",
    } <= set(OBJECTS)
