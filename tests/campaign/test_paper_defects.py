"""The six defects of the method of arXiv 2409.00011: a campaign has none of them."""

import math
from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import SearchOptions
from imr_torch.campaign import Campaign, CampaignSettings, ExactLearner, Observations
from imr_torch.design import (
    DesignOptimizer,
    DesignSpace,
    Laplace,
    Plan,
    expected_information_gain,
)
from imr_torch.float64 import linspace, ones, rand
from imr_torch.material import PARAMETERS, Belief
from imr_torch.observe import Experiment, ExperimentBatch, Noise, SimulatedLaboratory
from imr_torch.random import generator
from tests.linear import NHKV, NOISE, LinearSimulator, exact, prior, tensor

SIMULATOR = LinearSimulator()
TIMES = linspace(0.1, 3.0, 30)
EXACT = ExactLearner(64, SearchOptions(raw_samples=24))
TRUTH = PARAMETERS.pack({"G": 5300.0, "mu": 0.16})
TWO = ("newtonian", "nhkv")


def learn(batch: ExperimentBatch, models: tuple[str, ...] = TWO) -> Belief:
    """What is believed after all experiments of a batch."""
    return EXACT.infer_belief(Observations(prior(models), batch, 0), SIMULATOR).belief


def shot(
    repeats: int = 1,
    noise: Noise = NOISE,
    design: tuple[float, float] = (300.0, 0.2),
    seed: int = 0,
) -> ExperimentBatch:
    laboratory = SimulatedLaboratory(
        SIMULATOR, TRUTH, noise=noise, repeats=repeats, times=TIMES
    )
    return ExperimentBatch((laboratory.shoot(tensor(*design), seed=seed),), noise)


def test_1_the_information_gain_does_not_saturate_at_the_log_of_the_draws():
    plan = Plan(TIMES, repeats=10**4, noise=NOISE, collapses=None)
    designs = tensor([300.0, 0.2])
    gain = expected_information_gain(
        NHKV, designs, SIMULATOR, plan, estimator=Laplace(draws=16), seed=0
    ).value
    batch = ExperimentBatch((Experiment("", (300.0, 0.2), TIMES, ones(1, 30)),), NOISE)
    one = replace(batch, noise=replace(NOISE, scale=1e-2))  # ten thousand repeats
    truth = -0.5 * float(torch.logdet(exact(NHKV.models[0], one).covariance))
    assert truth > math.log(100) + 5.0
    assert gain == pytest.approx(truth, abs=1e-3)


def test_2_the_likelihood_is_not_tempered_by_frames_and_repeats():
    batch = shot(50)
    truth = exact(NHKV.models[0], batch).covariance
    found = learn(batch)["nhkv"].chol
    torch.testing.assert_close(found @ found.mT, truth, rtol=0.25, atol=1e-6)


def test_3_model_probability_grows_with_repeats():
    noise = replace(NOISE, scale=120.0)
    few, many = (learn(shot(count, noise)).probabilities["nhkv"] for count in (20, 2000))
    assert few < 0.95 < 0.999 < many


def test_4_the_prior_is_not_used_again_with_every_design():
    """Of data that say nothing nothing is learnt."""
    silent = replace(NOISE, scale=1e4)
    batch = ExperimentBatch(shot(1, silent).experiments * 3, silent)
    chol = learn(batch)["nhkv"].chol
    assert chol.diagonal().log().sum() == pytest.approx(0.0, abs=0.1)


def test_5_the_best_observed_value_does_not_win_by_luck():
    space = DesignSpace()
    X = rand(12, 2, generator=generator(0))
    X = space.bounds[0] + (space.bounds[1] - space.bounds[0]) * X
    Y = -((X[:, :1] - 500.0) / 300.0).square()
    lucky = int(Y.argmin())
    Y[lucky] = 1.0
    variance = torch.full_like(Y, 1e-4)
    variance[lucky] = 4.0
    optimizer = DesignOptimizer(space, seed=0)
    optimizer.tell(X, Y, variance)
    assert abs(optimizer.recommend().design[0] - 500.0) < 100.0


def test_6_the_design_that_counts_is_the_one_that_was_achieved(tmp_path):
    laboratory = SimulatedLaboratory(
        SIMULATOR, TRUTH, noise=NOISE, repeats=50, times=TIMES, scatter=(0.2, 0.1)
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
        run = Campaign(tmp_path / name, NHKV, SIMULATOR, settings=settings)
        part = run.tell(experiment).belief["nhkv"]
        return float(((part.means - tensor(5300.0, 0.16)) / part.sds).abs().max())

    assert deviation(achieved, "achieved") < 3.0
    assert deviation(taken_at_its_word, "asked") > 10.0
