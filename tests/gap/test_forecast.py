"""The expected probability of the truth after one more shot, against brute force, and what it depends on."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from imr_torch.assimilate import ModelFit
from imr_torch.design import NextDesign, Plan
from imr_torch.float64 import linspace, ones, randn, tensor
from imr_torch.gap.identity_design import identity_design, judge_design, plan_of
from imr_torch.observe import Experiment, ExperimentBatch, Film, Noise, Nuisance, predict
from imr_torch.random import generator
from tests.gap.synthetic import CAUSES, SIMULATOR, fit_alike

NOISE = Noise(scale=4.0)
PLAN = Plan(times=linspace(0.0, 2.0, 21), noise=NOISE, collapses=None)
EVEN = dict.fromkeys(CAUSES, 0.5)
UNEVEN = {"strain_stiffening": 0.7, "damage": 0.3}
DESIGN = tensor([800.0, 0.15])
POOR = tensor([100.0, 0.3])


@pytest.fixture(scope="module")
def fits():
    """Two causes that are alike in one shot."""
    return fit_alike(repeats=4)


def ahead(
    fits, design: Tensor = DESIGN, plan: Plan = PLAN, *, causes=EVEN, draws: int = 40
) -> NextDesign:
    return judge_design(causes, fits, design, SIMULATOR, plan, draws=draws, seed=1)


def brute_force(
    fits, causes: dict[str, float], design: Tensor, data: int = 150, gels: int = 3000
) -> tuple[float, float]:
    """Mean probability of the truth and its error: evidences are plain means of the likelihood over
    posterior draws.
    """
    source = generator(5)
    film = Film(design[None], PLAN.times[None])
    curves = {
        n: predict(SIMULATOR, drawn(own, gels, source), film)[:, 0]
        for n, own in fits.items()
    }
    value = 0.0
    variance = 0.0
    for name, weight in causes.items():
        truth = curves[name][:data]
        y = truth + NOISE.sd(truth, PLAN.times) * randn(truth.shape, generator=source)
        logs = torch.stack(
            [math.log(p) + evidence(y, curves[other][data:]) for other, p in causes.items()]
        )
        own = torch.softmax(logs, 0)[list(causes).index(name)]
        value += weight * float(own.mean())
        variance += weight**2 * float(own.var()) / data
    return value, math.sqrt(variance)


def drawn(own: ModelFit, count: int, source: torch.Generator) -> Tensor:
    """Parameters of gels drawn from a posterior."""
    noise = randn(count, len(own.mean), generator=source)
    return own.posterior.parameters(own.posterior.mean + noise @ own.posterior.chol.mT)


def evidence(y: Tensor, curves: Tensor) -> Tensor:
    sd = NOISE.sd(curves, PLAN.times)
    logs = -0.5 * ((y[:, None] - curves) / sd).square().sum(-1) - sd.log().sum(-1)
    return torch.logsumexp(logs, 1) - math.log(len(curves))


@pytest.mark.parametrize("causes", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_that_the_stated_probability_is_that_of_brute_force(fits, causes):
    stated = ahead(fits, causes=causes, draws=150)
    value, error = brute_force(fits, causes, DESIGN)
    assert stated.after == pytest.approx(
        value, abs=3.0 * math.hypot(error, stated.after_error)
    )
    assert stated.now == pytest.approx(sum(p * p for p in causes.values()))
    assert stated.after > stated.now + 3.0 * stated.after_error


def test_that_the_proposed_design_beats_a_poor_one(fits):
    """Both judged by brute force, which the search has not seen."""
    found = identity_design(fits, EVEN, SIMULATOR, seed=0, plan=PLAN, designs=4, draws=8)
    (best, error), (poor, other) = (
        brute_force(fits, EVEN, design) for design in (found.design, POOR)
    )
    assert best > poor + 3.0 * math.hypot(error, other)


def test_that_repeats_raise_the_gain_and_nuisances_lower_it(fits):
    few = ahead(fits)
    many = ahead(fits, plan=replace(PLAN, repeats=8))
    blurred = ahead(fits, plan=replace(PLAN, nuisance=Nuisance(0.01, 0.01, 0.03)))
    assert many.after - few.after > 3.0 * math.hypot(many.after_error, few.after_error)
    assert few.after - blurred.after > 3.0 * math.hypot(
        blurred.after_error, few.after_error
    )
    assert many.gain > few.gain > blurred.gain


def test_that_a_shot_that_cannot_tell_leaves_the_probability(fits):
    """The noise is the same at every radius: one that grows with it tells of the radius itself."""
    noisy = replace(PLAN, noise=Noise(scale=1e4, slope=0.0, drift=0.0))
    found = ahead(fits, plan=noisy, causes=UNEVEN)
    assert found.after == pytest.approx(found.now, abs=1e-3)
    assert not found.helps


def test_that_the_plan_is_the_median_of_the_data():
    def shot(repeats: int, frames: int, sd: float) -> Experiment:
        times = linspace(0.0, frames / 20, frames)
        return Experiment(
            "shot",
            (400.0, 0.2),
            times,
            ones(repeats, frames),
            Nuisance(sd, 0.004, 0.0),
        )

    noise = Noise(scale=1.5)
    plan = plan_of(
        ExperimentBatch((shot(2, 30, 0.1), shot(5, 40, 0.01), shot(9, 80, 0.02)), noise)
    )
    assert (plan.repeats, len(plan.times), float(plan.times[-1])) == (5, 40, 2.0)
    assert plan.noise == noise
    assert plan.nuisance == Nuisance(0.02, 0.004, 0.0)
    assert plan.collapses is None
