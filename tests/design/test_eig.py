"""The information gain against closed forms: a linear camera of Gaussian parameters, where everything is known exactly."""

import math
from dataclasses import dataclass, field

import pytest
import torch
from botorch.optim import optimize_acqf
from torch import Tensor
from torch.distributions import MultivariateNormal

from imr_torch.design import DesignSpace, ExpectedInformationGain, Plan, expected_information_gain
from imr_torch.errors import InputDataError
from imr_torch.material import Belief, TruncatedNormal, reference_case
from imr_torch.observe import Noise, Nuisance
from imr_torch.simulate import Conditions, PolytropicSimulator, Solution, broadcast_batch

SIGMA = 0.05
TIMES = torch.linspace(0.1, 2.0, 7, dtype=torch.float64)


@dataclass(frozen=True)
class LinearSimulator:
    """``R = 1 + slope t + B(t, design) (G, mu, alpha)``."""

    slope: float = 0.0
    fail_below: float = -math.inf
    conditions: Conditions = field(default_factory=Conditions)

    def columns(self, designs: Tensor, times: Tensor) -> Tensor:
        weber, rest = designs[..., :1] / 500.0, designs[..., 1:]
        return torch.stack((torch.sin(weber * times), torch.cos(3.0 * rest * times), rest * times * 2.0), dim=-1)

    def __call__(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Solution:
        shape, parameters, designs, times = broadcast_batch(parameters, designs, times)
        radius = 1.0 + self.slope * times + (self.columns(designs, times) @ parameters[..., :3, None])[..., 0]
        radius = torch.where(parameters[:, :1] < self.fail_below, torch.nan, radius)
        radius = radius.reshape(*shape, -1)
        zero = torch.zeros(shape, dtype=torch.long)
        return Solution(times.reshape(*shape, -1), radius, radius, radius, zero, zero)


def normal(sd: float) -> TruncatedNormal:
    return TruncatedNormal(0.0, sd)


ONE = Belief.prior({"gen_qkv": {"G": normal(0.3), "mu": normal(0.2), "alpha": normal(0.5)}})
TWO = Belief.prior(
    {
        "nhkv": {"G": normal(0.1), "mu": normal(0.1)},
        "gen_qkv": {"G": normal(0.1), "mu": normal(0.1), "alpha": normal(0.8)},
    },
    probabilities={"nhkv": 0.7, "gen_qkv": 0.3},
)
SDS = {"nhkv": [0.1, 0.1, 0.0], "gen_qkv": [0.1, 0.1, 0.8]}
DESIGNS = torch.tensor([[300.0, 0.2], [800.0, 0.28]], dtype=torch.float64)


def sensitivity(designs: Tensor, sds: list[float]) -> Tensor:
    columns = LinearSimulator().columns(designs, TIMES.expand(len(designs), -1)).flatten(0, 1)
    return columns * torch.tensor(sds, dtype=torch.float64)


def plan(**changes) -> Plan:
    return Plan(times=TIMES, **{"noise": Noise(slope=0.0, drift=0.0, floor=SIGMA), **changes})


@pytest.mark.parametrize("q", [1, 2])
@pytest.mark.parametrize("repeats", [1, 100])
def test_gain_about_parameters_is_the_closed_form(q, repeats):
    gain = expected_information_gain(ONE, DESIGNS[:q], LinearSimulator(), plan(repeats=repeats), draws=8, seed=0)
    J = sensitivity(DESIGNS[:q], [0.3, 0.2, 0.5]) * math.sqrt(repeats) / SIGMA
    exact = 0.5 * torch.linalg.slogdet(torch.eye(3, dtype=torch.float64) + J.mT @ J).logabsdet
    assert gain.value == pytest.approx(float(exact), rel=1e-8)
    assert gain.model == 0.0
    assert gain.counted == gain.drawn == 8


def test_gain_is_not_bounded_by_the_number_of_draws():
    precise = plan(repeats=10**8)
    gain = expected_information_gain(ONE, DESIGNS[:1], LinearSimulator(), precise, draws=8, seed=0)
    assert gain.value > 5 * math.log(8)


def test_correlated_noise_enters_as_its_covariance():
    noise = Noise(slope=0.0, drift=0.0, floor=SIGMA, correlation_time=0.5)
    gain = expected_information_gain(ONE, DESIGNS[:1], LinearSimulator(), plan(noise=noise), draws=4, seed=0)
    gap = (TIMES[:, None] - TIMES).abs()
    C = SIGMA**2 * torch.exp(-gap / 0.5)
    J = sensitivity(DESIGNS[:1], [0.3, 0.2, 0.5])
    exact = 0.5 * torch.linalg.slogdet(torch.eye(3, dtype=torch.float64) + J.mT @ torch.linalg.solve(C, J)).logabsdet
    assert gain.value == pytest.approx(float(exact), rel=1e-8)


def test_an_unknown_time_zero_costs_what_its_covariance_says():
    slope, sd = -0.4, 0.1
    camera = LinearSimulator(slope=slope)
    belief = Belief.prior({"newtonian": {"mu": normal(0.2)}})
    uncertain = plan(nuisance=Nuisance(time_zero=sd))
    rest = torch.tensor([[300.0, 1e-6]], dtype=torch.float64)  # cos(0) = 1: the sensitivity does not depend on time
    gain = expected_information_gain(belief, rest, camera, uncertain, draws=4, seed=0)
    C = SIGMA**2 * torch.eye(7, dtype=torch.float64) + (slope * sd) ** 2
    J = torch.full((7, 1), 0.2, dtype=torch.float64)
    exact = 0.5 * torch.log(1.0 + J.mT @ torch.linalg.solve(C, J))
    assert gain.value == pytest.approx(float(exact), rel=1e-5)


def test_gain_about_the_model_is_the_mutual_information_within_its_error():
    draws = 400
    gain = expected_information_gain(TWO, DESIGNS[:1], LinearSimulator(), plan(), draws=draws, seed=1)
    generator = torch.Generator().manual_seed(5)
    laws = []
    for key in TWO.keys:
        J = sensitivity(DESIGNS[:1], SDS[key])
        laws.append(MultivariateNormal(torch.zeros(7, dtype=torch.float64), J @ J.mT + SIGMA**2 * torch.eye(7)))
    weights, exact = TWO.log_probabilities.exp(), 0.0
    for i, law in enumerate(laws):
        y = torch.randn(20000, 7, generator=generator, dtype=torch.float64) @ law.scale_tril.mT
        logs = torch.stack([other.log_prob(y) for other in laws])
        exact += float(weights[i] * (logs[i] - torch.logsumexp(logs + TWO.log_probabilities[:, None], 0)).mean())
    assert 0.02 < exact < 0.6
    assert abs(gain.model - exact) < 4.0 * math.sqrt(gain.variance) + 0.005
    assert gain.variance < 0.01


def test_the_stated_variance_is_the_scatter_over_seeds():
    values = [expected_information_gain(TWO, DESIGNS[:1], LinearSimulator(), plan(), draws=16, seed=s) for s in range(60)]
    scatter = torch.tensor([v.value for v in values]).var()
    stated = torch.tensor([v.variance for v in values]).mean()
    assert 0.5 < float(scatter / stated) < 2.0


def test_failed_bubbles_are_counted_and_too_many_make_the_estimate_void():
    some = expected_information_gain(ONE, DESIGNS[:1], LinearSimulator(fail_below=-0.3), plan(), draws=64, seed=0)
    assert 32 < some.counted < 64
    assert math.isfinite(some.value)
    most = expected_information_gain(ONE, DESIGNS[:1], LinearSimulator(fail_below=0.2), plan(), draws=64, seed=0)
    assert most.counted < 32
    assert math.isnan(most.value)


def test_two_bubbles_together_tell_less_than_the_sum_and_more_than_each():
    both = expected_information_gain(ONE, DESIGNS, LinearSimulator(), plan(), draws=4, seed=0).value
    each = [expected_information_gain(ONE, d[None], LinearSimulator(), plan(), draws=4, seed=0).value for d in DESIGNS]
    assert max(each) < both < sum(each)


def test_it_is_a_botorch_acquisition():
    acquisition = ExpectedInformationGain(ONE, LinearSimulator(), plan=plan(), draws=4)
    X = DESIGNS[:, None]
    values = acquisition(X)
    assert values.shape == (2,)
    assert float(values[0]) == acquisition.estimate(DESIGNS[:1]).value
    best, value = optimize_acqf(
        acquisition, acquisition.space.bounds, q=1, num_restarts=1, raw_samples=8, options={"with_grad": False, "maxiter": 5}
    )
    assert best.shape == (1, 2)
    assert float(value) >= float(values.max()) - 0.2


def test_the_estimate_is_a_function_of_its_seed():
    space = DesignSpace()
    acquisition = ExpectedInformationGain(
        reference_case("soft-pa").prior, PolytropicSimulator(), plan=plan(), space=space, draws=4, seed=3
    )
    design = torch.tensor([[400.0, 0.2]], dtype=torch.float64)
    first = acquisition.estimate(design)
    torch.manual_seed(99)
    assert acquisition.estimate(design) == first
    acquisition.seed = 4
    assert acquisition.estimate(design) != first


def test_one_draw_is_refused_because_it_has_no_error():
    with pytest.raises(InputDataError, match="at least 2 are needed for an error estimate"):
        ExpectedInformationGain(ONE, LinearSimulator(), draws=1)
