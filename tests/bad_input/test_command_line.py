"""Bad inputs of every kind through the command line: one clear line that names what is wrong,
before any fit.
"""

from itertools import islice

import pytest

from benchmarks.bad_inputs import Case, cases, prepared, tried

DAMAGED = 6  # damaged files of each kind; benchmarks/bad_inputs tries more
KINDS = (
    "table",
    "scale",
    "sidecar",
    "layout",
    "set",
    "option",
    "times",
    "target",
    "belief",
    "journal",
    "result",
    "stated",
    "damaged",
)


@pytest.fixture(scope="module")
def every(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad_inputs") / "good"
    prepared(folder)
    return thin(list(cases(folder, DAMAGED)))


def thin(every: list[Case]) -> list[Case]:
    """Each entry of a curve is left out or null, in turn, since a page of figures is made before
    that is known; benchmarks/bad_inputs tries both.
    """
    curves = [case for case in every if case.name.startswith("plot curve")]
    twice = {id(case) for number, case in enumerate(curves) if number % 4 in (1, 2)}
    return [case for case in every if id(case) not in twice]


@pytest.mark.parametrize("kind", KINDS)
def test_that_bad_inputs_are_refused_or_warned_of_in_one_line(every, kind, tmp_path):
    found = [tried(case, tmp_path) for case in every if case.kind == kind]
    assert len(found) >= 30
    assert [
        (o.case.name, o.verdict, o.said[-200:]) for o in found if o.verdict != "handled"
    ] == []


def test_that_the_net_catches_what_is_accepted_and_what_crashes(
    every, tmp_path, monkeypatch
):
    (good,) = islice((case for case in every if case.name == "Windows lines"), 1)
    accepted = Case("table", "good", good.arguments, "gel.csv", good.make)
    assert tried(accepted, tmp_path).verdict == "accepted"
    unwarned = Case(
        "table", "good", good.arguments, "gel.csv", good.make, warned="never said"
    )
    assert tried(unwarned, tmp_path).verdict == "unclear"
    monkeypatch.setattr(
        "imr_torch.cli.characterize.load_traces", lambda *_, **__: {}["missing"]
    )
    assert tried(accepted, tmp_path).verdict == "traceback"
