"""Information about median and scatter of a population: closed forms with a linear simulator, and
nested Monte Carlo.
"""

import math

import pytest
import torch
from torch import Tensor

from imr_torch.design import (
    ExpectedInformationGain,
    Plan,
    PopulationInformation,
    expected_information_gain,
)
from imr_torch.errors import InputDataError
from imr_torch.material import PARAMETERS, ModelBelief
from imr_torch.random import generator
from tests.linear import NOISE, SDS, LinearSimulator, prior, tensor

SIMULATOR = LinearSimulator(limit={"G": 1e9})
PLAN = Plan(
    times=torch.linspace(0.1, 2.0, 12, dtype=torch.float64), repeats=2, noise=NOISE, collapses=None
)
BELIEF = prior(("nhkv",), correlated=True)
PART: ModelBelief = BELIEF["nhkv"]
DESIGNS = torch.tensor([[300.0, 0.2], [650.0, 0.25]], dtype=torch.float64)
SCATTER = tensor(0.3, 0.15)


def jacobian(design: Tensor) -> Tensor:
    """Of the mean curve in units of its noise, to the controls."""
    slopes = SIMULATOR.columns(len(PLAN.times), design[0])[
        :, PARAMETERS.index(PART.names)
    ] * tensor(SDS["G"], SDS["mu"])
    return slopes / NOISE.floor * math.sqrt(PLAN.repeats)


def gain(scatter: Tensor, designs: Tensor = DESIGNS[:1], **sizes: int):
    count = len(scatter)
    estimator = PopulationInformation(
        scatter, PART.mean.expand(count, -1), PART.chol.expand(count, -1, -1), **sizes
    )
    return expected_information_gain(BELIEF, designs, SIMULATOR, PLAN, estimator=estimator, seed=0)


def closed_form(scatter: Tensor, designs: Tensor) -> float:
    """``I(m; y)`` of shots with gels of their own, the scatter known: by the covariance of all
    frames.
    """
    rows = [jacobian(design) for design in designs]
    own = torch.block_diag(
        *(J @ scatter.square().diag() @ J.mT + torch.eye(len(J), dtype=torch.float64) for J in rows)
    )
    spread = torch.cat(rows) @ PART.chol
    return 0.5 * float(torch.logdet(own + spread @ spread.mT) - torch.logdet(own))


@pytest.mark.parametrize("scatter", [SCATTER, 0.0 * SCATTER])
@pytest.mark.parametrize("count", [1, 2])
def test_that_a_known_scatter_gives_the_closed_form(scatter: Tensor, count: int) -> None:
    """The information is the mean over data of a log ratio, so it agrees within its own Monte Carlo error."""
    found = gain(scatter[None], DESIGNS[:count], data=4096)
    expected = closed_form(scatter, DESIGNS[:count])
    assert found.value == pytest.approx(expected, abs=4.0 * found.variance**0.5)
    assert found.variance**0.5 < 0.03
    assert found.model == 0.0


def test_that_the_error_is_that_of_the_data() -> None:
    """All gels of a linear simulator show the same, so only the data, which all gels share, vary."""
    small = gain(SCATTER[None], data=2048)
    large = gain(SCATTER[None], data=32768)
    assert small.variance / large.variance == pytest.approx(16.0, rel=0.25)


def test_that_an_uncertain_scatter_is_informed_as_nested_monte_carlo_says() -> None:
    """Log densities of frames, not of the reduced data, with fresh draws of median, scatter and gel."""
    scatters = tensor(0.05, 0.2, 0.6)[:, None] * tensor(1.0, 0.5)
    J = jacobian(DESIGNS[0])
    source = generator(5)
    count = 50000
    rows = torch.randint(3, (count,), generator=source)
    noise = torch.randn(2, count, 2, generator=source, dtype=torch.float64)
    medians = noise[0] @ PART.chol.mT
    frames = (medians + scatters[rows] * noise[1]) @ J.mT
    frames = frames + torch.randn(frames.shape, generator=source, dtype=torch.float64)
    eye = torch.eye(len(J), dtype=torch.float64)
    own = [J @ s.square().diag() @ J.mT + eye for s in scatters]
    normals = [torch.distributions.MultivariateNormal(torch.zeros(len(J)).double(), c) for c in own]
    whole = [
        torch.distributions.MultivariateNormal(
            torch.zeros(len(J)).double(), c + J @ PART.chol @ PART.chol.mT @ J.mT
        )
        for c in own
    ]
    known = torch.stack([n.log_prob(frames - medians @ J.mT) for n in normals]).gather(
        0, rows[None]
    )[0]
    ratio = (
        known - torch.logsumexp(torch.stack([n.log_prob(frames) for n in whole]), 0) + math.log(3)
    )
    found = gain(scatters, data=30000)
    error = math.hypot(float(ratio.std()) / count**0.5, found.variance**0.5)
    assert found.value == pytest.approx(float(ratio.mean()), abs=4.0 * error)

    assert error < 0.04


def test_that_no_design_tells_more_than_a_shot_without_error() -> None:
    scatter = SCATTER.expand(2, -1)
    estimator = PopulationInformation(
        scatter, PART.mean.expand(2, -1), PART.chol.expand(2, -1, -1), data=2048
    )
    covariance = PART.chol @ PART.chol.mT
    exact = 0.5 * float(
        torch.logdet(covariance + SCATTER.square().diag()) - SCATTER.log().sum() * 2.0
    )
    assert estimator.largest_gain() == pytest.approx(exact, abs=0.15)
    assert 0.5 * exact < closed_form(SCATTER, DESIGNS[:1]) < exact


def test_that_a_pending_shot_leaves_less_to_learn() -> None:
    """Another shot at the same design is of another gel, and tells more of the median, though less than the first."""
    estimator = PopulationInformation(
        SCATTER[None], PART.mean[None], PART.chol[None], draws=4, data=2048
    )
    one = ExpectedInformationGain(BELIEF, SIMULATOR, estimator, plan=PLAN)
    other = ExpectedInformationGain(BELIEF, SIMULATOR, estimator, plan=PLAN, X_pending=DESIGNS[:1])
    with torch.no_grad():
        first, both = (float(acquisition(DESIGNS[None, :1])) for acquisition in (one, other))
    assert 0.1 * first < both - first < 0.8 * first


def test_that_gels_that_fail_are_left_out() -> None:
    broken = LinearSimulator(limit={"G": 5000.0})
    estimator = PopulationInformation(SCATTER[None], PART.mean[None], PART.chol[None], draws=32)
    found = expected_information_gain(
        BELIEF, DESIGNS[:1], broken, PLAN, estimator=estimator, seed=0
    )
    assert found.drawn == 32
    assert 0 < found.counted < 32
    none = expected_information_gain(
        BELIEF, DESIGNS[:1], LinearSimulator(fails=True), PLAN, estimator=estimator, seed=0
    )
    assert none.failed


def test_that_two_models_and_small_samples_are_refused() -> None:
    estimator = PopulationInformation(SCATTER[None], PART.mean[None], PART.chol[None])
    with pytest.raises(InputDataError, match="holds 2"):
        expected_information_gain(
            prior(("newtonian", "nhkv")), DESIGNS[:1], SIMULATOR, PLAN, estimator=estimator, seed=0
        )
    with pytest.raises(InputDataError, match="draws is 1"):
        PopulationInformation(SCATTER[None], PART.mean[None], PART.chol[None], draws=1)
