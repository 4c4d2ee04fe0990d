"""The check of the lock finds a package that is not pinned, another version, and two versions that one file cannot hold."""

import tomllib

import pytest

from tools.locks import CONSTRAINTS, PYTHONS, ROOT, pins, united, unpinned


def test_that_a_file_of_constraints_is_read():
    text = "# what was tested\nTorch_Diff.eq==0.2.5\nuvloop==0.23.0 ; sys_platform != 'win32'\n\nnumpy>=1\n"
    assert pins(text) == {"torch-diff-eq": "0.2.5", "uvloop": "0.23.0"}


def test_that_a_package_that_is_not_pinned_is_named():
    assert unpinned({"a": "1"}, {"a": "1", "b": "2"}) == []
    for pinned in ({}, {"a": "2"}, {"b": "1"}):
        assert unpinned({"a": "1"}, pinned) == ["a==1"]


def test_that_resolutions_are_united_in_order():
    assert list(united([{"b": "1"}, {"a": "2", "b": "1"}])) == ["a", "b"]


def test_that_two_versions_of_a_package_are_refused():
    with pytest.raises(
        ValueError, match=r"a: one resolution has 1, another 2; pin one that fits both"
    ):
        united([{"a": "1"}, {"a": "2"}])


def test_that_every_requirement_of_the_package_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = [
        *project["dependencies"],
        *(line for extra in project["optional-dependencies"].values() for line in extra),
    ]
    pinned = pins(CONSTRAINTS.read_text())
    assert [
        line
        for line in asked
        if line.partition(">=")[0].partition("<")[0].lower() not in pinned
    ] == []


def test_that_the_versions_are_those_that_the_package_names():
    named = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert named["requires-python"] == f">={PYTHONS[0]}"
    assert [
        f"Programming Language :: Python :: {number}" in named["classifiers"]
        for number in PYTHONS
    ] == [True] * len(PYTHONS)
