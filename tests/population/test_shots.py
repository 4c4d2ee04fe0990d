"""The noise of shots that are fitted each by itself: that of the camera, or of a misfit where the
model misses the curves.
"""

from dataclasses import replace

import pytest

from imr_torch import PolytropicSimulator, wide_prior
from imr_torch.assimilate import (
    Posterior,
    SearchOptions,
    assimilate,
    infer_frame_noise,
)
from imr_torch.float64 import tensor, zeros
from imr_torch.material import PARAMETERS, Belief
from imr_torch.observe import ExperimentBatch, SimulatedLaboratory
from imr_torch.population import fit_shots
from tests.drifting import PART, SLOW, assert_that_only_widened_hold, drifting, hold
from tests.fewer import FEW
from tests.linear import NOISE

OPTIONS = SearchOptions(raw_samples=8, starts=2)
BELIEF = Belief((PART,), zeros(1))


def test_that_one_law_of_a_misfit_for_shots_of_different_gels_states_intervals_that_hold():
    inside: dict[str, list[bool]] = {"independent": [], "widened": []}
    for seed in range(20):
        batch, gels = drifting(seed, alone=True)
        shots = [ExperimentBatch((shot,), NOISE) for shot in batch.experiments]
        fits = [
            assimilate(BELIEF, shot, SLOW, seed=0, options=OPTIONS).fits[0]
            for shot in shots
        ]
        near = [
            Posterior(PART, shot, SLOW).neighbourhood(fit.point)
            for shot, fit in zip(shots, fits, strict=True)
        ]
        law = infer_frame_noise(near, FEW(NOISE)).for_fits(widen=True).law
        assert law.correlation_time == 0.0
        for kind, scale in (
            ("independent", law.scale / law.widened),
            ("widened", law.scale),
        ):
            for shot, gel in zip(shots, gels, strict=True):
                inside[kind] += hold(replace(shot, noise=replace(law, scale=scale)), gel)
    assert_that_only_widened_hold(inside)


@pytest.mark.parametrize("missed", [False, True])
def test_that_the_noise_is_that_of_a_misfit_where_the_model_misses_the_shots(missed):
    simulator = PolytropicSimulator()
    shots = []
    for number, G in enumerate((6e3, 9e3)):
        truth = PARAMETERS.pack({"G": G, "mu": 0.09, "gas_loss": 2.0 if missed else 0.0})
        laboratory = SimulatedLaboratory(simulator, truth, repeats=1)
        shots.append(
            laboratory.shoot(tensor([400.0, 0.22]), seed=number, label=f"shot {number}")
        )
    fits = fit_shots(
        wide_prior(["nhkv"])["nhkv"],
        shots,
        simulator,
        samples=64,
        options=replace(OPTIONS, raw_samples=16),
    )
    noise = fits[0].batch.noise
    assert (noise.widened > 1.5) == missed
