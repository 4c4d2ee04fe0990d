"""Each marginal against SciPy's distribution of the same name, out to eight standard deviations on both sides."""

import math
from dataclasses import dataclass

import mpmath
import pytest
import torch
from scipy import stats
from torch import Tensor
from torch.testing import assert_close

from imr_torch.float64 import linspace, tensor
from imr_torch.material import LogNormal, Marginal, TruncatedNormal
from imr_torch.material.marginals import MARGINALS, marginal_from_dict, marginal_to_dict
from tests.refusals import refusals
from tests.tables import for_each

INF = math.inf


@dataclass(frozen=True)
class Case:
    marginal: Marginal
    law: object  # frozen SciPy distribution


def truncated(mean: float, sd: float, lower: float = -INF, upper: float = INF) -> Case:
    law = stats.truncnorm((lower - mean) / sd, (upper - mean) / sd, loc=mean, scale=sd)
    return Case(TruncatedNormal(mean, sd, lower, upper), law)


CASES = {
    "unbounded": truncated(0.3, 2.0),
    "published G": truncated(15090.0, 4350.0, 0.0),
    "half normal": truncated(0.0, 0.5, 0.0),
    "mean below the bound": truncated(-1.0, 0.5, 0.0),
    "two-sided": truncated(1.0, 2.0, -0.5, 1.2),
    "from above": truncated(2.0, 1.0, -INF, 1.5),
    "narrow": truncated(0.0, 1.0, 0.1, 0.1001),
    "wide log-normal": Case(LogNormal(5e3, 5.0), stats.lognorm(math.log(5.0), scale=5e3)),
    "narrow log-normal": Case(
        LogNormal(0.1, 1.05), stats.lognorm(math.log(1.05), scale=0.1)
    ),
}
ALL = for_each("case", CASES)
TAILS = [-8.0, -6.5, -5.0, -3.0, -1.0, -1e-3, 0.0, 1e-3, 1.0, 3.0, 5.0, 6.5, 8.0]


def controls(values: list[float] = TAILS) -> Tensor:
    return tensor(values)


def quantile(marginal: Marginal, z: float) -> float:
    """The value of the same probability as ``z`` by its closed form with 80 digits (SciPy's own tail is short of them)."""
    mpmath.mp.dps = 80
    if isinstance(marginal, LogNormal):
        return float(
            mpmath.mpf(marginal.median) * mpmath.exp(mpmath.log(marginal.factor) * z)
        )
    ends = [
        (mpmath.mpf(bound) - marginal.mean) / marginal.sd
        for bound in (marginal.lower, marginal.upper)
    ]
    below, top = (mpmath.ncdf(end) for end in ends)
    p = below + (top - below) * mpmath.ncdf(z)
    return float(marginal.mean + marginal.sd * mpmath.sqrt(2) * mpmath.erfinv(2 * p - 1))


def scale(case: Case) -> float:
    """What rounding is relative to: values next to a bound at zero are differences of numbers of
    this size.
    """
    marginal = case.marginal
    return (
        max(abs(marginal.mean), marginal.sd)
        if isinstance(marginal, TruncatedNormal)
        else 0.0
    )


def test_that_every_kind_of_marginal_is_tested():
    assert {type(case.marginal) for case in CASES.values()} == set(MARGINALS.values())


@ALL
def test_that_a_control_is_the_quantile_of_its_probability(case):
    expected = controls([quantile(case.marginal, z) for z in TAILS])
    assert_close(
        case.marginal.to_physical(controls()),
        expected,
        rtol=1e-12,
        atol=1e-13 * scale(case),
    )


@ALL
def test_that_the_map_is_undone_by_its_inverse(case):
    """Where the value itself resolves the control: next to a bound at 8 sd the last bits of the
    value are the limit.
    """
    z = linspace(-5.0, 5.0, 201)
    value = case.marginal.to_physical(z)
    resolution = (
        1e-15 * (value.abs() + scale(case)) * torch.exp(-case.marginal.log_slope(z))
    )
    back = case.marginal.to_control(value)
    assert ((back - z).abs() < 1e-10 + 10.0 * resolution).all()


@ALL
def test_that_the_density_is_scipys(case):
    """``log p(theta) = log phi(z) - log |d theta/d z|`` is the whole law, normalisation included."""
    z = linspace(-6.0, 6.0, 49)
    value = case.marginal.to_physical(z)
    density = -0.5 * z.square() - 0.5 * math.log(2.0 * math.pi) - case.marginal.log_slope(z)
    assert_close(
        density, torch.tensor(case.law.logpdf(value.numpy())), rtol=1e-9, atol=1e-9
    )


@ALL
def test_that_a_map_increases_and_stays_inside_the_support(case):
    z = linspace(-40.0, 40.0, 801)
    value = case.marginal.to_physical(z)
    lower, upper = case.law.support()
    assert torch.isfinite(value).all()
    assert ((value >= lower) & (value <= upper)).all()
    assert (value.diff() >= 0.0).all()
    assert (value[z.abs() <= 5.0].diff() > 0.0).all()


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("z", [8.0, 15.0, 24.0, 26.0, 36.0, 60.0])
def test_that_an_unbounded_tail_follows_the_exact_law_far_out(sign, z):
    """``P(X > x) = Q(z)`` solved with 60 digits: what remains of the other side's truncation is
    ``Q(x) = kept Q(z)``.
    """
    mpmath.mp.dps = 60
    marginal = (
        TruncatedNormal(0.0, 1.0, lower=-0.5)
        if sign > 0
        else TruncatedNormal(0.0, 1.0, upper=0.5)
    )

    def tail(x: mpmath.mpf) -> mpmath.mpf:
        return mpmath.erfc(x / mpmath.sqrt(2)) / 2

    target = mpmath.log(tail(mpmath.mpf(z))) + mpmath.log(1 - tail(mpmath.mpf("0.5")))
    exact = float(mpmath.findroot(lambda x: mpmath.log(tail(x)) - target, z + 0.01))
    assert marginal.to_physical(controls([sign * z]))[0] == pytest.approx(
        sign * exact, rel=2e-6
    )
    assert marginal.to_control(controls([sign * exact]))[0] == pytest.approx(
        sign * z, rel=2e-6
    )


@pytest.mark.parametrize("distance", [4.0, 6.0, 6.9])
@pytest.mark.parametrize("side", [-1, 1])
def test_that_a_mean_far_outside_the_bounds_keeps_six_digits(distance, side):
    """The mirror image of each other: cut off from below at ``+distance`` and from above at
    ``-distance``.
    """
    marginal = (
        TruncatedNormal(0.0, 1.0, distance, INF)
        if side > 0
        else TruncatedNormal(0.0, 1.0, -INF, -distance)
    )
    z = [-4.0, -2.0, 0.0, 2.0, 4.0]
    expected = controls([quantile(marginal, v) for v in z])
    assert_close(marginal.to_physical(controls(z)), expected, rtol=1e-6, atol=0.0)


@ALL
def test_that_a_marginal_survives_its_dictionary(case):
    assert marginal_from_dict(marginal_to_dict(case.marginal)) == case.marginal


@ALL
def test_that_autograd_follows_the_map(case):
    z = linspace(-4.0, 4.0, 33, requires_grad=True)
    (slope,) = torch.autograd.grad(case.marginal.to_physical(z).sum(), z)
    assert_close(slope, case.marginal.log_slope(z.detach()).exp(), rtol=1e-8, atol=0.0)


test_that_bad_input_is_named = refusals(
    (
        lambda: TruncatedNormal(0.0, 0.0),
        r"sd must be positive and finite. .*belongs in `known`",
    ),
    (
        lambda: TruncatedNormal(-10.0, 1.0, 0.0),
        r"has no mass between 0.0 and inf; move the mean towards the bounds",
    ),
    (lambda: LogNormal(1.0, 1.0), r"a spread needs a factor above 1"),
    (
        lambda: marginal_from_dict({"kind": "Gamma"}),
        r"Unknown prior kind 'Gamma'; known are TruncatedNormal, LogNormal",
    ),
)
