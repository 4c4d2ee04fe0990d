"""The planned likelihood is the one that the assimilation will use, and the sensitivities are those of the bubbles."""

import pytest
import torch

from imr_torch.design import Plan
from imr_torch.design.likelihood import observe_gels
from imr_torch.design.response import Shot, radii, simulate_response
from imr_torch.float64 import eye, linspace, ones, tensor, zeros
from imr_torch.material import reference_case
from imr_torch.observe import Noise, Nuisance, displaced
from imr_torch.random import generator
from imr_torch.simulate import PolytropicSimulator, Stepping

PRIOR = reference_case("stiff-pa").prior
PART = PRIOR["gen_qkv"]
DESIGNS = tensor([[300.0, 0.2], [800.0, 0.28]])
TIMES = linspace(0.0, 2.4, 31)
SIMULATOR = PolytropicSimulator(stepping=Stepping(0.25))
CONTROLS = tensor([[0.3, -0.5, 0.4], [0.0, 0.8, -0.2]])


def shot(plan):
    return Shot(PRIOR, DESIGNS, SIMULATOR, plan)


def test_data_scatter_about_their_gel_as_the_plan_says():
    plan = Plan(times=TIMES, repeats=4, noise=Noise(correlation_time=0.1))
    seen = simulate_response(
        shot(plan), PART, CONTROLS[:1].expand(4000, -1)[:1], gel=False
    )[torch.zeros(4000, dtype=torch.long)]
    data = observe_gels(seen, plan, generator(0))
    standard = (data.radius - seen.radius) / plan.noise.sd(seen.radius, TIMES) * 2.0
    covariance = torch.cov(standard[:, 0].mT)
    assert torch.allclose(covariance.diagonal(), ones(31), atol=0.12)
    assert covariance.diagonal(1).mean() == pytest.approx(
        float(torch.exp(-(TIMES[1] - TIMES[0]) / 0.1)), abs=0.03
    )


def test_sensitivities_are_the_derivatives_of_what_is_seen():
    nuisance = Nuisance(max_radius=0.02, time_zero=0.01, rest_radius=0.03)
    plan = Plan(times=TIMES, nuisance=nuisance)
    seen = simulate_response(shot(plan), PART, CONTROLS)
    step = 1e-3
    for i in range(3):
        side = zeros(3)
        side[i] = step
        up, down = (radii(shot(plan), PART, CONTROLS + s * side) for s in (1.0, -1.0))
        difference = (up - down) / (2.0 * step)
        assert (
            seen.by_gel[..., i] - difference
        ).abs().max() < 0.02 * difference.abs().max()
        curves = []
        for sign in (1.0, -1.0):
            shift = sign * 0.01 * nuisance.sds() * eye(3)[i]
            true, times, factor = displaced(
                DESIGNS, TIMES.expand(2, -1), shift.expand(2, 3)
            )
            curves.append(
                SIMULATOR(
                    PART.parameters(PART.mean + CONTROLS @ PART.chol.mT)[:, None],
                    true,
                    times,
                ).radius
                * factor
            )
        difference = (curves[0] - curves[1]) / 0.02
        assert (
            seen.by_nuisance[..., i] - difference
        ).abs().max() < 0.02 * difference.abs().max()
