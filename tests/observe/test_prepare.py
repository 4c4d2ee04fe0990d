"""What is fitted of a record, by curves whose collapses are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imr_torch.observe import Given, RadiusTrace, TraceSet, prepare
from tests.refusals import refused

TOP = 2e-4
REST = 1.0e-4
PERIOD = 4e-5


def damped(name: str, damping: float, given: Given = Given()) -> RadiusTrace:  # noqa: B008
    """Collapses at .5, 1.5, ...

    periods; after each half a period the swing is down by a factor ``exp(-damping/2)``.
    """
    time = np.linspace(0.0, 5.0 * PERIOD, 251)
    swing = (TOP - REST) * np.exp(-damping * time / PERIOD)
    noise = 2e-4 * TOP * np.random.default_rng(0).standard_normal(len(time))
    radius = REST + swing * np.cos(2.0 * np.pi * time / PERIOD) + noise
    return RadiusTrace(name, torch.tensor(time), torch.tensor(radius), "memory", given)


def test_that_the_window_ends_at_a_second_collapse_that_is_small_and_plain():
    """The second minimum is followed by a rise of .02 of Rmax, a thirtieth of the range of the curve."""
    prepared = prepare(TraceSet((damped("small", 2.0), damped("large", 0.4))))
    ends = [float(e.times[-1] / e.times[1]) * 8e-7 / PERIOD for e in prepared.experiments]
    assert all(1.4 < end < 1.56 for end in ends)


def test_that_a_curve_with_most_of_the_frames_is_named():
    short = [damped(f"short {k}", 0.4) for k in range(2)]
    open_window = damped("open", 8.0)  # no second collapse is seen
    assert any(
        "experiment 'open' has" in text
        for text in prepare(TraceSet((*short, open_window))).cautions
    )
    assert not any(
        "decides the result" in text
        for text in prepare(TraceSet((*short, damped("third", 0.4)))).cautions
    )


@pytest.mark.parametrize("largest", [1.0, 1.1])
def test_that_stated_radii_that_are_passed_over_are_said(largest):
    given = Given(largest * TOP, rest_radius_m=1.8 * REST, rest_settled=False)
    ringing = damped("ringing", 0.1, given)
    before = torch.arange(-10, 0).double() * 8e-7
    mirrored = replace(
        ringing,
        time_s=torch.cat((before, ringing.time_s)),
        radius_m=torch.cat((ringing.radius_m[1:11].flip(0), ringing.radius_m)),
    )
    said = [c for c in prepare(TraceSet((mirrored,))).cautions if "is not used" in c]
    top = "The stated Rmax of 'ringing' is not used, since the record shows it. To use it, state it"
    assert any(top in text for text in said) == (largest != 1.0)
    rest = (
        "R_inf of 'ringing' is not used, since it is stated that the bubble had not settled"
    )
    assert rest in said[-1]


def test_that_a_record_without_rest_radius_takes_that_of_the_other_curves_widely():
    short = damped("short", 0.4)
    # ends as it collapses
    cut = RadiusTrace("short", short.time_s[:26], short.radius_m[:26], "memory")
    prepared = prepare(TraceSet((damped("long", 0.4), cut)))
    marks = prepared.landmarks["short"]
    assert marks.rest_method == "other curves"
    assert marks.rest_radius_m == pytest.approx(0.5 * TOP, rel=0.1)
    assert marks.rest_radius_sd_m >= 0.39 * marks.rest_radius_m
    assert any(
        "'short' holds no rebound and no R_inf is stated" in text
        for text in prepared.cautions
    )
    with refused("no rebound and no given R_inf"):
        prepare(TraceSet((cut,)))


def test_that_a_late_minimum_of_an_overdamped_bubble_is_no_collapse_and_that_of_wrong_units_is_refused():
    """A bubble that creeps to rest, with one deep frame long after; and a plain one whose times are
    ten times too long.
    """
    time = np.linspace(0.0, 1.2e-4, 121)
    radius = REST + (TOP - REST) * np.exp(-time / 8e-6)
    radius[100] -= 0.4 * REST
    late = RadiusTrace(
        "late",
        torch.tensor(time),
        torch.tensor(radius),
        "memory",
        Given(rest_radius_m=REST),
    )
    prepared = prepare(TraceSet((late,)))
    assert prepared.first_collapses["late"] == np.inf
    slow = damped("slow", 0.4, Given(rest_radius_m=REST))
    with refused("first collapse is at"):
        prepare(
            TraceSet(
                (
                    RadiusTrace(
                        "slow", 10.0 * slow.time_s, slow.radius_m, "memory", slow.given
                    ),
                )
            )
        )
