"""What may enter a journal, how it is taken out again, and what is learnt when a campaign was cut off in between."""

from dataclasses import dataclass, replace

import pytest

from imr_torch.assimilate import En4DVarOptions, SearchOptions
from imr_torch.campaign import (
    Campaign,
    CampaignSettings,
    Designs,
    ExactLearner,
    Random,
)
from imr_torch.design import DesignSpace, Plan
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.float64 import linspace
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, Nuisance, SimulatedLaboratory
from imr_torch.random import child
from imr_torch.simulate import PolytropicSimulator
from tests.journals import cut, rewritten
from tests.linear import NHKV, NOISE, LinearSimulator, prior, tensor
from tests.refusals import refused
from tests.stubs import StubLearner

PLAN = Plan(linspace(0.1, 2.0, 9), repeats=2, noise=NOISE, collapses=None)
EXACT = ExactLearner(32, SearchOptions(raw_samples=24))
LABORATORY = SimulatedLaboratory(
    LinearSimulator(),
    PARAMETERS.pack({"G": 5600.0, "mu": 0.18}),
    noise=NOISE,
    repeats=2,
    times=PLAN.times,
)
CURVES = [LABORATORY.shoot(tensor(300.0 + 100.0 * n, 0.2), seed=n) for n in range(4)]


def shoot(design, number):
    return LABORATORY.shoot(design, seed=child(0, "shoot", number))


def campaign(
    folder, *, told: int = 0, simulator=None, seed: int = 0, **settings
) -> Campaign:
    """A campaign that was told the first of the curves."""
    settings = {
        "space": DesignSpace(),
        "plan": PLAN,
        "policy": Random(),
        "learner": StubLearner(),
    } | settings
    run = Campaign(
        folder,
        prior(("newtonian", "nhkv")),
        simulator or LinearSimulator(),
        settings=CampaignSettings(**settings),
        seed=seed,
    )
    for curve in CURVES[:told]:
        run.tell(curve)
    return run


def kinds(run: Campaign) -> list[str]:
    return [event["event"] for event in run.journal.events]


@pytest.mark.parametrize("again", [False, True], ids=["same object", "opened again"])
def test_that_a_curve_that_was_told_is_refused_with_its_number_and_the_way_out(
    tmp_path, again
):
    run = campaign(tmp_path, told=2)
    before = run.journal.path.read_bytes()
    run = campaign(tmp_path) if again else run
    copy = replace(
        CURVES[1], label="copy", design=(777.0, 0.25), nuisance=Nuisance(rest_radius=0.1)
    )
    with refused(r"'copy' has the curve of experiment 2 .*forget it first: .*--forget 2"):
        run.tell(CURVES[2], copy)
    assert run.journal.path.read_bytes() == before
    assert len(run.experiments) == 2
    run.forget(2)
    assert run.tell(copy).number == 3


def test_that_what_was_told_and_not_learnt_is_learnt_before_anything_else(tmp_path):
    whole = campaign(tmp_path / "whole", told=2)
    whole.ask()
    assert kinds(whole) == ["start", "observed", "learnt", "observed", "learnt", "ask"]
    for name, act in {
        "ask": Campaign.ask,
        "learn": Campaign.learn_outstanding,
        "run": lambda c: c.run(None, 2),
    }.items():
        run = campaign(cut(tmp_path / "whole", tmp_path / name, 4))
        assert run.outstanding == (2,)
        assert run.belief.to_dict() == whole.steps[0].belief.to_dict()
        said: list[str] = []
        act(run)
        assert run.outstanding == ()
        assert run.belief.to_dict() == whole.belief.to_dict(), said
        assert kinds(run)[:5] == kinds(whole)[:5]
    run = campaign(cut(tmp_path / "whole", tmp_path / "tell", 2))
    run.tell(CURVES[1])
    run.ask()
    assert run.journal.path.read_bytes() == whole.journal.path.read_bytes()


@pytest.mark.parametrize(
    "learner", [EXACT, ExactLearner(32, En4DVarOptions(12, 2, 2))], ids=["exact", "en4dvar"]
)
def test_that_after_forgetting_the_belief_is_that_of_the_other_curves(tmp_path, learner):
    run = campaign(tmp_path / "all", learner=learner, told=1)
    run.tell(CURVES[3])
    run.tell(CURVES[1])
    step = run.forget(2)
    others = campaign(tmp_path / "others", learner=learner, told=2)
    assert run.belief.to_dict() == others.belief.to_dict()
    again = campaign(tmp_path / "all", learner=learner)
    for known in (run, again):
        assert known.belief.to_dict() == others.belief.to_dict()
        assert (known.numbers, known.told, [s.number for s in known.steps]) == (
            [1, 3],
            3,
            [1, 3],
        )
        assert [e.design for e in known.experiments] == [CURVES[0].design, CURVES[1].design]
    assert step.number == 3
    assert (tmp_path / "all" / "experiment_002.npz").exists()
    assert run.tell(CURVES[2]).number == 4


def test_that_forgetting_the_last_curve_goes_back_to_the_step_before_without_learning_again(
    tmp_path,
):
    run = campaign(tmp_path)
    first = run.tell(CURVES[0])
    run.tell(CURVES[1])
    assert run.forget(2) is first
    assert kinds(run)[-1] == "forget"
    assert run.forget(1) is None
    assert run.belief.to_dict() == run.prior.to_dict()
    assert campaign(tmp_path).experiments == []


def test_that_designs_asked_for_with_a_forgotten_curve_in_the_belief_are_asked_for_anew(
    tmp_path,
):
    @dataclass(frozen=True)
    class Follows(Random):
        def choose_design(self, situation, *, progress=None):
            found = super().choose_design(situation, progress=progress)
            return replace(found, gain=float(situation.belief.best.mean.sum()))

    run = campaign(tmp_path, policy=Follows(), told=2)
    before = run.ask()
    assert run.ask().gain == before.gain
    run.forget(2)
    assert run.ask().gain != before.gain
    assert run.ask().step == before.step == 3
    assert kinds(run)[-2:] == ["forget", "ask"]


@pytest.mark.parametrize("number", [0, 3, -1])
def test_that_an_unknown_experiment_cannot_be_forgotten(tmp_path, number):
    run = campaign(tmp_path, told=2)
    with refused(rf"no experiment {number} to forget .*it counts 1 \('.*'\), 2 \('.*'\)"):
        run.forget(number)
    run.forget(2)
    with refused("no experiment 2 to forget"):
        run.forget(2)


def test_that_a_curve_that_cannot_be_simulated_is_not_recorded(tmp_path):
    run = campaign(tmp_path, simulator=LinearSimulator(fails=True))
    with refused(
        r"cannot be simulated: all 8 gels drawn of each of newtonian, nhkv failed"
    ):
        run.tell(CURVES[0])
    assert not run.journal.path.exists()
    assert list(tmp_path.glob("*.npz")) == []


@pytest.mark.parametrize(
    "factor",
    [1e3, 1e-3],
    ids=["milliseconds read as seconds", "seconds read as milliseconds"],
)
def test_that_a_curve_whose_times_are_in_another_unit_is_not_recorded(tmp_path, factor):
    simulator = PolytropicSimulator()
    times = linspace(0.0, 3.0, 31)
    gel = PARAMETERS.pack({"G": 5600.0, "mu": 0.1})
    radius = simulator(gel, tensor(400.0, 0.2), times).radius
    good = Experiment("good", (400.0, 0.2), times, radius.reshape(1, -1))
    run = campaign(tmp_path, simulator=simulator)
    with refused(
        r"'bad' collapses first at a dimensionless time of .* in another unit than stated"
    ):
        run.tell(replace(good, label="bad", times=factor * times))
    assert not run.journal.path.exists()
    run.tell(good)
    assert run.numbers == [1]


def test_that_learning_that_fails_names_the_curve_and_forgetting_it_goes_on(tmp_path):
    loud = replace(CURVES[1], radius=CURVES[1].radius + 5.0)
    run = campaign(tmp_path, learner=StubLearner(fails_above=3.0), told=1)
    with refused(
        r"did not converge.*experiment 2, which is in the journal.*--forget 2",
        ConvergenceError,
    ):
        run.tell(loud)
    run = campaign(tmp_path, learner=StubLearner(fails_above=3.0))
    with refused("--forget 2", ConvergenceError):
        run.ask()
    run.forget(2)
    run.ask()
    assert run.outstanding == ()


def test_that_a_refused_campaign_leaves_no_journal_that_refuses_the_corrected_one(tmp_path):
    @dataclass(frozen=True)
    class Refusing:
        def choose_design(self, situation, *, progress=None):
            raise InputDataError("nothing is left to shoot")

    with refused("nothing is left"):
        campaign(tmp_path, policy=Refusing()).ask()
    assert campaign(tmp_path).ask().step == 1


def test_that_an_identity_that_json_cannot_hold_is_refused_by_name(tmp_path):
    for note in ({"depth": float("nan")}, {"camera": object()}):
        with refused("note cannot be written to a journal"):
            Campaign(tmp_path, NHKV, LinearSimulator(), note=note)


def test_that_a_campaign_is_resumed_on_any_number_of_threads(tmp_path):
    alone = PolytropicSimulator(threads=1)
    campaign(tmp_path / "a", simulator=alone).ask()
    before = (tmp_path / "a" / "journal.jsonl").read_bytes()
    run = campaign(tmp_path / "a", simulator=PolytropicSimulator(threads=2))
    run.ask()
    assert run.journal.path.read_bytes() == before
    assert b" at 0x" not in before
    with refused("simulator differ"):
        campaign(tmp_path / "a", simulator=LinearSimulator())


@pytest.mark.parametrize(
    ("place", "change", "message"),
    [
        (0, {"event": "note"}, "line 1: event is 'note'; a campaign begins with 'start'"),
        (
            2,
            {"belief": {}},
            r"line 3: Expected a document of the format 'imr_torch belief 1', got None",
        ),
        (
            2,
            {"evidence": [5]},
            r"line 3: event 'learnt' cannot be read \(AttributeError.*Restore the journal",
        ),
    ],
    ids=str,
)
def test_that_an_event_that_makes_no_sense_is_refused_by_line(
    tmp_path, place, change, message
):
    run = campaign(tmp_path, told=1)
    run.ask()
    events = run.journal.events
    rewritten(tmp_path, [*events[:place], events[place] | change, *events[place + 1 :]])
    with refused(message):
        campaign(tmp_path)


def test_that_a_shot_that_failed_is_recorded_and_its_design_asked_again_then_moved(
    tmp_path,
):
    @dataclass(frozen=True)
    class Away(Random):
        """Next to what is pending."""

        def choose_design(self, situation, *, progress=None):
            found = super().choose_design(situation, progress=progress)
            if situation.pending is None:
                return found
            return replace(found, design=situation.pending[-1] + tensor(1.0, 0.0))

    run = campaign(tmp_path, policy=Away(), told=1)
    asked = run.ask()
    before = run.belief.to_dict()
    run.fail("shot.csv", "It has 6 frames.")
    for known in (run, campaign(tmp_path, policy=Away())):
        assert known.belief.to_dict() == before
        assert known.told == 1
        again = known.ask()
        assert (again.step, again.design.tolist()) == (2, asked.design.tolist())
        assert [(x["label"], x["reason"]) for x in known.failures] == [
            ("shot.csv", "It has 6 frames.")
        ]
    run.fail("shot.csv", "It is cut off by the edge.")
    moved = run.ask()
    assert moved.design.tolist() == (asked.design + tensor(1.0, 0.0)).tolist()
    assert run.ask().design.tolist() == moved.design.tolist()
    assert kinds(run)[-4:] == ["ask", "failed", "failed", "ask"]
    assert run.tell(CURVES[1]).number == 2


def test_that_a_forgotten_curve_does_not_count(tmp_path):
    designs = campaign(tmp_path / "designs", stop=Designs(2), told=2)
    designs.forget(1)
    assert designs.reason_to_stop() is None
