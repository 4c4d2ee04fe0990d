import math

import pytest
import torch

from imr_torch.assimilate import ModelFit
from imr_torch.design import DesignSpace, ExpectedInformationGain, Laplace, Plan
from imr_torch.errors import InputDataError
from imr_torch.gap.held_out import held_out
from imr_torch.gap.hypotheses import Hypothesis
from imr_torch.gap.identity_design import NextDesign, identity_design, remaining_causes
from imr_torch.material import LIBRARY, Belief
from imr_torch.observe import Experiment, ExperimentBatch, predict
from tests.gap.synthetic import BASE, DESIGNS, SIMULATOR, fit, shoot

PLAN = Plan(times=torch.linspace(0.0, 2.0, 31, dtype=torch.float64))
CAUSES = {"strain_stiffening": {"alpha": 0.05}, "damage": {"damage": 0.02}}


@pytest.fixture(scope="module")
def fits() -> dict[str, ModelFit]:
    batch = shoot({"alpha": 0.05}, DESIGNS[:1], repeats=1, end=2.0)
    return {
        name: fit(batch, Hypothesis(BASE, (LIBRARY[name],)), **start)
        for name, start in CAUSES.items()
    }


@pytest.fixture(scope="module")
def found(fits) -> NextDesign:
    return identity_design(
        fits, dict.fromkeys(fits, 0.5), SIMULATOR, seed=0, plan=PLAN, designs=4, draws=8
    )


def separation(fits: dict[str, ModelFit], design: list[float]) -> float:
    """Squared predictive residual of one cause, its parameters free within its posterior, on the other's curve; no noise."""
    times = PLAN.times
    plan = ExperimentBatch(
        (
            Experiment(
                "plan",
                (design[0], design[1]),
                times,
                torch.ones(1, len(times), dtype=torch.float64),
            ),
        )
    )
    total = 0.0
    for own, other in (("strain_stiffening", "damage"), ("damage", "strain_stiffening")):
        curve = predict(SIMULATOR, fits[own].parameters(fits[own].mean)[None], plan)[0]
        shot = ExperimentBatch((Experiment("own", (design[0], design[1]), plan.times[0], curve),))
        found = held_out(fits[other], Hypothesis(BASE, (LIBRARY[other],)), shot, SIMULATOR)
        spread = torch.cat((found.by_gel @ fits[other].chol, found.by_nuisance), 1)
        covariance = torch.eye(len(spread), dtype=torch.float64) + spread @ spread.mT
        total += float(found.residual @ torch.linalg.solve(covariance, found.residual))
    return total


def test_that_the_best_design_separates_the_causes_further_than_a_poor_one(
    fits, found: NextDesign
) -> None:
    assert separation(fits, found.design.tolist()) > 1.1 * separation(fits, [100.0, 0.3])


def test_that_the_gain_lies_between_nothing_and_the_entropy_of_the_causes(
    found: NextDesign,
) -> None:
    assert found.entropy == pytest.approx(math.log(2.0))
    assert 0.0 < found.gain < found.entropy + 3.0 * found.error
    assert found.error >= 0.0
    DesignSpace().check_inside(found.design)


def test_that_a_cause_of_the_measurement_is_told_apart_too(fits) -> None:
    """A clock that is late changes what the camera sees and not the bubble."""
    batch = shoot({}, DESIGNS[:1], repeats=5)
    null = fit(batch)
    late = fit(batch, Hypothesis(BASE, (LIBRARY["trigger_offset"],)), trigger_offset=0.001)
    mean = late.posterior.mean.clone()
    mean[late.prior.names.index("trigger_offset")] = 4.0
    belief = Belief(
        (null.posterior, late.posterior.with_gaussian(mean, late.posterior.chol)),
        torch.zeros(2, dtype=torch.float64),
    )
    acquisition = ExpectedInformationGain(
        belief, SIMULATOR, Laplace(draws=8), target="model", plan=PLAN
    )
    gain = acquisition.estimate(torch.tensor([DESIGNS[0]]).double())
    assert gain.value > 0.6
    assert gain.parameters == 0.0


def test_that_causes_of_one_family_and_improbable_ones_are_not_compared(fits) -> None:
    one = fits["damage"]
    every = dict.fromkeys(("none", "residual_velocity", "trigger_offset", "damage", "wall"), one)
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
    with pytest.raises(InputDataError, match="or more are damage; two of"):
        remaining_causes(every, {"damage": 0.98, "wall": 0.01, "other": 0.01})
    with pytest.raises(InputDataError, match="two of different families"):
        remaining_causes({"damage": one}, posterior)
