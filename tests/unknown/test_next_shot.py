"""The next shot where what is missing has no name: predictions of shots that were not made, against
the true curve, and what the chosen shot then says.
"""

from dataclasses import replace

import pytest
import torch
from torch.distributions import MultivariateNormal

from imr_torch.design import Plan
from imr_torch.float64 import eye, linspace, tensor, zeros
from imr_torch.unknown import choose_shot, infer_unknown
from imr_torch.unknown.next_shot import _weigh_outcomes, plan_shot, predict_curve
from tests.gap.synthetic import BASE, DESIGNS, SIMULATOR, UNSURE, fit, shoot

TRUTH = {"alpha": 0.3}
PLAN = Plan(times=linspace(0.0, 3.0, 61), repeats=5, nuisance=UNSURE, collapses=None)


@pytest.fixture(scope="module")
def one_design():
    """A gel that stiffens at one design: a stress of the gel, or a pressure in time?"""
    batch = shoot(TRUTH, DESIGNS[:1], repeats=5, nuisance=UNSURE)
    return infer_unknown(fit(batch), batch, SIMULATOR)


def test_that_a_stress_of_the_gel_carries_over_to_a_design_that_was_not_shot():
    """The true curve there lies within what is predicted, and far from what the base model does."""
    batch = shoot(TRUTH, DESIGNS, repeats=10, nuisance=UNSURE)
    base = fit(batch)
    rival = infer_unknown(base, batch, SIMULATOR).rivals["material"]
    design = (300.0, 0.18)
    true = shoot(TRUTH, (design,), repeats=0).mean[0]
    shot = plan_shot(tensor(design), PLAN, BASE, SIMULATOR)
    still = shot.predict(base.mean, zeros(3), zeros(len(shot.moments)))
    curve = predict_curve(shot, rival, still)
    seen = shot.whiten((true - still)[None], still)[0]
    missed = torch.linalg.solve_triangular(
        curve.scale_tril, (seen - curve.mean)[:, None], upper=False
    )
    assert missed.norm() < 4.0  # without noise: of gel, weights and nuisances alone
    assert seen.norm() > 10.0


def test_that_the_chosen_shot_tells_what_is_missing(one_design):
    """As probable as promised, from data at that design."""
    assert max(one_design.probabilities.values()) < 0.7
    found = choose_shot(one_design, BASE, SIMULATOR, plan=PLAN, seed=0)
    assert found.helps
    assert found.after > 0.9
    designs = (DESIGNS[0], tuple(found.design.tolist()))
    batch = shoot(TRUTH, designs, repeats=5, nuisance=UNSURE)
    assert infer_unknown(fit(batch), batch, SIMULATOR).probabilities["material"] > 0.9


def test_that_one_explanation_needs_no_shot(one_design):
    sure = dict.fromkeys(one_design.probabilities, 0.0) | {"camera": 1.0}
    known = replace(one_design, probabilities=sure, terms={})
    assert choose_shot(known, BASE, SIMULATOR, plan=PLAN, seed=0) is None


@pytest.mark.parametrize("distance", [0.0, 2.0])
def test_that_probabilities_of_two_gaussians_are_those_of_bayes(distance):
    """One frame, equal sizes: the mean of 1 / (1 + exp(-d (d/2 + z))) by quadrature."""
    curves = [MultivariateNormal(tensor([x]), eye(1)) for x in (0.0, distance)]
    own = _weigh_outcomes(curves, {"a": 0.5, "b": 0.5}, 0, draws=20000)
    z = linspace(-8.0, 8.0, 4001)
    density = (-0.5 * z.square()).exp() / (2.0 * torch.pi) ** 0.5
    right = torch.trapezoid(density * torch.sigmoid(distance * (0.5 * distance + z)), z)
    for log in own:
        assert log.exp().mean() == pytest.approx(float(right), abs=0.01)
