"""A campaign learns from bubbles, remembers, and refuses what is not its own.

That resuming ends in the same journal: test_policies.py and test_interruptions.py.
"""

import shutil
from dataclasses import replace

import pytest

from imr_torch.assimilate import SearchOptions
from imr_torch.campaign import (
    Campaign,
    CampaignSettings,
    ExactLearner,
    Journal,
    Optimal,
    Random,
)
from imr_torch.design import Laplace, Plan
from imr_torch.float64 import linspace, tensor
from imr_torch.material import PARAMETERS, reference_case
from imr_torch.observe import Noise, SimulatedLaboratory
from imr_torch.random import child
from imr_torch.simulate import PolytropicSimulator, Stepping
from tests.refusals import refused

CASE = reference_case("soft-pa")
SIMULATOR = PolytropicSimulator(stepping=Stepping(0.25))
TIMES = linspace(0.0, 2.2, 23)
SETTINGS = CampaignSettings(
    plan=Plan(times=TIMES, repeats=20),
    policy=Optimal(Laplace(draws=3, rivals=3), evaluations=5, initial=4),
    learner=ExactLearner(32, SearchOptions(raw_samples=24, starts=2)),
)
LEARNING = replace(
    SETTINGS, policy=Random(), learner=replace(SETTINGS.learner, noise_rounds=2)
)
LABORATORY = SimulatedLaboratory(
    SIMULATOR, PARAMETERS.pack(CASE.truth), repeats=20, times=TIMES
)


def shoot(design, number):
    return LABORATORY.shoot(design, seed=child(0, "shoot", number))


def campaign(folder, **changes):
    arguments = {"settings": SETTINGS, "seed": 0, "note": {"case": "test"}} | changes
    return Campaign(folder, arguments.pop("prior", CASE.prior), SIMULATOR, **arguments)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign") / "whole"
    run = campaign(folder)
    run.run(shoot, 2)
    return run


def test_the_belief_closes_in_on_the_truth(finished):
    assert [step.number for step in finished.steps] == [1, 2]
    part = finished.belief["nhkv"]
    assert finished.belief.probabilities["nhkv"] > 0.99
    for name, mean, sd in zip(
        part.names, part.means.tolist(), part.sds.tolist(), strict=True
    ):
        assert abs(mean - CASE.truth[name]) < 4.0 * sd
        assert sd < 0.05 * CASE.truth[name]


def test_the_journal_holds_what_was_asked_measured_and_concluded(finished):
    kinds = [event["event"] for event in Journal(finished.journal.folder).events]
    assert kinds == ["start", "ask", "observed", "learnt", "ask", "observed", "learnt"]
    asked = finished.journal.find_event("ask", 1)
    assert len(asked["search"]["evaluations"]) == SETTINGS.policy.evaluations
    assert asked["design"] == pytest.approx(list(finished.experiments[0].design))
    assert {"nhkv", "gen_qkv"} == set(
        finished.journal.find_event("learnt", 2)["certificates"]
    )


def test_a_journal_of_another_campaign_is_refused_and_says_what_differs(finished):
    with refused("journal of another campaign: seed differ"):
        campaign(finished.journal.folder, seed=1)
    with refused(r"prior[^ ]*, note\.case differ"):
        campaign(finished.journal.folder, prior=reference_case("stiff-pa").prior, note={})


def test_a_changed_or_missing_curve_file_is_refused(finished, tmp_path):
    shutil.copytree(finished.journal.folder, tmp_path / "bad")
    curves = tmp_path / "bad" / "experiment_001.npz"
    curves.write_bytes(curves.read_bytes()[:-1] + b"x")
    with refused("not the one the journal recorded"):
        campaign(tmp_path / "bad")
    curves.unlink()
    with refused("names this file and it is missing"):
        campaign(tmp_path / "bad")


def test_noise_that_was_learnt_is_in_the_journal_and_is_what_the_next_design_expects(
    tmp_path,
):
    louder = SimulatedLaboratory(
        SIMULATOR, LABORATORY.truth, repeats=20, times=TIMES, noise=Noise(scale=4.0)
    )
    run = campaign(tmp_path / "loud", settings=LEARNING)
    assert run.plan == LEARNING.plan
    step = run.tell(louder.shoot(tensor([400.0, 0.2]), seed=0))
    # some 20 frames of a mean curve
    assert step.noise.scale == pytest.approx(4.0, rel=0.35)
    again = campaign(tmp_path / "loud", settings=LEARNING)
    assert again.plan.noise == run.plan.noise == step.noise
    assert again.plan.repeats == LEARNING.plan.repeats


@pytest.mark.parametrize("missed", [False, True])
def test_that_noise_is_that_of_a_misfit_where_the_model_misses_what_was_told(
    tmp_path, missed
):
    truth = PARAMETERS.pack(CASE.truth | {"gas_loss": 2.0 if missed else 0.0})
    laboratory = SimulatedLaboratory(SIMULATOR, truth, repeats=1)
    run = campaign(tmp_path / "told", settings=LEARNING)
    step = run.tell(laboratory.shoot(tensor([400.0, 0.2]), seed=0))
    assert (step.noise.widened > 1.5) == missed
    assert campaign(tmp_path / "told", settings=LEARNING).plan.noise == step.noise


def test_that_the_cost_of_a_known_fit_is_no_setting():
    """It is of one search: journals that know no such field go on."""
    written = [
        CampaignSettings(learner=ExactLearner(options=SearchOptions(rival=cost))).to_dict()
        for cost in (None, 7.0)
    ]
    assert written[0] == written[1]
    assert "raw_samples" in written[0]["learner"]["options"]
    assert "rival" not in written[0]["learner"]["options"]
