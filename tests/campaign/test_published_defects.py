"""The six defects of the published method: paper mode shows each, the default does not."""

import math
from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import PublishedOptions, SearchOptions
from imr_torch.campaign import Campaign, CampaignSettings, ExactLearner, Observations, PaperLearner
from imr_torch.design import (
    DesignOptimizer,
    DesignSpace,
    InformationEstimator,
    Laplace,
    Plan,
    PublishedEstimator,
    Strategy,
    expected_information_gain,
)
from imr_torch.errors import InputDataError
from imr_torch.material import PARAMETERS, Belief
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance, SimulatedLaboratory
from tests.linear import NOISE, LinearSimulator, exact, experiments, prior, tensor

SIMULATOR = LinearSimulator()
TIMES = torch.linspace(0.1, 3.0, 30, dtype=torch.float64)
EXACT = ExactLearner(64, SearchOptions(raw_samples=24))
PAPER = PaperLearner()
TWO = ("newtonian", "nhkv")


def learn(learner, batch: ExperimentBatch, models: tuple[str, ...] = TWO) -> Belief:
    """What is believed after all experiments of a batch."""
    belief = prior(models)
    return learner.infer_belief(
        Observations(belief, belief, batch, len(batch.experiments), 0), SIMULATOR
    ).belief


def shot(
    repeats: int = 1,
    noise: Noise = NOISE,
    design: tuple[float, float] = (300.0, 0.2),
    seed: int = 0,
) -> ExperimentBatch:
    truth = PARAMETERS.pack({"G": 5300.0, "mu": 0.16})
    laboratory = SimulatedLaboratory(SIMULATOR, truth, noise=noise, repeats=repeats, times=TIMES)
    return ExperimentBatch((laboratory.shoot(tensor(*design), seed=seed),), noise)


def spread(belief: Belief, model: str = "nhkv") -> float:
    """Determinant of the posterior standard deviations in units of the prior's."""
    return float(belief[model].chol.diagonal().log().sum())


def test_1_the_information_gain_saturates_at_the_log_of_the_draws():
    plan = Plan(TIMES, repeats=10**4, noise=NOISE, collapses=None)
    designs = torch.tensor([[300.0, 0.2]], dtype=torch.float64)

    def gain(estimator: InformationEstimator) -> float:
        return expected_information_gain(
            prior(("nhkv",)), designs, SIMULATOR, plan, estimator=estimator, seed=0
        ).value

    assert gain(PublishedEstimator(100)) == pytest.approx(math.log(100), abs=0.01)
    batch = ExperimentBatch(
        (Experiment("", (300.0, 0.2), TIMES, torch.ones(1, 30, dtype=torch.float64)),), NOISE
    )
    one = replace(batch, noise=replace(NOISE, scale=1e-2))  # ten thousand repeats
    truth = -0.5 * float(torch.logdet(exact(prior(("nhkv",)).models[0], one).covariance))
    assert truth > math.log(100) + 5.0
    assert gain(Laplace(draws=16)) == pytest.approx(truth, abs=1e-3)


def test_2_the_likelihood_is_tempered_by_frames_and_repeats():
    """The posterior is as wide as if 1 of 30 frames of 1 of 50 repeats had been seen, three times over."""
    batch = shot(50)
    truth = exact(prior(("nhkv",)).models[0], batch).covariance
    right = learn(EXACT, batch)["nhkv"].chol
    torch.testing.assert_close(right @ right.mT, truth, rtol=0.25, atol=1e-6)
    wide = learn(PaperLearner(PublishedOptions(cycles=1)), batch)["nhkv"].chol
    assert float(torch.linalg.norm(wide, dim=1).min()) > 5.0 * float(truth.diagonal().sqrt().max())


def test_3_model_probability_does_not_grow_with_repeats_and_is_averaged_over_designs():
    noise = replace(NOISE, scale=120.0)
    few = shot(20, noise)
    many = shot(2000, noise)
    decided = [learn(EXACT, batch).probabilities["nhkv"] for batch in (few, many)]
    vague = [learn(PAPER, batch).probabilities["nhkv"] for batch in (few, many)]
    assert decided[0] < 0.95 < 0.999 < decided[1]
    assert abs(vague[1] - vague[0]) < 0.05
    assert vague[1] < 0.6
    both = ExperimentBatch(
        (*many.experiments, *shot(2000, noise, (800.0, 0.2), 1).experiments), noise
    )
    alone = [
        learn(PAPER, ExperimentBatch((e,), noise)).probabilities["nhkv"] for e in both.experiments
    ]
    assert learn(PAPER, both).probabilities["nhkv"] == pytest.approx(sum(alone) / 2, abs=0.1)


def test_4_the_prior_is_used_again_with_every_design():
    """Of data that say nothing the default learns nothing; the published belief halves its variance
    each time.
    """
    silent = replace(NOISE, scale=1e4)
    batch = ExperimentBatch(shot(1, silent).experiments * 3, silent)
    assert spread(learn(EXACT, batch)) == pytest.approx(0.0, abs=0.1)
    published = learn(PaperLearner(PublishedOptions(members=200, iterations=1)), batch)
    assert spread(published) == pytest.approx(-0.5 * 2 * math.log(2.0**3), abs=0.25)


def test_5_the_best_observed_value_wins_by_luck():
    space = DesignSpace()
    X = torch.rand(12, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    X = space.bounds[0] + (space.bounds[1] - space.bounds[0]) * X
    Y = -((X[:, :1] - 500.0) / 300.0).square()
    lucky = int(Y.argmin())
    Y[lucky] = 1.0
    variance = torch.full_like(Y, 1e-4)
    variance[lucky] = 4.0

    def chosen(strategy: Strategy) -> torch.Tensor:
        optimizer = DesignOptimizer(space, seed=0, strategy=strategy)
        optimizer.tell(X, Y, variance)
        return optimizer.recommend().design

    assert torch.equal(chosen("paper"), X[lucky])
    assert abs(float(chosen("qLogNEI")[0]) - 500.0) < 100.0


def test_6_the_design_that_was_asked_for_is_not_the_one_that_was_achieved(tmp_path):
    truth = PARAMETERS.pack({"G": 5300.0, "mu": 0.16})
    laboratory = SimulatedLaboratory(
        SIMULATOR, truth, noise=NOISE, repeats=50, times=TIMES, scatter=(0.2, 0.1)
    )
    asked = tensor(400.0, 0.2)
    achieved = laboratory.shoot(asked, seed=5)
    assert abs(achieved.design[0] / 400.0 - 1.0) > 0.02
    taken_at_its_word = replace(achieved, design=(400.0, 0.2))
    settings = CampaignSettings(
        plan=Plan(TIMES, repeats=50, noise=NOISE, collapses=None), learner=EXACT
    )

    def deviation(experiment: Experiment, name: str) -> float:
        """Of the posterior mean from the truth, in standard deviations; the largest of all
        parameters.
        """
        run = Campaign(tmp_path / name, prior(("nhkv",)), SIMULATOR, settings=settings)
        part = run.tell(experiment).belief["nhkv"]
        return float(((part.means - tensor(5300.0, 0.16)) / part.sds).abs().max())

    assert deviation(achieved, "achieved") < 3.0
    assert deviation(taken_at_its_word, "asked") > 10.0


def test_that_the_published_learner_refuses_what_it_cannot_express():
    with pytest.raises(InputDataError, match="takes designs and clocks as exact"):
        learn(PAPER, experiments(1, nuisance=Nuisance(time_zero=0.1)))
