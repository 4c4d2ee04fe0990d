"""What a refit leaves of an effect: as a real refit leaves it, and never more than the first order
does.
"""

from dataclasses import replace

import pytest
import torch

from imr_torch.float64 import full
from imr_torch.gap import adequacy
from imr_torch.gap.adequacy import refitted_directions
from imr_torch.goodness.linear import Linearisation, linearise_fit
from imr_torch.goodness.score import effect_directions
from imr_torch.material import LIBRARY, Effect
from imr_torch.observe import Nuisance
from tests.gap.synthetic import SIMULATOR, UNSURE, fit, shoot

REPEATS = 20


def one_start(name: str, value: float) -> Effect:
    """An effect with a single start."""
    return replace(LIBRARY[name], starts=((value,),))


def left_of(effect: Effect, line: Linearisation) -> tuple[float, float]:
    """Sd that the first order leaves of an effect, and the refit."""
    raw = effect_directions([effect], line)
    beside = refitted_directions([effect], line, raw)
    return float(line.project_out(raw[effect.name]).norm()), float(
        line.project_out(beside[effect.name]).norm()
    )


@pytest.fixture(scope="module", params=[Nuisance(), UNSURE], ids=["exact", "nuisances"])
def matched(request):
    """The neighbourhood of the fit of a matched set."""
    batch = shoot({}, repeats=REPEATS, nuisance=request.param)
    return linearise_fit(fit(batch), batch, SIMULATOR)


@pytest.mark.parametrize(
    ("name", "value"), [("heat_exchange", 0.8), ("damage", 0.03), ("sound_speed", 0.3)]
)
def test_that_it_is_what_a_real_refit_leaves(matched, name, value):
    line = matched
    first, beside = left_of(one_start(name, value), line)
    nuisance = line.batch.experiments[0].nuisance
    shot = shoot({name: value}, repeats=REPEATS, nuisance=nuisance)
    refit = fit(shot)
    # the noise of these repeats is that of the matched set, so the difference of residuals is that
    # of the curves
    gap = linearise_fit(refit, shot, SIMULATOR)
    noise = line.project_out(line.residual).norm()
    real = float((gap.residual.square().sum() - noise.square()).clamp_min(0.0).sqrt())
    assert beside == pytest.approx(real, rel=0.2)
    assert first > 1.2 * beside


def test_that_a_small_effect_is_left_as_it_is(matched):
    first, beside = left_of(one_start("gas_loss", 1e-4), matched)
    assert beside == pytest.approx(first, rel=0.02)


def test_that_a_gel_that_cannot_be_simulated_leaves_the_first_order(matched, monkeypatch):
    effect = one_start("heat_exchange", 0.8)
    raw = effect_directions([effect], matched)
    lost = full((1, *matched.batch.times.shape), torch.nan)
    monkeypatch.setattr(adequacy, "predict_changes", lambda *_: lost)
    beside = refitted_directions([effect], matched, raw)
    torch.testing.assert_close(beside["heat_exchange"], raw["heat_exchange"])
    assert refitted_directions([], matched, {}) == {}
