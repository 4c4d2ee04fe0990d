"""Curves that no bubble has are refused, unusual ones are named, and real ones pass."""

import json
from collections.abc import Callable

import numpy as np
import pytest
import torch

from imr_torch import example_gel
from imr_torch.errors import ImrError
from imr_torch.float64 import linspace
from imr_torch.gap import load_set
from imr_torch.observe import (
    Experiment,
    Given,
    RadiusTrace,
    TraceSet,
    check_experiment,
    load_traces,
    prepare,
)
from imr_torch.random import generator
from imr_torch.units import Surroundings
from tests.filmed import film
from tests.refusals import refused

SIZE = 300e-6
REST = (0.2, 0.01)
OUTER = Surroundings()
SCALE = OUTER.time_scale(SIZE)
EXAMPLE = example_gel()


def curve(**gel: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Times in s and radii in m of a bubble in a soft gel."""
    times = linspace(0.0, 3.0, 151)
    values = {"G": 5e3, "mu": 0.1} | gel
    trace = film(values, SIZE, REST[0], times, generator(0), noise=0.0)
    return trace.time_s, trace.radius_m


def prepared(
    change: Callable, given: Given | None = None, rest: tuple[float, float] = REST
):
    """What becomes of the curve, changed."""
    return prepare(
        TraceSet((RadiusTrace("shot", *change(*curve()), "gel.csv", given or Given()),)),
        rest_radius=rest,
    )


def spiked(t, r):
    r = r.clone()
    r[100] = 2.5 * SIZE
    return t, r


REFUSED = {
    "a hundredth of the size": (
        lambda t, r: (t, 0.01 * r),
        None,
        REST,
        r"the first collapse is at t\* = 91.7",
    ),
    "centimetres as metres": (
        lambda t, r: (t, 100.0 * r),
        None,
        REST,
        r"the first collapse is at t\* = 0.00917",
    ),
    "microseconds as tenths": (
        lambda t, r: (0.1 * t, r),
        None,
        REST,
        r"the first collapse is at t\* = 0.09",
    ),
    "stated in micrometres": (
        lambda t, r: (t, r),
        Given(max_radius_m=300.0),
        REST,
        r"stated maximum radius is 3e\+08 um",
    ),
    "one frame far above the others": (
        spiked,
        None,
        REST,
        r"frame 100 \(counted from 0.*largest radius, 750 um.*set the frame to NaN",
    ),
    "a rest radius of nearly nothing": (
        lambda t, r: (t, r),
        None,
        (0.0002, 0.0001),
        r"R_inf/Rmax is 0.0002; possible is 0.02 to",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_that_a_curve_in_other_units_than_was_said_is_refused(kind):
    change, given, rest, message = REFUSED[kind]
    with refused(message):
        prepared(change, given, rest)


def test_that_a_good_curve_passes_without_a_word_and_its_report_says_what_was_found():
    good = prepared(lambda t, r: (t, r))
    assert good.cautions == ()
    assert 0.8 < good.first_collapses["shot"] < 1.0
    text = good.report()
    for part in (
        "Rmax 299.9 um (one-sided fit)",
        "R_inf/Rmax 0.200 (assumed)",
        "first collapse at t* =",
        "of 151 frames are fitted",
    ):
        assert part in text
    total, before, after = good.frames["shot"]
    assert (total, before) == (151, 1)  # the fit puts the maximum between the first frames
    assert len(good.experiments[0].times) == total - before - after


def test_that_diameters_are_named_since_a_stiff_gel_looks_alike():
    (caution,) = prepared(lambda t, r: (t, 2.0 * r)).cautions
    assert "the first collapse is at t* = 0.4" in caution
    assert (
        "that of an empty cavity in water at 0.915, in a gel of 70 kPa at 0.55" in caution
    )


@pytest.mark.parametrize(("modulus", "cautions"), [(5e4, 0), (1e5, 1)])
def test_that_gels_within_the_default_prior_are_usual(modulus, cautions):
    stiff = TraceSet((RadiusTrace("stiff", *curve(G=modulus), "gel.csv"),))
    assert len(prepare(stiff, rest_radius=REST).cautions) == cautions


def test_that_an_early_collapse_is_unusual_where_the_record_begins_after_its_maximum():
    times = linspace(0.0, 2.0, 41)
    early = Experiment(
        "shot", (400.0, 0.22), times, (0.6 + 0.4 * torch.cos(5.0 * times))[None]
    )
    assert not check_experiment(early, "gel.csv")
    (caution,) = check_experiment(early, "gel.csv", cut=True, remedy="and where it begins")
    assert "t* = 0.6" in caution
    assert caution.endswith(
        "usual is 0.7 to 1.4. Check the units of radius and time, and where it begins."
    )


def test_that_time_zero_is_the_maximum_and_rmax_its_radius():
    times, radius = curve()
    late = times / SCALE + 0.9
    # the fall to the maximum from the other side
    shifted = torch.cat((radius.flip(0)[-46:-1], radius)) / SIZE
    ramp = torch.cat((late[:45] - 0.9, late))
    with refused(r"the largest frame is at t\* = 0\.90; expected time zero at the maximum"):
        check_experiment(Experiment("shot", (300.0, 0.2), ramp, shifted[None]), "set")
    with refused(r"the largest frame has R/Rmax = 0\.1; possible is 0\.7 to 1\.1"):
        check_experiment(
            Experiment("shot", (300.0, 0.2), times / SCALE, 0.1 * radius[None] / SIZE),
            "set",
        )


@pytest.mark.parametrize(
    ("radius", "time", "message"),
    [(0.1, 1.0, "largest frame"), (1.0, 10.0, "first collapse")],
)
def test_that_a_set_in_other_units_is_refused(radius, time, message, tmp_path):
    t, r = (x.numpy() for x in curve())
    design = {"we": np.array([OUTER.weber(SIZE)]), "rinf_star": np.array([REST[0]])}
    np.savez(tmp_path / "good.npz", time_s=t[None], radius_m=r[None, None], **design)
    assert len(load_set(tmp_path / "good.npz")) == 1
    np.savez(
        tmp_path / "bad.npz",
        time_s=time * t[None],
        radius_m=radius * r[None, None],
        **design,
    )
    with refused(message):
        load_set(tmp_path / "bad.npz")


def test_that_measured_curves_pass(shared):
    counts = {}
    for file in [EXAMPLE, *sorted((shared / "data").glob("*.csv"))]:
        if file.stem.startswith("pimr"):
            continue  # collapse times, no curves
        for trace in load_traces(file):
            try:
                found = prepare(TraceSet((trace,)))
            except ImrError as error:
                assert "no rebound and no given R_inf" in str(error), error  # noqa: PT017
                try:
                    found = prepare(TraceSet((trace,)), rest_radius=(0.2, 0.08))
                except ImrError as short:
                    assert "at least 5 are needed" in str(short), short  # noqa: PT017
                    continue
            cautions = [text for text in found.cautions if "stated R_inf" not in text]
            counts[file.stem] = counts.get(file.stem, 0) + len(cautions)
    assert len(counts) >= 20
    # stiff gels
    assert {name for name, count in counts.items() if count > 1} <= {
        "agarose_5pct",
        "pegda_s4",
        "pegda_s5",
    }


def test_that_what_the_laboratory_says_of_a_tail_is_true_or_false(tmp_path):
    rows = "".join(
        f"a,{t},{r}\n" for t, r in zip(*(x.tolist() for x in curve()), strict=True)
    )
    (tmp_path / "gel.csv").write_text("experiment_id,time_s,radius_m\n" + rows)
    entry = {"experiment_id": "a", "Rinf_m": 60e-6, "Rinf_settled": "false"}
    (tmp_path / "gel.json").write_text(json.dumps({"experiments": [entry]}))
    with refused("Rinf_settled is 'false'; expected true or false"):
        load_traces(tmp_path / "gel.csv")
