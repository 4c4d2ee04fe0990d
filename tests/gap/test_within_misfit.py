"""Strong effects by single curves whose noise is inferred: named though the base model's misfit
spoils fits and noise, and selected beside slow deviations of each shot.
"""

import math
from dataclasses import replace

import pytest
import torch

from imr_torch.float64 import randn, tensor
from imr_torch.gap import GapReport, to_json
from imr_torch.gap.held_out import held_out, judge_designs
from imr_torch.gap.hypotheses import EXPLAINS, Hypothesis
from imr_torch.gap.shrinkage import shrinkage
from imr_torch.gap.within_misfit import MisfitSelection, weigh_beside_slow
from imr_torch.material import intervals
from imr_torch.observe import Experiment, Noise
from imr_torch.random import generator
from tests.gap.synthetic import BASE, DESIGNS, GEL, SIMULATOR, diagnose_offered, fit, shoot

OFFERED = ("stress_relaxation", "edge_error", "clock")
LAW = Noise(scale=0.3)
STRONG = {"tau": 8e-6}


def single_curves(effect: dict[str, float], deviation: float) -> list[Experiment]:
    """One curve a design, with slow deviations (sd in R* of each of three waves) that differ between
    shots.
    """
    source = generator(0)
    shots = []
    for experiment in shoot(effect, DESIGNS, repeats=0, end=2.5).experiments:
        times = experiment.times
        sizes, phases = randn(2, 3, 1, generator=source)
        waves = tensor([[0.5], [1.0], [1.5]]) * times + phases
        slow = deviation * (sizes * torch.sin(2.0 * math.pi * waves)).sum(0)
        seen = (experiment.radius[0] + slow).clamp_min(0.02)
        shots.append(replace(experiment, radius=LAW.draw(seen, times, 1, generator=source)))
    return shots


def diagnosed(effect: dict[str, float], deviation: float) -> GapReport:
    return diagnose_offered(
        single_curves(effect, deviation), OFFERED, base=BASE, estimate_noise=True
    )


def explained(report: GapReport) -> dict[str, float]:
    return weigh_beside_slow(report.within_misfit.steps[:1], report.batch, SIMULATOR)[1]


@pytest.fixture(scope="module")
def strong():
    return diagnosed(STRONG, 0.0)


def test_that_a_strong_effect_is_named_and_found_as_large_as_it_is(strong):
    assert (strong.verdict, strong.cause) == ("effect", ("stress_relaxation",))
    low, _, high = strong.selected_fit.posterior.quantile(tensor([0.01, 0.5, 0.99]))
    places = [strong.selected_fit.prior.names.index(name) for name in ("G", "mu", "tau")]
    truth = tensor([8e3, 0.08, 8e-6])
    assert ((low[places] < truth) & (truth < high[places])).all()


def test_that_the_noise_is_that_of_the_frames_though_the_base_model_is_far_off(strong):
    curves = torch.cat([e.radius[0] for e in strong.batch.curves])
    times = torch.cat([e.times for e in strong.batch.curves])
    ratio = strong.batch.noise.sd(curves, times) / LAW.sd(curves, times)
    assert 0.75 < ratio.log().mean().exp() < 1.35


@pytest.fixture(scope="module")
def noises():
    """The noise by which each selection of what comes nearest began."""
    return []


@pytest.fixture(scope="module")
def beside(noises):
    begin = MisfitSelection.begin

    def note_noise(inquiry, *rest, **known):
        noises.append(inquiry.batch.noise)
        return begin(inquiry, *rest, **known)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MisfitSelection, "begin", note_noise)
        return diagnosed(STRONG, 0.012)


def test_that_what_comes_nearest_is_selected_anew_with_the_noise_beside_it(beside, noises):
    first, last = noises
    assert last == beside.batch.noise
    radius, times = beside.batch.mean, beside.batch.times
    ratio = last.sd(radius, times) / first.sd(radius, times)
    assert ratio[beside.batch.mask].log().mean().exp() < 0.8


def test_that_it_is_selected_and_not_named_beside_slow_deviations(beside):
    assert (beside.verdict, beside.cause) == ("other", ())
    assert beside.selected.parts == ("stress_relaxation",)
    assert "some of it goes with stress_relaxation" in beside.reason
    nats = explained(beside)
    assert nats.pop("stress_relaxation") > EXPLAINS + max(nats.values())


def test_that_of_fits_that_lead_to_one_point_the_closest_is_kept(beside):
    name = "stress_relaxation"
    step = beside.within_misfit.steps[0]
    hypothesis = step.hypotheses[name]
    close = fit(hypothesis.seen(beside.batch), hypothesis, tau=STRONG["tau"])
    steps = [
        replace(step, fits=step.fits | {name: replace(close, mean=close.mean + shift)})
        for shift in (0.1, 0.0, -0.1, 0.2)
    ]
    kept, explained = weigh_beside_slow(steps, beside.batch, SIMULATOR)
    _, at_close = weigh_beside_slow(steps[1:2], beside.batch, SIMULATOR)
    assert explained[name] >= at_close[name]
    assert torch.equal(kept.fits[name].mean, close.mean)


def test_that_it_predicts_curves_that_were_left_out_and_gives_the_gel_back(beside):
    found = shrinkage(beside, SIMULATOR)
    assert found.share[0] > max(0.5, found.placebo_high)
    shifts = to_json(beside)["parameter_shift"]
    for name, truth in GEL.items():
        low, _, high = shifts[name]["with_cause"]
        assert 0.9 * low < truth < 1.1 * high
        assert abs(shifts[name]["base"][1] / truth - 1.0) > 0.1


@pytest.mark.parametrize("seen", [True, False])
def test_that_curves_are_judged_by_fits_whose_noise_is_not_enlarged(beside, seen):
    enlarged = beside.within_misfit.batch.noise
    assert enlarged.widened > 1.2
    unseen = None if seen else shoot(STRONG, ((300.0, 0.22),), repeats=0, end=2.5)
    judged = judge_designs(beside, SIMULATOR, unseen, seed=0)
    assert len(judged) == (3 if seen else 1)
    for pair in judged:
        noise = pair.training.batch.noise
        assert noise.widened == 1.0
        assert noise == enlarged.of_frames
        assert pair.base.converged
        assert pair.effect.converged
        if not seen:
            base = beside.within_misfit.null
            moved = held_out(base, Hypothesis(BASE), unseen, SIMULATOR)
            own = [x.residual.square().sum() for x in (pair.base, moved)]
            assert own[0] < own[1]


def test_that_the_quoted_fit_is_that_whose_values_stand_in_the_report(strong, beside):
    """The medium is judged by it; where no model is enough the camera's noise makes it far too sure."""
    for report in (strong, beside):
        quoted = intervals(report.quoted[0].posterior)
        assert {n: quoted[n] for n in GEL} == to_json(report)["parameters"]
        assert quoted["G"] != intervals(report.null.posterior)["G"]
    assert beside.quoted[1].noise.widened > 1.0


def test_that_nothing_is_selected_by_slow_deviations_alone():
    alone = diagnosed({}, 0.012)
    assert (alone.verdict, alone.cause) == ("other", ())
    assert alone.selected.parts == ()
    assert "none explains any of it" in alone.reason
    assert max(explained(alone).values()) < EXPLAINS
