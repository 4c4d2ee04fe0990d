import pytest

from imr_torch.design import ExpectedInformationGain, Laplace, Plan
from imr_torch.float64 import linspace, tensor, zeros
from imr_torch.gap.hypotheses import Hypothesis
from imr_torch.gap.identity_design import remaining_causes
from imr_torch.material import LIBRARY, Belief
from tests.gap.synthetic import BASE, DESIGNS, SIMULATOR, fit, fit_alike, shoot
from tests.refusals import refused

PLAN = Plan(times=linspace(0.0, 2.0, 31))


def test_that_a_cause_of_the_measurement_is_told_apart_too():
    """A clock that is late changes what the camera sees and not the bubble."""
    batch = shoot({}, DESIGNS[:1], repeats=5)
    null = fit(batch)
    late = fit(batch, Hypothesis(BASE, (LIBRARY["trigger_offset"],)), trigger_offset=0.001)
    mean = late.posterior.mean.clone()
    mean[late.prior.names.index("trigger_offset")] = 4.0
    belief = Belief(
        (null.posterior, late.posterior.with_gaussian(mean, late.posterior.chol)),
        zeros(2),
    )
    acquisition = ExpectedInformationGain(
        belief, SIMULATOR, Laplace(draws=8), target="model", plan=PLAN
    )
    gain = acquisition.estimate(tensor([DESIGNS[0]]))
    assert gain.value > 0.6
    assert gain.parameters == 0.0


def test_that_causes_of_one_family_and_improbable_ones_are_not_compared():
    one = fit_alike(repeats=1)["damage"]
    every = dict.fromkeys(
        ("none", "residual_velocity", "trigger_offset", "damage", "wall"), one
    )
    posterior = {
        "none": 0.1,
        "residual_velocity": 0.3,
        "trigger_offset": 0.25,
        "damage": 0.2,
        "wall": 0.001,
        "other": 0.1,
    }
    causes = remaining_causes(every, posterior)
    assert list(causes) == ["residual_velocity", "damage", "none"]
    assert sum(causes.values()) == pytest.approx(1.0)
    assert causes["residual_velocity"] == pytest.approx(0.5)
    with refused("or more are damage; two of"):
        remaining_causes(every, {"damage": 0.98, "wall": 0.01, "other": 0.01})
    with refused("two of different families"):
        remaining_causes({"damage": one}, posterior)
