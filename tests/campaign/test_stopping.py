"""Every stopping rule is silent on one side of its threshold and gives its reason on the other."""

import re

import pytest

from imr_torch.campaign import (
    AllOf,
    AnyOf,
    CampaignState,
    Designs,
    GainBelow,
    ModelProbability,
    RelativeSd,
    stopping_rule,
)
from imr_torch.float64 import linspace, ones
from imr_torch.material import Belief, TruncatedNormal
from imr_torch.observe import Experiment
from tests.refusals import refused

TIMES = linspace(0.0, 1.0, 4)


def standing(
    *,
    sd: float = 0.02,
    probability: float = 0.95,
    repeats: tuple[int, ...] = (10, 20),
    gain=None,
) -> CampaignState:
    """G known within ``sd`` relative, mu within half of it, of a model of some probability;
    experiments of some repeats.
    """
    belief = Belief.prior(
        {
            "nhkv": {
                "G": TruncatedNormal(5e3, sd * 5e3),
                "mu": TruncatedNormal(0.1, 0.5 * sd * 0.1),
            },
            "newtonian": {"mu": TruncatedNormal(0.1, 0.5)},
        },
        probabilities={"nhkv": probability, "newtonian": 1.0 - probability},
    )
    made = [Experiment(f"e{n}", (300.0, 0.2), TIMES, ones(n, 4)) for n in repeats]
    return CampaignState(belief, tuple(made), gain)


@pytest.mark.parametrize(
    ("rule", "going", "over", "reason"),
    [
        (Designs(3), standing(), standing(repeats=(1, 1, 1)), "3 designs were shot"),
        (
            RelativeSd(0.02, "mu"),
            standing(sd=0.0401),
            standing(sd=0.0399),
            r"^mu of NHKV is known within 2 %",
        ),
        (
            RelativeSd(0.02),
            standing(sd=0.0201),
            standing(sd=0.0199),
            r"every parameter of NHKV is known within 2 %",
        ),
        (
            ModelProbability(0.9),
            standing(probability=0.89),
            standing(probability=0.91),
            "NHKV has a probability above 0.9",
        ),
        (
            GainBelow(0.5),
            standing(gain=0.5),
            standing(gain=0.49),
            "gain of the next design is below 0.5 nats",
        ),
        (
            AllOf((Designs(2), RelativeSd(0.02))),
            standing(),
            standing(sd=0.01),
            "2 designs were shot and every parameter",
        ),
    ],
    ids=lambda x: type(x).__name__ if not isinstance(x, str | CampaignState) else "",
)
def test_a_rule_speaks_on_one_side_of_its_threshold(rule, going, over, reason):
    assert rule.find_reason(going) is None
    assert re.search(reason, rule.find_reason(over))


def test_a_rule_about_the_gain_is_silent_until_it_is_known():
    assert GainBelow(100.0).find_reason(standing(gain=None)) is None
    assert GainBelow(100.0).find_reason(standing(gain=1.0)) is not None


def test_rules_are_read_from_text():
    assert stopping_rule() is None
    assert stopping_rule("designs=4") == Designs(4)
    assert stopping_rule("G:5%, mu:.1,model:.99") == AllOf(
        (RelativeSd(0.05, "G"), RelativeSd(0.1, "mu"), ModelProbability(0.99))
    )
    assert stopping_rule("sd=0.01, probability=0.99", "gain=.2") == AnyOf(
        (AllOf((RelativeSd(0.01), ModelProbability(0.99))), GainBelow(0.2))
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("G:-5%", "RelativeSd.below is -0.05"),
        ("H:5%", "Unknown parameter 'H'"),
        ("model:2", "ModelProbability.above is 2.0"),
        (
            "patience=3",
            "'patience=3' is not a stopping rule; expected NAME=NUMBER with NAME of designs, sd, probability",
        ),
        (
            "probability=1",
            "ModelProbability.above is 1.0; expected a probability between 0 and 1",
        ),
        ("designs=1:2", "is not a stopping rule; expected NAME=NUMBER"),
    ],
)
def test_a_bad_rule_is_refused_by_name(text, message):
    with refused(message):
        stopping_rule(text)
