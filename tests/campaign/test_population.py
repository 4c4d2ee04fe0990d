"""Campaigns about a population: what they learn of median and scatter, and that they resume as if
nothing had happened.
"""

import json
import math
from pathlib import Path

import pytest
import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.campaign import (
    Campaign,
    CampaignSettings,
    Fixed,
    Journal,
    LearnPopulation,
    Optimal,
    PopulationLearner,
    RelativeSd,
    population,
)
from imr_torch.cli import main
from imr_torch.design import Plan
from imr_torch.errors import InputDataError
from imr_torch.material import PARAMETERS
from imr_torch.observe import Experiment, SimulatedLaboratory, Statement, gel_medium
from imr_torch.population import GaussianShots
from imr_torch.random import child, generator
from tests.journals import cut

SIMULATOR = PolytropicSimulator()
PRIOR = wide_prior(["nhkv"])
G = 8e3
MU = 0.09
SCATTER = 0.2
LEARNER = PopulationLearner(samples=128)
SEARCH = Optimal(evaluations=6, initial=4, batch=2)


def settings(**changes) -> CampaignSettings:
    return CampaignSettings(
        **{"plan": Plan(repeats=1), "policy": LearnPopulation(SEARCH), "learner": LEARNER} | changes
    )


def campaign(folder: Path, **changes) -> Campaign:
    return Campaign(folder, PRIOR, SIMULATOR, settings=settings(**changes), seed=1)


def shoot(design: torch.Tensor, number: int) -> Experiment:
    """A shot of a gel of its own; all labels are the same, as of a camera that names every film
    alike.
    """
    factor = math.exp(
        SCATTER * float(torch.randn(1, generator=generator(child(7, number)), dtype=torch.float64))
    )
    laboratory = SimulatedLaboratory(
        SIMULATOR, PARAMETERS.pack({"G": G * factor, "mu": MU}), repeats=1
    )
    return laboratory.shoot(design, seed=number, label="film")


@pytest.fixture(scope="module")
def five(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("five")
    campaign(folder).run(shoot, 5)
    return folder


def test_that_median_and_scatter_are_learnt(five: Path) -> None:
    found = campaign(five)
    first = found.steps[0]
    last = found.steps[-1]
    assert first.population is None  # one shot shows no scatter
    assert last.population is not None
    low, _, high = last.population["parameters"]["G"]["median"]
    assert low < G < high
    low, _, high = last.population["parameters"]["G"]["scatter"]
    assert low < SCATTER < high
    assert [shot["id"] for shot in last.population["shots"]] == [
        "film",
        *(f"film ({n})" for n in range(2, 6)),
    ]
    widths = [float(step.belief.best.sds[0] / step.belief.best.means[0]) for step in found.steps]
    assert widths[-1] < 0.7 * widths[0]


def test_that_the_belief_is_wider_than_the_error_of_one_gel(five: Path) -> None:
    """Five shots taken for one gel would give G to a percent; that of the median is as the scatter
    allows.
    """
    found = campaign(five).belief.best
    relative = float(found.sds[0] / found.means[0])
    assert 0.5 * SCATTER / math.sqrt(5) < relative < 2.0 * SCATTER


def test_that_the_gain_falls_and_is_below_that_of_a_shot_without_error(five: Path) -> None:
    asked = [event for event in Journal(five).events if event["event"] == "ask"]
    gains, limits = zip(
        *((event["gain"], float(event["reason"].split("tell ")[1].split()[0])) for event in asked),
        strict=True,
    )
    assert all(
        gain < limit + 3.0 * event["gain_sd"]
        for gain, limit, event in zip(gains, limits, asked, strict=True)
    )
    assert gains[-1] < 0.5 * gains[0]


def test_that_a_campaign_that_was_killed_goes_on_with_the_same_bits(
    five: Path, tmp_path: Path
) -> None:
    whole = Journal(five).events
    for count, shots in (
        (3, 2),
        (6, 3),
        (8, 3),
    ):  # after shots were told and not learnt, learnt, and asked for
        folder = cut(five, tmp_path / str(count), count, torn=0.5)
        campaign(folder).run(shoot, shots)
        events = Journal(folder).events
        assert events == whole[: len(events)]
        assert len(events) > count


def test_that_two_shots_can_be_asked_for_at_once(five: Path, tmp_path: Path) -> None:
    first, second = campaign(tmp_path).ask_several(2)
    assert first.gain is not None
    assert second.gain is not None
    assert 0.0 < second.gain < first.gain


def test_that_a_rule_on_the_median_ends_it(five: Path, tmp_path: Path) -> None:
    found = campaign(tmp_path, policy=Fixed(((200.0, 0.28),) * 4), stop=RelativeSd(0.5))
    found.run(shoot, 4)
    assert len(found.experiments) < 4


def test_that_what_it_cannot_learn_from_is_refused(tmp_path: Path) -> None:
    two = Campaign(tmp_path, wide_prior(["nhkv", "gen_qkv"]), SIMULATOR, settings=settings())
    with pytest.raises(InputDataError, match="holds 2"):
        two.ask()
    with pytest.raises(InputDataError, match="noise_rounds is -1; expected 0 or more"):
        PopulationLearner(noise_rounds=-1)


def test_that_the_command_reports_a_population(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "gels"
    words = (
        "--case",
        "soft-pa",
        "--scatter",
        "G=.2",
        "--designs",
        "2",
        "--evaluations",
        "4",
        "--physics",
        "polytropic",
    )
    main(
        [
            "campaign",
            "--goal",
            "population",
            *words,
            "--out",
            str(folder),
            "--html",
            str(tmp_path / "page.html"),
        ]
    )
    document = json.loads((folder / "campaign.json").read_text())
    assert document["goal"] == "population"
    assert len(document["population"]["shots"]) == 2
    said = capsys.readouterr().out
    assert document["population"]["sentence"] in said
    assert "median" in said
    assert (folder / "population.png").exists()
    page = (tmp_path / "page.html").read_text()
    assert "Does the gel differ from shot to shot?" in page
    assert "each of a gel of its own" in page
    shots = [(folder / f"experiment_{n:03d}.npz").read_bytes() for n in (1, 2)]
    assert shots[0] != shots[1]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--scatter", "G=.2"), "no effect without --goal population"),
        (
            ("--goal", "population", "--scatter", "G=.2", "--models", "nhkv"),
            "no effect without --case",
        ),
        (("--goal", "population", "--case", "soft-pa", "--scatter", "G=-1"), "expected NAME=SD"),
        (("--goal", "population", "--case", "soft-pa", "--scatter", "G=nan"), "expected NAME=SD"),
        (
            ("--goal", "population", "--case", "soft-pa", "--scatter", "G=.2,G=.1"),
            "expected NAME=SD",
        ),
        (("--goal", "population", "--case", "soft-pa", "--scatter", "G"), "expected NAME=SD"),
        (
            ("--goal", "population", "--case", "soft-pa", "--scatter", "tau=.2"),
            "zero in the gel of soft-pa; name one of G, mu",
        ),
        (("--goal", "population", "--models", "nhkv,gen_qkv"), "name one"),
        (
            ("--goal", "population", "--models", "nhkv", "--method", "paper"),
            "--goal population learns",
        ),
        (
            ("--goal", "population", "--models", "nhkv", "--stop", "cause=.9"),
            "no effect without --goal cause",
        ),
        (
            ("--goal", "population", "--models", "nhkv", "--hide", "wall"),
            "no effect without --goal cause",
        ),
    ],
)
def test_that_options_that_do_not_suit_are_refused(
    words, text: str, tmp_path: Path, capsys
) -> None:
    assert main(["campaign", *words, "--out", str(tmp_path / "x")]) != 0
    assert text in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_that_what_is_inferred_of_the_medium_is_not_asked_for_scatter() -> None:
    part = gel_medium(Statement.from_text("density=1060:20")).believed_of(PRIOR.models[0])
    with_density, without = (
        population.information_about(GaussianShots.none(len(prior.names)), prior)
        for prior in (part, PRIOR.models[0])
    )
    assert part.names[-1] == "density"
    assert torch.equal(with_density.scatter[:, :2], without.scatter)
    assert float(with_density.scatter[:, 2].abs().max()) == 0.0
    assert (
        with_density.largest_gain() > without.largest_gain()
    )  # a shot that showed its gel would also tell the density
