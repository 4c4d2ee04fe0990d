"""Campaigns that look for the cause of a gap: what they shoot, when they end, and that they resume
as if nothing had happened.
"""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from imr_torch.campaign import Campaign, CampaignSettings, CauseProbability
from imr_torch.cli import main
from imr_torch.design import Plan
from imr_torch.float64 import linspace, tensor
from imr_torch.gap import CauseLearner, TellCausesApart, active
from imr_torch.material import PARAMETERS, wide_prior
from imr_torch.observe import SimulatedLaboratory
from tests.gap.synthetic import GEL, SIMULATOR
from tests.refusals import refusals, refused

OFFERED = ("sound_speed", "damage", "strain_stiffening")
PRIOR = wide_prior(("nhkv",))
PLAN = Plan(times=linspace(0.0, 2.5, 51), repeats=3, collapses=None)


def settings(above: float = 0.8) -> CampaignSettings:
    learner = CauseLearner(OFFERED)
    policy = TellCausesApart(learner, designs=4, draws=4)
    return CampaignSettings(
        plan=PLAN, policy=policy, learner=learner, stop=CauseProbability(above)
    )


def campaign(folder: Path, above: float = 0.8) -> Campaign:
    active._MADE.clear()  # as in a process of its own
    return Campaign(folder, PRIOR, SIMULATOR, settings=settings(above), seed=1)


def shoot(effect: dict[str, float]):
    laboratory = SimulatedLaboratory(
        SIMULATOR, PARAMETERS.pack(GEL | effect), times=PLAN.times, repeats=PLAN.repeats
    )
    return lambda design, number: laboratory.shoot(design, seed=number)


@pytest.fixture(scope="module")
def hidden(tmp_path_factory):
    """A campaign on a gel whose sound speed is lower than assumed, ended by its rule."""
    folder = tmp_path_factory.mktemp("hidden")
    campaign(folder).run(shoot({"sound_speed": 0.8}), 4)
    return folder


def test_that_the_hidden_effect_is_named_and_ends_the_campaign(hidden):
    found = campaign(hidden)
    last = found.steps[-1].finding
    assert last.verdict == "effect"
    assert last.causes == ("sound_speed",)
    assert last.leader is not None
    assert found.reason_to_stop() == "the cause sound_speed has a probability above 0.8"
    assert len(found.experiments) < 4


def test_that_parameters_are_inferred_beside_the_cause(hidden):
    posterior = campaign(hidden).belief.best
    assert posterior.names == ("G", "mu")
    errors = (posterior.means - tensor([GEL["G"], GEL["mu"]])) / posterior.sds
    assert errors.abs().max() < 3.0


def test_that_a_campaign_without_a_gap_names_no_cause(tmp_path):
    found = campaign(tmp_path)
    found.run(shoot({}), 2)
    last = found.steps[-1].finding
    assert (last.verdict, last.causes) == ("none", ())
    assert found.reason_to_stop() is None or "nothing is missing" in str(
        found.reason_to_stop()
    )
    assert "no cause has to be told" in found.ask().reason


def test_that_a_resumed_campaign_asks_for_the_same_design(tmp_path):
    """The journal keeps verdicts; the design that follows from the fits is found again in a new
    process.
    """
    whole = campaign(tmp_path / "whole", 0.99)
    cut = campaign(tmp_path / "cut", 0.99)
    shots = shoot({"damage": 0.02})
    for own in (whole, cut):
        own.tell(shots(own.ask().design, 1))
    asked = whole.ask()
    again = campaign(tmp_path / "cut", 0.99).ask()
    assert torch.equal(asked.design, again.design)
    assert (asked.gain, asked.reason) == (again.gain, again.reason)
    assert "Tells apart" in asked.reason or "far from earlier shots" in asked.reason
    assert campaign(tmp_path / "cut", 0.99).ask().reason == asked.reason  # from the journal
    assert campaign(tmp_path / "cut", 0.99).steps[-1].finding == whole.steps[-1].finding


def test_that_a_design_is_chosen_for_the_causes_that_are_left(tmp_path):
    own = campaign(tmp_path, 0.99)
    own.tell(shoot({"sound_speed": 0.3})(tensor([400.0, 0.2]), 1))
    finding = own.steps[-1].finding
    assert finding.probabilities
    proposal = own.ask()
    assert proposal.gain > 0.0
    assert finding.leader in proposal.reason


def test_that_several_models_or_designs_at_once_are_refused(tmp_path):
    own = campaign(tmp_path)
    with refused("one design at a time"):
        own.ask_several(2)
    both = Campaign(
        tmp_path / "two",
        wide_prior(("nhkv", "gen_qkv")),
        SIMULATOR,
        settings=settings(),
        seed=1,
    )
    with refused("holds 2"):
        both.tell(shoot({})(tensor([400.0, 0.2]), 1))


test_that_settings_are_checked = refusals(
    (lambda: CauseLearner(most=0), "most is 0"),
    (lambda: replace(TellCausesApart(CauseLearner()), designs=1), "1 designs"),
    (lambda: CauseLearner(("nonsense",)), "nonsense"),
)


def test_that_the_command_looks_for_a_hidden_cause(tmp_path):
    goal = (
        f"--goal cause --case stiff-pa --hide sound_speed=0.8 --effects {','.join(OFFERED)}"
    )
    shots = f"--designs 1 --repeats 3 --physics polytropic --out {tmp_path}/hunt"
    main(["campaign", *goal.split(), *shots.split()])
    document = json.loads((tmp_path / "hunt" / "campaign.json").read_text())
    assert document["findings"][0]["verdict"] in ("effect", "class", "other", "undecided")
    assert set(document["findings"][0]["probabilities"]) <= {*OFFERED, "none", "other"}
    assert (tmp_path / "hunt" / "causes.png").exists()
