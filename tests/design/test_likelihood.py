"""The planned likelihood is the one that the assimilation will use, and the sensitivities are those of the bubbles."""

import pytest
import torch

from benchmarks.nested import log_likelihood, pairwise_log_likelihood
from imr_torch.design import Plan
from imr_torch.design.likelihood import Data, observe_gels
from imr_torch.design.response import Shot, radii, simulate_response
from imr_torch.material import reference_case
from imr_torch.observe import Experiment, ExperimentBatch, Noise, Nuisance, displaced
from imr_torch.simulate import PolytropicSimulator, Stepping

PRIOR = reference_case("stiff-pa").prior
PART = PRIOR["gen_qkv"]
DESIGNS = torch.tensor([[300.0, 0.2], [800.0, 0.28]], dtype=torch.float64)
TIMES = torch.linspace(0.0, 2.4, 31, dtype=torch.float64)
SIMULATOR = PolytropicSimulator(stepping=Stepping(0.25))
CONTROLS = torch.tensor([[0.3, -0.5, 0.4], [0.0, 0.8, -0.2]], dtype=torch.float64)


def shot(plan):
    return Shot(PRIOR, DESIGNS, SIMULATOR, plan)


@pytest.mark.parametrize(
    "noise", [Noise(), Noise(scale=2.0, correlation_time=0.15)], ids=["independent", "correlated"]
)
def test_log_likelihood_ratios_of_gels_are_those_of_the_assimilation(noise):
    plan = Plan(times=TIMES, noise=noise)
    seen = simulate_response(shot(plan), PART, CONTROLS, gel=False)
    data = observe_gels(seen, plan, torch.Generator().manual_seed(0))
    mine = pairwise_log_likelihood(data, seen, plan)
    for n in range(2):
        experiments = []
        for e, design in enumerate(DESIGNS.tolist()):
            kept = data.window[n, e]
            experiments.append(
                Experiment(
                    f"{e}", (design[0], design[1]), TIMES[kept], data.radius[n, e, kept][None]
                )
            )
        batch = ExperimentBatch(tuple(experiments), noise)
        width = batch.times.shape[1]
        theirs = batch.log_likelihood(
            torch.nn.functional.pad(seen.radius, (0, max(0, width - 31)))[..., :width]
        ).sum(-1)
        assert float(mine[n, 0] - mine[n, 1]) == pytest.approx(
            float(theirs[0] - theirs[1]), rel=1e-9
        )


def test_frames_outside_the_window_do_not_count():
    plan = Plan(times=TIMES, noise=Noise(correlation_time=0.1))
    seen = simulate_response(shot(plan), PART, CONTROLS, gel=False)
    data = observe_gels(seen, plan, torch.Generator().manual_seed(0))
    assert not bool(data.window.all())
    spoilt = Data(torch.where(data.window, data.radius, 99.0), data.window)
    assert torch.equal(
        log_likelihood(spoilt, seen.radius, seen.by_nuisance, plan),
        pairwise_log_likelihood(data, seen, plan).diagonal(),
    )


def test_data_scatter_about_their_gel_as_the_plan_says():
    plan = Plan(times=TIMES, repeats=4, noise=Noise(correlation_time=0.1))
    seen = simulate_response(shot(plan), PART, CONTROLS[:1].expand(4000, -1)[:1], gel=False)[
        torch.zeros(4000, dtype=torch.long)
    ]
    data = observe_gels(seen, plan, torch.Generator().manual_seed(0))
    standard = (data.radius - seen.radius) / plan.noise.sd(seen.radius, TIMES) * 2.0
    covariance = torch.cov(standard[:, 0].mT)
    assert torch.allclose(covariance.diagonal(), torch.ones(31).double(), atol=0.12)
    assert float(covariance.diagonal(1).mean()) == pytest.approx(
        float(torch.exp(-(TIMES[1] - TIMES[0]) / 0.1)), abs=0.03
    )


def test_sensitivities_are_the_derivatives_of_what_is_seen():
    nuisance = Nuisance(max_radius=0.02, time_zero=0.01, rest_radius=0.03)
    plan = Plan(times=TIMES, nuisance=nuisance)
    seen = simulate_response(shot(plan), PART, CONTROLS)
    step = 1e-3
    for i in range(3):
        side = torch.zeros(3, dtype=torch.float64)
        side[i] = step
        up, down = (radii(shot(plan), PART, CONTROLS + s * side) for s in (1.0, -1.0))
        difference = (up - down) / (2.0 * step)
        assert float((seen.by_gel[..., i] - difference).abs().max()) < 0.02 * float(
            difference.abs().max()
        )
        curves = []
        for sign in (1.0, -1.0):
            shift = sign * 0.01 * nuisance.sds() * torch.eye(3, dtype=torch.float64)[i]
            true, times, factor = displaced(DESIGNS, TIMES.expand(2, -1), shift.expand(2, 3))
            curves.append(
                SIMULATOR(
                    PART.parameters(PART.mean + CONTROLS @ PART.chol.mT)[:, None], true, times
                ).radius
                * factor
            )
        difference = (curves[0] - curves[1]) / 0.02
        assert float((seen.by_nuisance[..., i] - difference).abs().max()) < 0.02 * float(
            difference.abs().max()
        )
