"""Each marginal against SciPy's distribution of the same name, out to eight standard deviations on both sides."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import mpmath
import pytest
import torch
from scipy import stats
from scipy.integrate import quad
from torch import Tensor

from imr_torch.errors import InputDataError
from imr_torch.material import LogNormal, Marginal, Quantile, TruncatedNormal
from imr_torch.material.marginals import MARGINALS, marginal_from_dict, marginal_to_dict, ndtr

INF = math.inf


@dataclass(frozen=True)
class Case:
    marginal: Marginal
    law: object  # frozen SciPy distribution


def truncated(mean: float, sd: float, lower: float = -INF, upper: float = INF) -> Case:
    law = stats.truncnorm((lower - mean) / sd, (upper - mean) / sd, loc=mean, scale=sd)
    return Case(TruncatedNormal(mean, sd, lower, upper), law)


def quantile_case(family: str, **arguments: float) -> Case:
    return Case(Quantile(family, arguments), getattr(stats, family)(**arguments))


CASES = {
    "unbounded": truncated(0.3, 2.0),
    "published G": truncated(15090.0, 4350.0, 0.0),
    "published mu": truncated(0.209, 0.18, 0.0),
    "published alpha": truncated(0.28, 0.48, 0.0),
    "half normal": truncated(0.0, 0.5, 0.0),
    "mean below the bound": truncated(-1.0, 0.5, 0.0),
    "two-sided": truncated(1.0, 2.0, -0.5, 1.2),
    "from above": truncated(2.0, 1.0, -INF, 1.5),
    "narrow": truncated(0.0, 1.0, 0.1, 0.1001),
    "wide log-normal": Case(LogNormal(5e3, 5.0), stats.lognorm(math.log(5.0), scale=5e3)),
    "gamma": quantile_case("gamma", a=2.5, scale=3000.0),
    "beta": quantile_case("beta", a=2.0, b=5.0),
    "uniform": quantile_case("uniform", loc=500.0, scale=9500.0),
    "student t": quantile_case("t", df=7.0, loc=1.0, scale=0.3),
    "narrow log-normal": Case(LogNormal(0.1, 1.05), stats.lognorm(math.log(1.05), scale=0.1)),
}
ALL = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
TAILS = [-8.0, -6.5, -5.0, -3.0, -1.0, -1e-3, 0.0, 1e-3, 1.0, 3.0, 5.0, 6.5, 8.0]


def controls(values: list[float] = TAILS) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def quantile(marginal: Marginal, z: float) -> float:
    """The value of the same probability as ``z`` by its closed form with 80 digits (SciPy's own tail is short of them).

    Of a distribution without one, SciPy's from the nearer tail.
    """
    mpmath.mp.dps = 80
    if isinstance(marginal, LogNormal):
        return float(mpmath.mpf(marginal.median) * mpmath.exp(mpmath.log(marginal.factor) * z))
    if isinstance(marginal, Quantile):
        law = getattr(stats, marginal.family)(**marginal.arguments)
        return float(law.ppf(stats.norm.cdf(z)) if z < 0.0 else law.isf(stats.norm.sf(z)))
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
    if isinstance(marginal, Quantile):
        return abs(float(case.law.mean())) + float(case.law.std())
    return max(abs(marginal.mean), marginal.sd) if isinstance(marginal, TruncatedNormal) else 0.0


def test_that_every_kind_of_marginal_is_tested() -> None:
    assert {type(case.marginal) for case in CASES.values()} == set(MARGINALS.values())


@ALL
def test_that_a_control_is_the_quantile_of_its_probability(case: Case) -> None:
    expected = controls([quantile(case.marginal, z) for z in TAILS])
    torch.testing.assert_close(
        case.marginal.to_physical(controls()), expected, rtol=1e-12, atol=1e-13 * scale(case)
    )


@ALL
def test_that_a_control_is_the_quantile_of_scipys_law(case: Case) -> None:
    """The same statement against SciPy, where SciPy has the digits."""
    z = controls([v for v in TAILS if abs(v) <= 5.0])
    expected = torch.tensor(case.law.ppf(stats.norm.cdf(z.numpy())))
    torch.testing.assert_close(
        case.marginal.to_physical(z), expected, rtol=1e-8, atol=1e-12 * scale(case)
    )


@ALL
def test_that_the_map_is_undone_by_its_inverse(case: Case) -> None:
    """Where the value itself resolves the control: next to a bound at 8 sd the last bits of the
    value are the limit.
    """
    z = torch.linspace(-5.0, 5.0, 201, dtype=torch.float64)
    value = case.marginal.to_physical(z)
    resolution = 1e-15 * (value.abs() + scale(case)) * torch.exp(-case.marginal.log_slope(z))
    back = case.marginal.to_control(value)
    assert bool(((back - z).abs() < 1e-10 + 10.0 * resolution).all())


@ALL
def test_that_the_slope_is_the_derivative_of_the_map(case: Case) -> None:
    z = torch.linspace(-5.0, 5.0, 101, dtype=torch.float64)
    h = 1e-3
    ahead, behind, far, back = (case.marginal.to_physical(z + k * h) for k in (1, -1, 2, -2))
    slope = (8.0 * (ahead - behind) - (far - back)) / (12.0 * h)
    resolution = 1e-15 * (ahead.abs() + scale(case)) / h / slope.abs()
    error = (torch.exp(case.marginal.log_slope(z)) / slope - 1.0).abs()
    assert bool((error < 1e-8 + 10.0 * resolution).all())


@ALL
def test_that_the_density_is_scipys(case: Case) -> None:
    """``log p(theta) = log phi(z) - log |d theta/d z|`` is the whole law, normalisation included."""
    z = torch.linspace(-6.0, 6.0, 49, dtype=torch.float64)
    value = case.marginal.to_physical(z)
    density = -0.5 * z.square() - 0.5 * math.log(2.0 * math.pi) - case.marginal.log_slope(z)
    torch.testing.assert_close(
        density, torch.tensor(case.law.logpdf(value.numpy())), rtol=1e-9, atol=1e-9
    )


@ALL
def test_that_the_moments_are_scipys(case: Case) -> None:
    def moment(power: int) -> float:
        def integrand(z: float) -> float:
            return float(case.marginal.to_physical(controls([z]))[0]) ** power * stats.norm.pdf(z)

        return quad(integrand, -12.0, 12.0, epsabs=0.0, epsrel=1e-10, limit=400)[0]

    mean = moment(1)
    assert mean == pytest.approx(case.law.mean(), rel=1e-8)
    assert moment(2) == pytest.approx(case.law.var() + case.law.mean() ** 2, rel=1e-8)


@ALL
def test_that_mapped_normal_draws_have_the_law(case: Case) -> None:
    z = torch.randn(20000, generator=torch.Generator().manual_seed(11), dtype=torch.float64)
    draws = case.marginal.to_physical(z).numpy()
    assert stats.kstest(draws, case.law.cdf).pvalue > 1e-3


@ALL
def test_that_a_map_increases_and_stays_inside_the_support(case: Case) -> None:
    z = torch.linspace(-40.0, 40.0, 801, dtype=torch.float64)
    value = case.marginal.to_physical(z)
    lower, upper = case.law.support()
    assert bool(torch.isfinite(value).all())
    assert bool(((value >= lower) & (value <= upper)).all())
    assert bool((value.diff() >= 0.0).all())
    assert bool((value[(z.abs() <= 5.0)].diff() > 0.0).all())


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("z", [8.0, 15.0, 24.0, 26.0, 36.0, 60.0])
def test_that_an_unbounded_tail_follows_the_exact_law_far_out(sign: float, z: float) -> None:
    """``P(X > x) = Q(z)`` solved with 60 digits: what remains of the other side's truncation is
    ``Q(x) = kept Q(z)``.
    """
    mpmath.mp.dps = 60
    marginal = (
        TruncatedNormal(0.0, 1.0, lower=-0.5) if sign > 0 else TruncatedNormal(0.0, 1.0, upper=0.5)
    )

    def tail(x: mpmath.mpf) -> mpmath.mpf:
        return mpmath.erfc(x / mpmath.sqrt(2)) / 2

    target = mpmath.log(tail(mpmath.mpf(z))) + mpmath.log(1 - tail(mpmath.mpf("0.5")))
    exact = float(mpmath.findroot(lambda x: mpmath.log(tail(x)) - target, z + 0.01))
    assert float(marginal.to_physical(controls([sign * z]))[0]) == pytest.approx(
        sign * exact, rel=2e-6
    )
    assert float(marginal.to_control(controls([sign * exact]))[0]) == pytest.approx(
        sign * z, rel=2e-6
    )


@pytest.mark.parametrize("x", [-37.0, -20.0, -8.5, -8.0, 0.0, 3.0])
def test_that_the_distribution_function_keeps_its_relative_precision_in_the_tail(x: float) -> None:
    mpmath.mp.dps = 40
    exact = float(mpmath.ncdf(mpmath.mpf(x)))
    assert float(ndtr(controls([x]))[0]) == pytest.approx(exact, rel=1e-12)


def test_that_a_normal_that_is_not_truncated_is_the_identity_up_to_scale() -> None:
    marginal = TruncatedNormal(3.0, 0.5)
    z = torch.linspace(-8.0, 8.0, 65, dtype=torch.float64)
    torch.testing.assert_close(marginal.to_physical(z), 3.0 + 0.5 * z, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(
        marginal.log_slope(z), torch.full_like(z, math.log(0.5)), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("distance", [4.0, 6.0, 6.9])
@pytest.mark.parametrize("side", [-1, 1])
def test_that_a_mean_far_outside_the_bounds_keeps_six_digits(distance: float, side: int) -> None:
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
    torch.testing.assert_close(marginal.to_physical(controls(z)), expected, rtol=1e-6, atol=0.0)


@ALL
def test_that_a_marginal_survives_its_dictionary(case: Case) -> None:
    assert marginal_from_dict(marginal_to_dict(case.marginal)) == case.marginal


@ALL
def test_that_autograd_follows_the_map(case: Case) -> None:
    z = torch.linspace(-4.0, 4.0, 33, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(case.marginal.to_physical(z).sum(), z)
    torch.testing.assert_close(
        slope, case.marginal.log_slope(z.detach()).exp(), rtol=1e-8, atol=0.0
    )


@ALL
def test_that_the_input_is_not_changed_and_any_shape_goes_through(case: Case) -> None:
    z = torch.linspace(-3.0, 3.0, 12, dtype=torch.float64).reshape(3, 1, 4)
    before = z.clone()
    value = case.marginal.to_physical(z)
    kept = value.clone()
    for result in (value, case.marginal.to_control(value), case.marginal.log_slope(z)):
        assert result.shape == z.shape
        assert result.dtype == torch.float64
    assert torch.equal(z, before)
    assert torch.equal(value, kept)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: TruncatedNormal(0.0, 0.0),
            r"sd must be positive and finite. .*belongs in `known`",
        ),
        (lambda: TruncatedNormal(0.0, -1.0), r"sd must be positive and finite"),
        (lambda: TruncatedNormal(math.nan, 1.0), r"TruncatedNormal\(mean=nan"),
        (lambda: TruncatedNormal(0.0, math.inf), r"sd must be positive and finite"),
        (
            lambda: TruncatedNormal(0.0, 1.0, 1.0, 1.0),
            r"lower bound 1.0 is not below upper bound 1.0",
        ),
        (
            lambda: TruncatedNormal(0.0, 1.0, 2.0, 1.0),
            r"lower bound 2.0 is not below upper bound 1.0",
        ),
        (lambda: TruncatedNormal(0.0, 1.0, math.nan), r"lower bound nan is not below"),
        (
            lambda: TruncatedNormal(-10.0, 1.0, 0.0),
            r"has no mass between 0.0 and inf; move the mean towards the bounds",
        ),
        (lambda: LogNormal(0.0, 2.0), r"LogNormal.median is 0.0; it must be positive"),
        (lambda: LogNormal(math.nan, 2.0), r"LogNormal.median is nan"),
        (lambda: LogNormal(1.0, 1.0), r"a spread needs a factor above 1"),
        (lambda: LogNormal(1.0, math.inf), r"LogNormal.factor is inf"),
        (
            lambda: marginal_from_dict({"kind": "Gamma"}),
            r"Unknown prior kind 'Gamma'; known are TruncatedNormal, LogNormal, Quantile",
        ),
        (
            lambda: Quantile("poisson", {"mu": 1.0}),
            r"scipy.stats has no continuous distribution named 'poisson'",
        ),
        (
            lambda: Quantile("gamma", {"scale": 1.0}),
            r"scipy.stats.gamma with \{'scale': 1.0\}: .*'a'",
        ),
        (
            lambda: Quantile("gamma", {"a": -1.0}),
            r"scipy.stats.gamma has no median with \{'a': -1.0\}",
        ),
        (lambda: marginal_from_dict({"mean": 1.0}), r"Unknown prior kind None"),
        (
            lambda: marginal_from_dict({"kind": "LogNormal", "median": 1.0}),
            r"Prior of the kind LogNormal: .*factor",
        ),
        (
            lambda: marginal_from_dict(
                {"kind": "LogNormal", "median": 1.0, "factor": 2.0, "mode": 3.0}
            ),
            r"Prior of the kind LogNormal: .*mode",
        ),
    ],
)
def test_that_bad_input_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InputDataError, match=message):
        call()
