import pytest
import torch

from imr_torch.gap.adequacy import adequacy_test
from imr_torch.gap.examine import onset, restrict
from imr_torch.goodness.linear import linearise_fit
from imr_torch.observe import Nuisance
from tests.gap.synthetic import SIMULATOR, fit, shoot

CASES = {
    "matched": ({}, "none"),
    "start": ({"residual_velocity": 0.04}, "start"),
    "collapse": ({"gas_loss": 0.15}, "first collapse"),
    "pulse": ({"pulse": 0.05, "pulse_time": 1.7, "pulse_width": -2.0}, "second collapse"),
}


@pytest.fixture(scope="module")
def cases():
    """Name -> the gap test at the fit, made once each."""
    found = {}

    def get(name: str):
        if name not in found:
            batch = shoot(CASES[name][0])
            best = fit(batch)
            found[name] = adequacy_test(best, [], batch, SIMULATOR, seed=0)
        return found[name]

    return get


@pytest.mark.parametrize("name", CASES)
def test_that_the_onset_is_in_the_phase_in_which_the_effect_acts_and_silent_on_matched_data(
    cases, name
):
    found = onset(cases(name), seed=1)
    assert found.phase == CASES[name][1], str(found)
    assert (found.t is None) == (name == "matched")
    assert found.phase in str(found) or name == "matched"


def test_that_a_linear_refit_to_all_frames_stays_and_to_some_frames_is_the_nonlinear_one():
    batch = shoot({}, repeats=50, nuisance=Nuisance(time_zero=0.004))
    best = fit(batch)
    line = linearise_fit(best, batch, SIMULATOR)
    shift = line.to_shift @ line.residual
    to_shift = line.to_shift
    size = len(best.mean)
    sd = to_shift.norm(dim=1)
    assert (
        shift / sd
    ).abs().max() < 0.2  # the noise law's own slope is all that differs from least squares
    assert torch.allclose(sd[:size], torch.linalg.norm(best.chol, dim=1), rtol=0.05)
    early = type(batch)(tuple(e.until(1.5) for e in batch.experiments))
    part = restrict(line, batch.times <= 1.5 + 1e-9)
    to_shift = part.to_shift
    shift = to_shift @ part.residual
    nonlinear = fit(early).mean - best.mean
    assert ((shift[:size] - nonlinear) / to_shift[:size].norm(dim=1)).abs().max() < 0.2
