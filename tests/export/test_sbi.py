"""The contract of sbi, checked without it: shapes, dtypes, a prior that agrees with itself, NaN for
what failed.
"""

import pytest
import torch
from torch.distributions import Distribution
from torch.testing import assert_close

from imr_torch import float64
from imr_torch.errors import ShapeError
from imr_torch.export import ModelPrior, sbi_simulator
from imr_torch.material import Belief, LogNormal, TruncatedNormal, reference_case
from imr_torch.observe import Noise, Nuisance
from tests.linear import CORRELATED, MEANS, NHKV, NOISE, SDS, LinearSimulator, tensor

DESIGNS = tensor([300.0, 0.2], [700.0, 0.25])
TIMES = float64.linspace(0.1, 2.0, 9)
MIDDLE = tensor([MEANS["G"], MEANS["mu"]])
PART = reference_case("stiff-pa").prior["gen_qkv"]


def pair(simulator=None, **options):
    return sbi_simulator(
        NHKV["nhkv"], simulator or LinearSimulator(), DESIGNS, TIMES, seed=0, **options
    )


def test_that_shapes_and_dtypes_are_those_of_the_contract():
    given, simulate = pair()
    assert isinstance(given, Distribution)
    assert given.event_shape == (2,)
    assert given.batch_shape == ()
    theta = given.sample((5,))
    assert theta.shape == (5, 2)
    assert given.sample().shape == (2,)
    assert given.sample(torch.Size([3, 4])).shape == (3, 4, 2)
    density = given.log_prob(theta)
    x = simulate(theta)
    assert density.shape == (5,)
    assert x.shape == (5, 18)
    assert {
        theta.dtype,
        density.dtype,
        x.dtype,
        given.mean.dtype,
        given.variance.dtype,
    } == {torch.float32}
    assert simulate(theta[0]).shape == (18,)
    assert torch.isfinite(x).all()


def test_that_samples_follow_the_density_and_its_moments():
    """Of draws of the prior, ``E[1/p]`` over a box inside the support is the volume of the box."""
    given = ModelPrior(PART)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        theta = given.sample((40_000,))
    assert_close(theta.mean(0), given.mean, rtol=0.02, atol=0.0)
    assert_close(theta.var(0), given.variance, rtol=0.05, atol=0.0)
    low, high = (PART.quantile([level])[0] for level in (0.3, 0.7))
    inside = ((theta > low) & (theta < high)).all(1)
    volume = torch.where(inside, (-given.log_prob(theta)).exp(), 0.0).mean()
    assert volume / (high - low).prod() == pytest.approx(1.0, abs=0.08)


def test_that_the_support_is_where_the_density_is():
    part = Belief.prior(
        {"nhkv": {"G": TruncatedNormal(1e4, 3e3, 0.0, 2e4), "mu": LogNormal(0.1, 2.0)}}
    )["nhkv"]
    given = ModelPrior(part)
    theta = tensor([5e3, 0.1], [-1.0, 0.1], [2.1e4, 0.1], [5e3, -0.1])
    assert given.support.check(theta).tolist() == [True, False, False, False]
    assert torch.isfinite(given.log_prob(theta)).tolist() == [True, False, False, False]
    free = float64.randn(6, 2, generator=torch.Generator().manual_seed(0))
    # how sbi's samplers keep inside
    to_support = torch.distributions.biject_to(given.support)
    inside = to_support(free)
    assert given.support.check(inside).all()
    assert_close(to_support.inv(inside), free)
    unbounded = ModelPrior(NHKV["nhkv"])
    assert unbounded.support.check(tensor([-1e9, 1e9])).tolist() == [True]


def test_that_curves_are_the_simulators_with_the_stated_noise():
    given, simulate = pair(noise=NOISE)
    theta = tensor([MEANS["G"] + SDS["G"], MEANS["mu"]]).expand(4000, 2)
    parameters = given.belief.parameters(given.belief.to_controls(theta[:1]))
    clean = torch.cat(
        [LinearSimulator()(parameters[0], design, TIMES).radius for design in DESIGNS]
    )
    x = simulate(theta).double()
    assert_close(x.mean(0), clean, rtol=0.0, atol=5.0 * 0.05 / 4000**0.5)
    assert_close(x.std(0), float64.full((18,), 0.05), rtol=0.06, atol=0.0)


def test_that_noise_is_correlated_within_a_curve_and_nuisances_move_whole_curves():
    _, simulate = pair(noise=CORRELATED)
    theta = MIDDLE.expand(4000, 2)
    correlation = torch.corrcoef(simulate(theta).mT)
    gap = float(TIMES[1] - TIMES[0])
    assert correlation[0, 1] == pytest.approx(
        torch.exp(tensor(-gap / 0.3)[0]).item(), abs=0.05
    )
    assert abs(correlation[0, 9]) < 0.06  # another design
    _, simulate = pair(
        noise=Noise(floor=1e-6, slope=0.0, drift=0.0),
        nuisance=Nuisance(time_zero=0.1),
    )
    assert_close(
        simulate(theta).double().std(0), float64.full((18,), 0.03), rtol=0.05, atol=0.0
    )


def test_that_a_failed_solve_is_a_row_of_nan_and_leaves_the_others():
    _, simulate = pair(LinearSimulator(limit={"G": MEANS["G"]}))
    x = simulate(tensor([MEANS["G"] - 1.0, 0.1], [MEANS["G"] + 1.0, 0.1]))
    assert torch.isnan(x).all(1).tolist() == [False, True]
    assert not torch.isnan(x[0]).any()


def test_that_simulations_depend_on_the_seed_and_go_on_from_call_to_call():
    theta = MIDDLE.expand(3, 2)
    (_, one), (_, same) = pair(), pair()
    first = one(theta)
    second = one(theta)
    assert torch.equal(first, same(theta))
    assert not torch.equal(first, second)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda: pair()[1](torch.zeros(3, 5)),
            ShapeError,
            r"theta has shape \(3, 5\); expected n x 2 with \('G', 'mu'\)",
        ),
        (
            lambda: sbi_simulator(PART, LinearSimulator(), DESIGNS[0], TIMES, seed=0),
            ShapeError,
            r"expected q x 2",
        ),
        (
            lambda: ModelPrior(PART).expand((3,)),
            ShapeError,
            r"cannot be expanded to the batch shape \(3,\)",
        ),
    ],
)
def test_that_bad_input_is_named(call, error, message):
    with pytest.raises(error, match=message):
        call()
