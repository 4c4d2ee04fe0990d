"""The controls of measured gels:

each can be met and missed, and is open where the record lacks what it needs.
"""

from typing import Any

import pytest

from benchmarks.real_gels_controls import Control, best_step, controls, first_choice

GELS = ("one", "two", "three")


def step(
    *effects: str, closed: float | None = None, score: float = 0.0, **others: Any
) -> dict[str, Any]:
    judged = None if closed is None else [closed - 0.1, closed, closed + 0.1]
    score_said = None if closed is None else [score, 1.0]
    said = {
        "effects": list(effects),
        "added": effects[-1] if effects else None,
        "alternatives": [],
        "closed": judged,
    }
    return (
        said | {"log_score": score_said, "misfit": 0.01, "noise": 0.01, "converged": True} | others
    )


def row(
    *steps: dict[str, Any], cpu: float = 50.0, differing: dict[str, Any] | None = None
) -> dict[str, Any]:
    ladder = [step(), *steps]
    said = {
        "verdict": "other",
        "cause": [],
        "curves": ["a", "b"],
        "effects": ["clock", "wall", "pulse"],
        "cpu": cpu,
    }
    return said | {"ladder": ladder, "differing": differing}


def record(
    diagnosed: list[dict[str, Any]], others: list[dict[str, Any]] | None = None
) -> dict[tuple[str, str], dict[str, Any]]:
    found = {(name, "diagnose"): own for name, own in zip(GELS, diagnosed, strict=False)}
    return found | {
        (name, "other half"): own for name, own in zip(GELS, others or [], strict=False)
    }


def of(name: str, rows: dict[tuple[str, str], dict[str, Any]]) -> Control:
    (found,) = (control for control in controls(rows) if control.name.startswith(name))
    return found


def test_that_an_empty_record_leaves_every_control_open() -> None:
    assert {control.met for control in controls({})} == {None}


def test_that_what_is_reported_is_the_best_predictor_that_closes_some_of_the_gap() -> None:
    clock = step("clock", closed=0.4, score=20.0)
    wall = step("clock", "wall", closed=-0.2, score=50.0)
    apart = step("gel_scatter", closed=0.1, score=30.0)
    assert best_step(row(clock, wall)) is clock
    assert best_step(row(clock, wall, differing=apart)) is apart
    assert best_step(row(step("clock", closed=0.3, score=-2.0)))["effects"] == []


def test_that_steps_with_effects_of_usual_strength_are_counted_by_themselves() -> None:
    clock = step("clock", closed=0.4, score=20.0, unusual={})
    wall = step("wall", closed=0.9, score=50.0, unusual={"wall": 9.0})
    assert best_step(row(clock, wall)) is wall
    assert best_step(row(clock, wall), usual=True) is clock
    assert (
        "all of usual strength, 0.40"
        in of("share of the gap closed", record([row(clock, wall)])).value
    )


@pytest.mark.parametrize(("share", "met"), [(0.81, True), (0.79, False)])
def test_that_the_median_share_that_is_closed_decides(share: float, met: bool) -> None:
    rows = [row(step("clock", closed=own, score=5.0)) for own in (0.1, share, 0.95)]
    found = of("share of the gap closed", record(rows))
    assert found.met is met
    assert f"median {share:.2f} of 3 sets" in found.value


def test_that_a_step_without_a_certificate_and_one_that_predicts_worse_are_missed() -> None:
    good = row(step("clock", closed=0.9, score=5.0))
    bad = row(step("clock", closed=0.9, score=-5.0, converged=False))
    assert of("certificates", record([good, good])).met
    assert of("held-out log score", record([good, good])).met
    assert not of("certificates", record([good, bad])).met
    assert not of("held-out log score", record([good, bad])).met


def test_that_halves_agree_by_their_first_addition_and_also_by_what_is_not_clearly_worse() -> None:
    clock = row(step("clock", closed=0.9))
    wall = row(step("wall", closed=0.9))
    either = row(step("wall", closed=0.9, alternatives=["clock"]))
    assert first_choice(either) == {"wall", "clock"}
    assert of("the same gel", record([clock, clock], [clock, clock])).met
    assert not of("the same gel", record([clock, clock], [wall, clock])).met
    assert not of("the same gel", record([clock], [either])).met
    assert of("the same, additions", record([clock], [either])).met


def test_that_halves_of_all_curves_are_counted_by_themselves() -> None:
    clock, wall, none = (
        row(*steps) for steps in ([step("clock")], [step("wall", alternatives=["clock"])], [])
    )
    pairs = {
        ("one", "halves"): [clock, clock],
        ("two", "halves"): [clock, wall],
        ("three", "halves"): [clock, none],
    }
    found = of(
        "the same, halves of all", {key: {"halves": halves} for key, halves in pairs.items()}
    )
    assert (
        found.value == "1 of 3 sets; 2 with those that are not clearly worse; 2 to 2 curves a half"
    )
    assert not found.met
    assert of("the same, halves of all", {("one", "halves"): {"halves": [none, none]}}).met
    none = row() | {"ladder": None}
    assert of("the same gel", record([none], [none])).met  # no gap in both
    assert not of("the same gel", record([clock], [none])).met


def test_that_one_set_that_takes_longer_misses_the_time() -> None:
    fast = row(step("clock", closed=0.9))
    slow = row(step("clock", closed=0.9), cpu=130.0)
    assert of("processor time", record([fast, fast])).met
    found = of("processor time", record([fast, slow]))
    assert not found.met
    assert "1 of 2 sets within 120 s" in found.value


def test_that_a_cause_named_in_water_or_an_elastic_one_in_a_liquid_is_missed() -> None:
    quiet = row()
    named = row() | {"verdict": "effect", "cause": ["sound_speed"]}
    water = {
        (name, task): quiet
        for name in ("water_laser", "water_histotripsy")
        for task in ("diagnose", "other half")
    }
    assert of("water", water).met
    assert not of("water", water | {("water_laser", "diagnose"): named}).met
    liquids = {
        (f"peg8k_{share}pct_liquid", task): quiet
        for share in (20, 40, 60, 80)
        for task in ("diagnose", "other half")
    }
    elastic = row() | {"verdict": "effect", "cause": ["damage"]}
    assert of("causes in the PEG 8k liquids", liquids).met
    assert not of(
        "causes in the PEG 8k liquids", liquids | {("peg8k_40pct_liquid", "diagnose"): elastic}
    ).met
