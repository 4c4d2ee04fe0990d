"""Predicted numbers of shots against closed forms, and where there is none to predict."""

import math

import pytest
import torch

from imr_torch.campaign import camera_variants, forecast_shots, stopping_rule
from imr_torch.float64 import eye
from imr_torch.material import Belief, TruncatedNormal
from imr_torch.observe import Noise
from tests.design.linear_camera import (
    DESIGNS,
    TWO,
    LinearCamera,
    covariance,
    plan,
    sensitivity,
)
from tests.refusals import refused

SURE = Belief.prior(
    {"nhkv": {"G": TruncatedNormal(100.0, 1.0), "mu": TruncatedNormal(100.0, 1.0)}}
)  # the mean hardly moves, so that the relative standard deviation is known beforehand
COARSE = plan(noise=Noise(slope=0.0, drift=0.0, floor=2.0))


def forecast(text, *, belief=SURE, how=COARSE, count=12, draws=6):
    rule = stopping_rule(text)
    designs = DESIGNS[[0, 1] * (count // 2)]
    return forecast_shots(belief, designs, LinearCamera(), how, rule, draws=draws)


@pytest.mark.parametrize(("text", "column"), [("G:.5%", 0), ("mu:.5%", 1), ("mu:.4%", 1)])
def test_that_shots_of_a_linear_gaussian_problem_are_those_of_its_closed_form(text, column):
    goal = float(text.split(":")[1].rstrip("%")) / 100.0
    for count in range(1, 13):
        designs = DESIGNS[[0, 1] * 6][:count]
        slopes = sensitivity(SURE.models[0], designs)
        known = eye(2) + slopes.mT @ torch.linalg.solve(covariance(designs, COARSE), slopes)
        if torch.linalg.inv(known)[column, column].sqrt() < 100.0 * goal:
            break
    found = forecast(text)
    assert 1 < count < 12
    assert abs(found.quantile(0.5) - count) <= 1
    assert found.to_dict()["mean"] == pytest.approx(count, abs=1.0)


@pytest.mark.parametrize(
    ("text", "number", "reached"), [("G:2%,mu:2%", 0.0, 1.0), ("G:.001%", None, 0.0)]
)
def test_that_a_target_that_is_met_needs_no_shot_and_one_out_of_reach_has_no_number(
    text, number, reached
):
    numbers = dict.fromkeys(("mean", "low", "median", "high"), number)
    assert forecast(text).to_dict() == numbers | {"reached": reached}


def test_that_models_that_look_different_are_told_apart_and_alike_ones_never():
    sharp = plan(noise=Noise(slope=0.0, drift=0.0, floor=0.005))
    assert forecast("model:.9", belief=TWO, how=sharp, count=4).quantile(0.5) <= 2
    blind = plan(noise=Noise(slope=0.0, drift=0.0, floor=50.0))
    assert forecast("model:.9", belief=TWO, how=blind, count=2).to_dict()["reached"] == 0.0


def test_that_more_light_and_more_frames_need_no_more_shots():
    found = {
        what: forecast("G:.5%", how=how).quantile(0.5)
        for what, how in camera_variants(COARSE).items()
        if len(how.times) == len(COARSE.times)
    }
    assert found["twice the repeats"] < found["designs chosen"] < math.inf


@pytest.mark.parametrize(
    ("text", "belief"),
    [("alpha:5%", SURE), ("model:.99", SURE), ("designs=3", SURE), ("G:5%,gain=.1", TWO)],
)
def test_that_what_shots_cannot_be_counted_for_is_refused(text, belief):
    with refused(r"is no target that shots are counted for; name one"):
        forecast(text, belief=belief)
