"""What a person states about a curve counts before the frames, the file and the laboratory."""

import json
from dataclasses import replace
from pathlib import Path

import torch

from imr_torch.files import read_json
from imr_torch.float64 import linspace
from imr_torch.observe import (
    Given,
    Override,
    RadiusTrace,
    TraceSet,
    find_landmarks,
    load_traces,
    prepare,
    state,
)
from tests.refusals import refusals, refused
from tests.results.documents import write_table


def trace(override: Override | None = None) -> RadiusTrace:
    time = linspace(-4e-6, 90e-6, 189)
    radius = 200e-6 * (
        0.55 + 0.45 * (-time.clamp(min=0.0) / 2e-4).exp() * torch.cos(1.6e5 * time)
    )
    return RadiusTrace(
        "shot",
        time,
        radius,
        "memory",
        Given(rest_radius_m=5e-5, rest_settled=True, override=override),
    )


def write(
    folder: Path, curves: tuple[str, ...] = ("shot",), beside: dict | None = None
) -> Path:
    if beside is not None:
        (folder / "gel.json").write_text(json.dumps(beside))
    records = TraceSet(tuple(replace(trace(), experiment_id=name) for name in curves))
    return write_table(records, folder / "gel.csv")


def test_that_what_is_stated_replaces_what_is_found_and_the_rest_is_found():
    found = find_landmarks(trace())
    stated = find_landmarks(
        trace(Override(max_radius_m=2.05e-4, rest_radius_m=6e-5, rest_radius_sd_m=3e-6))
    )
    assert (stated.max_radius_m, stated.max_method) == (2.05e-4, "as stated")
    assert stated.time_of_max_s == found.time_of_max_s
    assert (stated.rest_radius_m, stated.rest_radius_sd_m, stated.rest_method) == (
        6e-5,
        3e-6,
        "as stated",
    )
    late = find_landmarks(trace(Override(time_of_max_s=1e-6)))
    assert (late.time_of_max_s, late.max_radius_m) == (1e-6, found.max_radius_m)
    assert find_landmarks(trace(Override())) == found


def test_that_the_window_ends_where_it_is_stated():
    one = trace(Override(window_end_s=30e-6))
    prepared = prepare(TraceSet((one,)), collapses=2)
    inside = (one.time_s >= prepared.landmarks["shot"].time_of_max_s) & (
        one.time_s <= 30e-6
    )
    assert len(prepared.experiments[0].times) == int(inside.sum())
    longer = prepare(TraceSet((trace(Override(window_end_s=85e-6)),)), collapses=1)
    assert len(longer.experiments[0].times) > 2 * int(inside.sum())


def test_that_a_window_without_frames_is_refused():
    with refused(
        r"1 frames between its maximum and the stated end of the window at 0\.4 us"
    ):
        prepare(TraceSet((trace(Override(window_end_s=4e-7)),)))


test_that_impossible_values_are_refused = refusals(
    (
        lambda: Override(max_radius_m=-1.0),
        r"Override\.max_radius_m is -1\.0; expected a positive length",
    ),
    (
        lambda: Override(rest_radius_sd_m=1e-6),
        r"rest_radius_sd_m is 1e-06 and rest_radius_m is not given",
    ),
    (
        lambda: Override(window_end_s=float("nan")),
        r"Override\.window_end_s is nan; expected seconds",
    ),
)


def test_that_what_is_stated_is_read_again_and_counts_before_the_laboratory(tmp_path):
    said = {
        "medium": "gel",
        "experiments": [
            {"experiment_id": "a", "Rmax_m": 2e-4, "Rinf_m": 5e-5, "Rinf_settled": True}
        ],
    }
    path = write(tmp_path, ("a", "b"), said)
    before = read_json(tmp_path / "gel.json")
    state(path, "b", {"Rinf_m": 6e-5, "Rmax_m": None}, alone=False)
    state(path, "a", {"Rinf_m": 4e-5}, alone=False)
    traces = load_traces(path)
    assert [find_landmarks(one).rest_radius_m for one in traces] == [4e-5, 6e-5]
    assert traces["a"].given.rest_radius_m == 5e-5
    state(path, "a", {}, alone=False)
    state(path, "b", {}, alone=False)
    assert read_json(tmp_path / "gel.json")["experiments"][0] == before["experiments"][0]
    assert load_traces(path)["a"].given.override is None


def test_that_the_values_at_the_top_of_a_file_with_one_curve_stay_valid(tmp_path):
    path = write(tmp_path, beside={"Rinf_m": 5.5e-5, "Rinf_sd_m": 1e-6})
    state(path, "shot", {"t_Rmax_s": 1e-6}, alone=True)
    (one,) = load_traces(path)
    assert one.given.rest_radius_m == 5.5e-5
    assert find_landmarks(one).time_of_max_s == 1e-6


def test_that_unknown_fields_and_wrong_values_are_named(tmp_path):
    path = write(tmp_path, beside={"override": {"Rmax": 1.0}})
    with refused(
        r"override of experiment 'shot' has the unknown field\(s\) Rmax; expected some"
    ):
        load_traces(path)
    (tmp_path / "gel.json").write_text('{"override": {"Rinf_m": "4e-5"}}')
    with refused(
        r"Rinf_m of the override of experiment 'shot' is '4e-5'; expected a number"
    ):
        load_traces(path)
    (tmp_path / "gel.json").unlink()
    with refused(r"Override\.rest_radius_m is -1\.0"):
        state(path, "shot", {"Rinf_m": -1.0}, alone=True)
    assert not (tmp_path / "gel.json").exists()
