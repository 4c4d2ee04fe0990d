"""Drawn curves: a collapse is drawn round, whatever the frames of the record."""

import torch

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.assimilate import SearchOptions, assimilate
from imr_torch.assimilate.dense import dense_curve
from imr_torch.float64 import tensor
from imr_torch.material import PARAMETERS
from imr_torch.observe import ExperimentBatch, SimulatedLaboratory

SIMULATOR = PolytropicSimulator()


def test_that_points_follow_each_other_closely_through_a_collapse():
    """No two neighbours are farther apart than five times what evenly spread ones would be."""
    laboratory = SimulatedLaboratory(
        SIMULATOR, PARAMETERS.pack({"G": 8310.0, "mu": 0.093}), repeats=1
    )
    design = tensor([400.0, 0.22])
    batch = ExperimentBatch((laboratory.shoot(design, seed=1),))
    options = SearchOptions(raw_samples=16, starts=2)
    fit = assimilate(wide_prior(["nhkv"]), batch, SIMULATOR, seed=0, options=options)[
        "nhkv"
    ]
    times, radius = dense_curve(fit, batch, SIMULATOR, points=400)
    assert times.shape == radius.shape == (1, 400)
    assert (times.diff(dim=1) > 0.0).all()
    steps = torch.hypot(times.diff(dim=1) / float(times.max()), radius.diff(dim=1))
    assert steps.max() < 5.0 * steps.sum() / 399.0
    assert radius.min() < fit.prediction.min()  # between two frames
