"""The record before any gel: pressures and what they look like, on bubbles whose answer is known."""

import re
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from benchmarks.gap.single_curves import characterize_traces
from benchmarks.spoilt_records import (
    BAD,
    FITS,
    SHOTS,
    film_bubble,
    judge_shots,
    simulate_shots,
)
from imr_torch.files import read_json
from imr_torch.observe import Given, RadiusTrace, TraceSet, load_traces, prepare
from imr_torch.record import ALL_ALIKE, RecordOptions, describe_record
from imr_torch.record.figures import record_figure
from imr_torch.units import Surroundings
from tests.record.bubbles import LIQUID, paths, wall_pressure
from tests.refusals import refused


def one_bad():
    """Eight shots, one of them with a wrong scale."""
    return simulate_shots("scale", 0.05, 1)[0]


GELS = [(2e-4, 4e-5, 8e3, 0.1), (3e-4, 4.5e-5, 2e3, 0.2), (1e-4, 3e-5, 2e4, 0.1)]


def film(bubble, seed, **errors):
    """Growth, and the collapse to just beyond its end."""
    rng = np.random.default_rng(seed)
    return film_bubble(
        "a", bubble, rng, **{"noise": 0.003, "spacing": 0.028, "last": 1.0} | errors
    )


def first_cycle(trace):
    return describe_record([trace]).shots[0].cycles[0]


def true_pressures(levels, top, rest, modulus, viscosity):
    """Wall pressure at levels in growth and in collapse, over p_inf."""
    found = []
    for path in paths(top, rest, modulus, viscosity):
        radius, speed = path.sol(np.linspace(0, path.t[-1], 4000))
        at = np.interp(-levels * top, -radius, speed)
        pressure, _ = wall_pressure(levels * top, at, rest, modulus, viscosity)
        found.append(pressure / LIQUID.far_field_pressure)
    return found


@pytest.mark.parametrize("gel", GELS)
def test_split_and_modulus_are_those_of_another_code(gel):
    modulus, viscosity = gel[2:]
    cycles = [first_cycle(film(gel, i)) for i in range(12)]
    growth, collapse = true_pressures(cycles[0].levels, *gel)
    split = np.nanmedian([c.collapse - c.growth for c in cycles], 0)
    common = np.nanmedian([0.5 * (c.collapse + c.growth) for c in cycles], 0)
    inside = cycles[0].levels < 0.9
    error = (
        np.abs(split - collapse + growth)[inside].mean()
        / (collapse - growth)[inside].mean()
    )
    assert error < 0.1
    assert np.abs(common - 0.5 * (growth + collapse))[inside].mean() < 0.06
    assert np.median([c.modulus for c in cycles]) == pytest.approx(modulus, rel=0.1)
    assert np.median([c.viscosity for c in cycles]) == pytest.approx(viscosity, rel=0.1)


def test_intervals_of_viscosity_and_modulus_cover_the_truth():
    modulus, viscosity = GELS[0][2:]
    cycles = [first_cycle(film(GELS[0], i)) for i in range(40)]
    for name, truth in (("viscosity", viscosity), ("modulus", modulus)):
        scores = [(getattr(c, name) - truth) / getattr(c, f"{name}_sd") for c in cycles]
        assert np.mean(np.abs(scores) < 1.64) > 0.75


def test_a_lossless_bubble_has_neither_split_nor_skewness():
    cycle = first_cycle(film((2e-4, 4e-5, 0.0, 0.0), 0, noise=1e-4))
    assert abs(cycle.skewness) < 0.004  # what waves leave
    assert cycle.chord == pytest.approx(1.0, abs=0.01)
    assert np.nanmax(np.abs(cycle.collapse - cycle.growth)) < 0.1
    assert abs(cycle.viscosity) < 0.004


def test_clock_and_scale_errors_look_like_a_changed_modulus_and_not_like_dissipation():
    clean = film(GELS[0], 1)
    right = first_cycle(clean)
    scale = first_cycle(replace(clean, radius_m=1.05 * clean.radius_m))
    clock = first_cycle(replace(clean, time_s=1.05 * clean.time_s))
    trigger = first_cycle(replace(clean, time_s=clean.time_s + 3e-6))
    assert scale.chord == pytest.approx(right.chord / 1.05, rel=0.01)
    assert clock.chord == pytest.approx(right.chord * 1.05, rel=0.01)
    assert scale.modulus > right.modulus + 2e3
    assert clock.modulus < right.modulus - 2e3
    for other in (scale, clock, trigger):
        assert other.skewness == pytest.approx(right.skewness, rel=0.1)
    assert trigger.modulus == pytest.approx(right.modulus, rel=1e-3)


def test_a_wall_lengthens_the_chord():
    near = first_cycle(film((2e-4, 4e-5, 0.0, 0.1), 2, wall=0.1))
    far = first_cycle(film((2e-4, 4e-5, 0.0, 0.1), 2))
    assert near.chord > far.chord + 0.02
    assert near.modulus < 0.0


@pytest.mark.parametrize("kind", SHOTS)
def test_one_bad_shot_of_eight_is_found_and_no_good_one(kind):
    odd = np.array(
        [judge_shots(kind, 1.5 * SHOTS[kind], seed, fit=False)["odd"] for seed in range(3)]
    )
    found = odd[:, BAD].sum()
    # one that is only noisier may be taken for bad by chance
    assert found in {"good": (0,), "noisier": (0, 1)}.get(kind, (3,))
    assert odd.sum() == found


def test_two_shots_cannot_outvote_each_other():
    told = describe_record(one_bad().traces[BAD - 1 : BAD + 1])
    assert [shot.odd for shot in told.shots] == [None, None]
    assert "Two shots cannot outvote each other" in told.sentences()[-1]
    shots = [
        replace(
            shot, cycles=tuple(replace(x, modulus=-1e3, viscosity=0.1) for x in shot.cycles)
        )
        for shot in told.shots
    ]
    text = "\n".join(replace(told, shots=tuple(shots)).sentences())
    assert re.search(
        r"looks like a viscosity of 0\.10 \+- .* Pa s and no possible modulus \(", text
    )
    assert "These values are orders of magnitude and no measurement" in text


def test_a_shot_that_stands_out_is_named_with_what_is_odd():
    assert (
        describe_record(one_bad()).sentences()[-1].startswith("shot 3 stands out in chord")
    )


def test_a_shot_that_stands_out_counts_little_in_fits_unless_asked_to():
    traces = one_bad()
    shots = prepare(traces).experiments
    weights = [e.weight for e in describe_record(traces).weighted(shots)]
    assert weights[3] == 0.001
    assert weights[:3] + weights[4:] == [1.0] * 7
    alike = describe_record(traces, options=ALL_ALIKE)
    assert alike.shots[3].stands_out
    assert [e.weight for e in alike.weighted(shots)] == [1.0] * 8


def test_a_bad_shot_moves_the_gel_less(few_deviations):
    fits = {
        weigh: [
            characterize_traces(
                *simulate_shots("wall", 0.15, seed), 0, simulator=FITS, weigh=weigh
            )
            for seed in range(2)
        ]
        for weigh in (True, False)
    }
    moved = {
        weigh: np.mean([abs(x["error"]["G"]) for x in own]) for weigh, own in fits.items()
    }
    assert moved[True] < 0.5 * moved[False]
    assert moved[True] < 0.05


def test_a_short_exposure_leaves_the_gel_within_its_intervals(few_deviations):
    found = judge_shots("exposure", 0.0, 53001, fit=True)
    assert found["held"] == {"G": True, "mu": True}
    assert found["p_fit"] > 0.01


def test_without_growth_no_split_is_shown():
    trace = film(GELS[0], 0)
    after = trace.time_s >= 0
    told = describe_record(
        [replace(trace, time_s=trace.time_s[after], radius_m=trace.radius_m[after])]
    )
    cycle = told.shots[0].cycles[0]
    assert np.isnan(cycle.growth).all()
    assert np.isfinite(cycle.collapse).any()
    assert np.isnan(cycle.skewness)
    assert any("Growth is not recorded" in sentence for sentence in told.sentences())


def test_the_document_draws_the_figure():
    traces = one_bad().traces
    after = traces[0].time_s >= 0
    cut = replace(
        traces[0], time_s=traces[0].time_s[after], radius_m=traces[0].radius_m[after]
    )
    for told in (describe_record(traces[:3]), describe_record([cut])):
        figure = record_figure(told.to_dict())
        assert len(figure.axes) == 5
        plt.close(figure)


@pytest.mark.parametrize("wrong", [{"lowest": 0.6}, {"lowest": 0.0}])
def test_options_that_leave_nothing_to_fit_are_refused(wrong):
    with refused("RecordOptions"):
        RecordOptions(**wrong)


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("water_laser", 0.010, 0.020),
        ("peg8k_20pct_liquid", 0.02, 0.10),
        ("pegda_s1", 0.06, 0.13),
    ],
)
def test_skewness_of_measured_sets(name, low, high, shared):
    path = shared / "data" / f"{name}.csv"
    told = describe_record(load_traces(path), Surroundings(density=998.0))
    assert low <= np.nanmedian(told.first("skewness")) <= high


def test_the_second_cycle_of_the_full_physics_of_another_code(shared):
    """Its gas is hot after the first collapse, which looks like less modulus and more viscosity."""
    cases = read_json(shared / "reference" / "authors_code_public.json")["cases"]
    curves = np.load(shared / "reference" / "oracle_curves_public.npz")
    (case,) = (case for case in cases if case["id"] == "P06")
    radius = curves["estrada2018_R_1601"][[case["id"] for case in cases].index("P06")][::8]
    times = curves["t_1601"][::8] * case["t0_s"]
    noise = 0.003 * np.random.default_rng(0).standard_normal(len(radius))
    top, rest = case["Rmax_m"], case["Rinf_star"] * case["Rmax_m"]
    given = Given(
        max_radius_m=top, time_of_max_s=0.0, rest_radius_m=rest, rest_settled=True
    )
    seen = torch.tensor(top * np.maximum(radius + noise, 0.01))
    told = describe_record(
        [RadiusTrace("P06", torch.tensor(times), seen, "reference", given)]
    )
    (second,) = (cycle for cycle in told.shots[0].cycles if cycle.number == 2)
    assert second.modulus == pytest.approx(case["G_Pa"], rel=0.15)
    assert abs(second.viscosity - case["mu_Pa_s"]) < 3.0 * second.viscosity_sd


def test_an_empty_set_says_so():
    assert "No shot" in describe_record(TraceSet(())).sentences()[0]
