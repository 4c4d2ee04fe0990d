"""The discrepancy to the prior predictive:

right level on the model's own data, power where data lie outside of it.
"""

import torch

from benchmarks.gap.mmd import mmd_p_value, prior_predictive_mmd
from imr_torch.observe import Experiment, ExperimentBatch
from imr_torch.random import generator
from tests.linear import NOISE, LinearSimulator, prior, tensor


def test_that_sets_of_the_same_law_are_rejected_at_the_stated_level() -> None:
    source = generator(1)
    rejected = 0
    for trial in range(200):
        rows = torch.randn(121, 4, generator=source, dtype=torch.float64)
        rejected += mmd_p_value(rows[:1], rows[1:], seed=trial, shuffles=99) <= 0.05
    assert 2 <= rejected <= 20


def test_that_a_set_outside_is_rejected_also_as_one_row_and_more_surely_as_several() -> None:
    source = generator(2)
    simulated = torch.randn(300, 4, generator=source, dtype=torch.float64)
    assert mmd_p_value(torch.full((1, 4), 4.0).double(), simulated, seed=0) < 0.01
    shifted = 0.7 + torch.randn(20, 4, generator=source, dtype=torch.float64)
    assert mmd_p_value(shifted, simulated, seed=0) < 0.01
    assert mmd_p_value(shifted[:1], simulated, seed=0) > 0.01


def test_that_data_of_the_model_pass_and_data_that_no_gel_makes_do_not() -> None:
    part = prior(("nhkv",))["nhkv"]
    times = torch.linspace(0.1, 3.0, 20, dtype=torch.float64)
    clean = LinearSimulator()(
        part.parameters(torch.zeros(2).double()), tensor(400.0, 0.2), times
    ).radius
    for added, low, high in ((0.0, 0.05, 1.0), (0.6, 0.0, 0.05)):
        curve = NOISE.draw(clean + added * torch.sin(6.0 * times), times, 3, generator=generator(4))
        batch = ExperimentBatch((Experiment("a", (400.0, 0.2), times, curve),), NOISE)
        assert low <= prior_predictive_mmd(part, batch, LinearSimulator(), seed=1) <= high
