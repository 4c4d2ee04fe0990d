"""Every stopping rule is silent on one side of its threshold and gives its reason on the other."""

import re

import pytest
import torch

from imr_torch.campaign import (
    AllOf,
    AnyOf,
    Budget,
    CampaignState,
    Designs,
    GainBelow,
    ModelProbability,
    RelativeSd,
    stopping_rule,
)
from imr_torch.errors import InputDataError
from imr_torch.material import Belief, TruncatedNormal
from imr_torch.observe import Experiment

TIMES = torch.linspace(0.0, 1.0, 4, dtype=torch.float64)


def standing(
    *, sd: float = 0.02, probability: float = 0.95, repeats: tuple[int, ...] = (10, 20), gain=None
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
    made = [
        Experiment(f"e{n}", (300.0, 0.2), TIMES, torch.ones(n, 4, dtype=torch.float64))
        for n in repeats
    ]
    return CampaignState(belief, tuple(made), gain)


@pytest.mark.parametrize(
    ("rule", "going", "over", "reason"),
    [
        (Designs(3), standing(), standing(repeats=(1, 1, 1)), "3 designs were shot"),
        (
            RelativeSd(0.02, "mu"),
            standing(sd=0.0401),
            standing(sd=0.0399),
            r"^mu of nhkv is known within 2 %",
        ),
        (
            RelativeSd(0.02),
            standing(sd=0.0201),
            standing(sd=0.0199),
            r"every parameter of nhkv is known within 2 %",
        ),
        (
            RelativeSd(0.02),
            standing(sd=0.01, probability=0.4),
            standing(sd=0.01),
            "parameter of nhkv",
        ),
        (
            ModelProbability(0.9),
            standing(probability=0.89),
            standing(probability=0.91),
            "nhkv has a probability above 0.9",
        ),
        (
            ModelProbability(0.6),
            standing(probability=0.41),
            standing(probability=0.39),
            "newtonian has a probability",
        ),
        (
            GainBelow(0.5),
            standing(gain=0.5),
            standing(gain=0.49),
            "gain of the next design is below 0.5 nats",
        ),
        (Budget(3.0), standing(), standing(repeats=(1, 1, 1)), "3 of the budget of 3 are spent"),
        (
            Budget(80.0, 5.0, 1.0),
            standing(repeats=(10, 20)),
            standing(repeats=(10, 21, 1, 30)),
            "82 of the budget of 80",
        ),
        (
            Budget(64.9, 5.0, 1.0),
            standing(repeats=(10,)),
            standing(repeats=(10, 20)),
            "40 of the budget of 64.9",
        ),
        (AnyOf((Designs(9), RelativeSd(0.02))), standing(), standing(sd=0.01), "every parameter"),
        (
            AllOf((Designs(2), RelativeSd(0.02))),
            standing(),
            standing(sd=0.01),
            "2 designs were shot and every parameter",
        ),
        (
            AllOf((Designs(3), RelativeSd(0.02))),
            standing(sd=0.01),
            standing(sd=0.01, repeats=(1, 1, 1)),
            "3 designs",
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
    assert stopping_rule("sd=0.01, probability=0.99", "gain=.2", "budget=10:2:.5") == AnyOf(
        (AllOf((RelativeSd(0.01), ModelProbability(0.99))), GainBelow(0.2), Budget(10.0, 2.0, 0.5))
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("G:-5%", "RelativeSd.below is -0.05"),
        ("H:5%", "Unknown parameter 'H'"),
        ("G:five", "PARAMETER:PERCENT as G:5%, or model:.99"),
        ("model:2", "ModelProbability.above is 2.0"),
        (
            "patience=3",
            "'patience=3' is not a stopping rule; expected NAME=NUMBER with NAME of designs, sd, probability",
        ),
        ("designs=2.5", "'designs=2.5' is not a stopping rule"),
        ("sd", "'sd' is not a stopping rule"),
        ("sd=1:2", "'sd=1:2' is not a stopping rule"),
        ("budget=1:2:3:4", "is not a stopping rule"),
        ("designs=0", "Designs.count is 0"),
        ("sd=-1", "RelativeSd.below is -1.0"),
        ("probability=1", "ModelProbability.above is 1.0; expected a probability between 0 and 1"),
        ("gain=inf", "GainBelow.nats is inf"),
        ("budget=5:0:0", "a cost of something"),
    ],
)
def test_a_bad_rule_is_refused_by_name(text, message):
    with pytest.raises(InputDataError, match=message):
        stopping_rule(text)


def test_all_of_nothing_is_refused():
    with pytest.raises(InputDataError, match=r"AllOf.rules is empty; it would stop at once"):
        AllOf(())


def test_that_a_forgotten_experiment_is_spent_and_is_no_datum():
    now = standing(repeats=(1, 1, 1))
    one_lost = CampaignState(now.belief, now.experiments[:2], None, now.experiments[2:])
    assert (
        Budget(3.5).find_reason(one_lost)
        == "3 of the budget of 3.5 are spent, 1 of these on experiments that were forgotten"
    )
    assert Budget(4.0).find_reason(one_lost) is None
    assert Designs(3).find_reason(one_lost) is None
    assert Designs(2).find_reason(one_lost) == "2 designs were shot, besides 1 that were forgotten"
    all_lost = CampaignState(now.belief, (), None, now.experiments)
    assert Budget(3.5).find_reason(all_lost) is not None
    assert Designs(1).find_reason(all_lost) is None
