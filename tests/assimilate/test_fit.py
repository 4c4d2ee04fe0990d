"""The linearisation that a fit hands on: of the same bubbles, under any noise, and of no others."""

from dataclasses import replace

import pytest
import torch

from imr_torch.assimilate import Assimilation, SearchOptions
from imr_torch.observe import ExperimentBatch, Noise, Nuisance
from tests.linear import NHKV, LinearSimulator, experiments, fit_linear
from tests.refusals import refused

BATCH = experiments(3, nuisance=Nuisance(time_zero=0.2, rest_radius=0.3))
SIMULATOR = LinearSimulator()


@pytest.fixture(scope="module")
def fit():
    options = SearchOptions(raw_samples=24, starts=2)
    return fit_linear(BATCH, SIMULATOR, options=options).fits[0]


def _count(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """How many times bubbles are simulated for a linearisation."""
    calls = []
    bundle = LinearSimulator.bundle
    monkeypatch.setattr(
        LinearSimulator, "bundle", lambda *given: calls.append(1) or bundle(*given)
    )
    fit, batch, simulator = arguments
    fit.linearise(batch, simulator)
    monkeypatch.undo()
    return len(calls)


def test_that_another_noise_takes_no_bubbles_and_gives_the_same_equations(fit, monkeypatch):
    noisier = replace(BATCH, noise=Noise(scale=3.0))
    assert _count(monkeypatch, fit, noisier, SIMULATOR) == 0
    handed = fit.linearise(noisier, SIMULATOR).equations
    simulated = replace(fit, near=None).linearise(noisier, SIMULATOR).equations
    for name in ("gel_gradient", "gel_hessian", "nuisance_hessian", "cross"):
        torch.testing.assert_close(
            getattr(handed, name), getattr(simulated, name), rtol=1e-4, atol=1e-3
        )


def test_that_other_points_frames_and_simulators_are_simulated(fit, monkeypatch):
    moved = replace(fit, mean=fit.mean + 0.1)
    first = BATCH.experiments[0]
    later = replace(first, times=first.times + 0.01)
    other = ExperimentBatch((later, *BATCH.experiments[1:]), BATCH.noise)
    assert _count(monkeypatch, fit, BATCH, SIMULATOR) == 0
    assert _count(monkeypatch, moved, BATCH, SIMULATOR) == 1
    assert _count(monkeypatch, fit, other, SIMULATOR) == 1
    assert _count(monkeypatch, fit, BATCH, LinearSimulator()) == 1


def test_that_an_unknown_model_is_named_with_those_that_there_are(fit):
    fits = Assimilation(NHKV, BATCH, (fit,))
    assert fits["nhkv"] is fit
    with refused(r"'gen_qkv' is not part .* holds nhkv"):
        fits["gen_qkv"]
