"""Policies: every one stays in the space, is a function of seed and number, and journals as the optimal one does."""

import pytest
import torch

from imr_torch.assimilate import En4DVarOptions, SearchOptions
from imr_torch.campaign import (
    Campaign,
    Designs,
    ExactLearner,
    GainBelow,
    Journal,
    Optimal,
    Random,
    RelativeSd,
    Situation,
    SpaceFilling,
)
from imr_torch.design import DesignSpace, Laplace, ListedDesigns
from imr_torch.gap import CauseLearner
from tests.campaign import test_telling as told
from tests.campaign.test_telling import PLAN, shoot
from tests.journals import cut, rewritten
from tests.linear import NHKV, LinearSimulator
from tests.refusals import refusals, refused
from tests.tables import for_each

SPACE = DesignSpace(weber=(200.0, 900.0), rest_radius=(0.15, 0.25))
QUICK = Optimal(Laplace(draws=3, rivals=3), evaluations=4, initial=3)
LEARNERS = {
    "exact": ExactLearner(32, SearchOptions(raw_samples=24)),
    "en4dvar": ExactLearner(32, En4DVarOptions(12, 2, 2)),
}
POLICIES_HERE = {
    "optimal": QUICK,
    "random": Random(),
    "space-filling": SpaceFilling(),
}


def campaign(folder, **changes) -> Campaign:
    settings = {"space": SPACE, "learner": LEARNERS["exact"]}
    return told.campaign(folder, **settings | changes)


def choose(
    policy, number: int, *, seed: int = 0, space: DesignSpace = SPACE
) -> torch.Tensor:
    return policy.choose_design(
        Situation(number, NHKV, LinearSimulator(), space, PLAN, seed)
    ).design


@for_each("policy", POLICIES_HERE)
def test_designs_are_in_the_space_and_the_same_for_the_same_number_and_seed(policy):
    designs = torch.stack([choose(policy, number) for number in (1, 2, 3)])
    SPACE.check_inside(designs)
    assert torch.equal(choose(policy, 2), designs[1])
    assert (designs[1:] - designs[:-1]).abs().min() > 0.0 or policy is QUICK


def test_random_designs_are_uniform_and_space_filling_ones_more_even():
    """Counts in 16 cells of 64 designs: their variance is that of a multinomial for random ones,
    and far less for Sobol's.
    """

    def spread(policy) -> float:
        designs = torch.stack([choose(policy, number) for number in range(1, 65)])
        unit = (designs - SPACE.bounds[0]) / (SPACE.bounds[1] - SPACE.bounds[0])
        cells = (unit * 4).long().clamp(0, 3)
        return float(
            torch.bincount(4 * cells[:, 0] + cells[:, 1], minlength=16).double().var()
        )

    assert 1.0 < spread(Random()) < 9.0  # 3.75 on average
    assert spread(SpaceFilling()) == 0.0


def test_that_where_a_list_alone_can_be_shot_designs_are_of_it():
    """And space-filling ones are those of the ends first, each once before one is repeated."""
    weber = {200.0, 400.0, 500.0, 600.0, 900.0}
    space = ListedDesigns(rows=tuple((x, 0.2, 1.0) for x in weber))
    for policy in (Random(), SpaceFilling()):
        found = [float(choose(policy, number, space=space)[0]) for number in range(1, 7)]
        assert {*found} <= weber
    assert {200.0, 900.0} <= {*found[:3]}
    assert {*found[:5]} == weber


def test_a_search_asks_in_batches_for_as_many_designs_in_all():
    found = Optimal(
        Laplace(draws=3, rivals=3), evaluations=9, initial=4, batch=3
    ).choose_design(Situation(1, NHKV, LinearSimulator(), SPACE, PLAN, 0))
    assert len(found.search.designs) == len(found.search.gains) == 9
    assert len(torch.unique(found.search.designs, dim=0)) == 9
    assert found.gain == found.search.recommendation.mean


test_a_search_that_cannot_be_is_refused = refusals(
    (lambda: Optimal(evaluations=5, initial=6), "initial 6 of 5 evaluations"),
    (lambda: Optimal(batch=0), "Optimal.batch is 0; expected at least 1"),
)


@pytest.mark.parametrize(
    ("policy", "learner", "q"),
    [
        *((policy, "exact", 1) for policy in POLICIES_HERE),
        ("optimal", "en4dvar", 1),
        ("optimal", "exact", 2),
        ("space-filling", "exact", 2),
    ],
)
def test_resuming_with_any_policy_and_learner_gives_the_uninterrupted_journal_byte_for_byte(
    tmp_path, policy, learner, q
):
    kinds = {
        "policy": POLICIES_HERE[policy],
        "learner": LEARNERS[learner],
        "stop": Designs(1 + q),
    }
    whole = campaign(tmp_path / "whole", **kinds)
    most = 9 if q == 1 else 3
    steps = whole.run(shoot, most, q=q)
    assert [step.number for step in steps] == [q, 1 + q]
    step = ["ask", "observed", "learnt"]
    names = ["start", *["ask"] * (q - 1), *step, *step, *["stop"] * (q == 1)]
    assert [event["event"] for event in whole.journal.events] == names
    for events in range(2, 1 + len(names)):
        resumed = campaign(
            cut(tmp_path / "whole", tmp_path / f"cut{events}", events), **kinds
        )
        resumed.run(shoot, most, q=q)
        assert resumed.journal.path.read_bytes() == whole.journal.path.read_bytes()


def test_a_campaign_of_another_policy_learner_or_rule_is_refused(tmp_path):
    campaign(tmp_path, policy=SpaceFilling(), stop=Designs(2)).ask()
    kinds = {"policy": SpaceFilling(), "stop": Designs(2)}
    others = {
        "policy": Random(),
        "learner": CauseLearner(),
        "stop.count": Designs(3),
        "stop": None,
    }
    for name, other in others.items():
        with refused(f"another campaign: settings[.]{name} differ"):
            campaign(tmp_path, **kinds | {name.split(".")[0]: other})


def test_a_journal_begun_before_a_setting_existed_says_which(tmp_path):
    run = campaign(tmp_path)
    run.ask()
    del run.journal.events[0]["settings"]["learner"]["noise_rounds"]
    rewritten(tmp_path, run.journal.events[:1])
    with refused(r"settings\.learner\.noise_rounds differ.*another version of imr_torch"):
        campaign(tmp_path)


def test_a_campaign_stops_before_the_experiment_that_is_not_worth_it_and_says_why(tmp_path):
    run = campaign(tmp_path / "gain", policy=QUICK, stop=GainBelow(1e3))
    assert len(run.run(shoot, 5)) == 0
    assert (
        Journal(tmp_path / "gain").find_event("stop", 0)["reason"]
        == "the expected information gain of the next design is below 1000 nats"
    )
    run = campaign(tmp_path / "sd", stop=RelativeSd(0.03))
    steps = run.run(shoot, 40)
    assert 0 < len(steps) < 40
    part = steps[-1].belief.best
    assert (part.sds / part.means).max() < 0.03
    before = steps[-2].belief.best if len(steps) > 1 else run.prior.best
    assert (before.sds / before.means).max() >= 0.03
    assert (
        campaign(tmp_path / "sd", stop=RelativeSd(0.03)).reason_to_stop()
        == run.reason_to_stop()
    )


def test_more_designs_may_be_asked_of_a_campaign_that_was_resumed(tmp_path):
    campaign(tmp_path).run(shoot, 1)
    assert [step.number for step in campaign(tmp_path).run(shoot, 3)] == [1, 2, 3]


def test_that_several_designs_are_asked_for_at_once_each_beside_those_before_it(tmp_path):
    run = campaign(tmp_path, policy=QUICK)
    proposals = run.ask_several(3)
    assert [p.step for p in proposals] == [1, 2, 3]
    assert len({tuple(p.design.tolist()) for p in proposals}) == 3
    assert [p.design.tolist() for p in campaign(tmp_path, policy=QUICK).ask_several(2)] == [
        p.design.tolist() for p in proposals[:2]
    ]
    alone = campaign(tmp_path / "alone", policy=QUICK).ask()
    assert torch.equal(alone.design, proposals[0].design)
    surroundings = run.simulator.conditions.surroundings
    kept = campaign(tmp_path, policy=QUICK).search(2)
    assert kept == proposals[1].search.to_dict(surroundings)
    with refused("q is 0; expected at least 1"):
        run.ask_several(0)


def test_that_a_design_that_adds_too_little_to_those_before_it_is_not_shot(tmp_path):
    asked = campaign(tmp_path / "gains", policy=QUICK).ask_several(2)
    between = 0.5 * (asked[0].gain + asked[1].gain)
    assert asked[1].gain < between < asked[0].gain
    run = campaign(tmp_path / "run", policy=QUICK, stop=GainBelow(between))
    run.run(shoot, 2, q=2)
    assert len(run.experiments) == 1
