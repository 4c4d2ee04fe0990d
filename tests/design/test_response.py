import torch

from imr_torch.design import Plan
from imr_torch.float64 import linspace, tensor
from imr_torch.material import reference_case
from imr_torch.observe import Experiment, collapse_time
from imr_torch.simulate import PolytropicSimulator
from tests.refusals import refusals


def test_the_window_holds_the_frames_that_an_assimilation_would_keep():
    draws = reference_case("stiff-pa").prior.sample(6, seed=0).parameters
    design = tensor([400.0, 0.2])
    plan = Plan()
    radius = PolytropicSimulator()(draws, design, plan.times).radius
    window = plan.frames_in_window(radius[:, None])[:, 0]
    for curve, kept in zip(radius, window, strict=True):
        experiment = Experiment("x", (400.0, 0.2), plan.times, curve[None])
        used = experiment.until(collapse_time(plan.times, curve, 2)).times
        assert torch.equal(plan.times[kept], used)
    assert len({int(row.sum()) for row in window}) > 1


def test_a_curve_without_that_many_collapses_keeps_all_frames():
    plan = Plan(times=linspace(0.0, 1.0, 11))
    assert plan.frames_in_window(torch.cos(plan.times)[None]).all()
    assert Plan(collapses=None).frames_in_window(torch.cos(9.0 * Plan().times)).all()


test_an_impossible_plan_is_refused = refusals(
    (lambda: Plan(repeats=0), "Plan.repeats is 0; expected at least 1"),
    (lambda: Plan(collapses=0), "Plan.collapses is 0; expected at least 1, or None"),
)
