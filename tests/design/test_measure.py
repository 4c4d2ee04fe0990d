"""Optimal measures against closed forms of classical regression, and their bound on finer grids."""

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from imr_torch.design import DesignSpace, MeasureOptions, Plan, apportion_shots, optimal_measure
from imr_torch.design.measure import certify_shares, optimise_shares
from imr_torch.errors import InputDataError
from imr_torch.float64 import eye, linspace, tensor
from imr_torch.material import PARAMETERS, Belief, TruncatedNormal, reference_case
from imr_torch.observe import Noise
from imr_torch.simulate import PolytropicSimulator
from tests.formula import FormulaSimulator

AT = linspace(-1.0, 1.0, 41)
SPACE = DesignSpace((100.0, 1000.0), (0.15, 0.3))
CENTRE = math.sqrt(1e5)


def standard(weber: Tensor) -> Tensor:
    """-1 to 1 over the Weber numbers of the space."""
    return (weber / CENTRE).log() / math.log(1000.0 / CENTRE)


@dataclass(frozen=True)
class Line(FormulaSimulator):
    """``R = .5 + G + mu x`` in every frame, with ``x`` from -1 to 1 over log We; ``G`` above a limit
    fails.
    """

    limit: float = math.inf

    def formula(self, parameters: Tensor, designs: Tensor, times: Tensor) -> Tensor:
        g, mu = parameters[:, PARAMETERS.index(["G", "mu"])].mT
        return (0.5 + g + mu * standard(designs[:, 0]))[:, None].expand_as(times)

    def bad(self, parameters: Tensor) -> Tensor:
        return parameters[:, PARAMETERS.index(["G"])[0]] > self.limit


WIDE = Belief.prior({"nhkv": {"G": TruncatedNormal(1.0, 0.1), "mu": TruncatedNormal(1.0, 0.1)}})
PLAN = Plan(
    times=tensor([0.0, 1.0]),
    noise=Noise(floor=1e-4, slope=0.0, drift=0.0),
    collapses=None,
)
FINE = MeasureOptions(draws=3, grid=(21, 2), scatter=(0.0, 0.0))


def find_line(criterion: str = "D", *, shots: int = 6, camera=None, space=SPACE, **options):
    merged = MeasureOptions(**(vars(FINE) | options))
    return optimal_measure(
        WIDE, camera or Line(), criterion, shots=shots, plan=PLAN, space=space, options=merged
    )


class DearAbove(DesignSpace):
    """Shots above the centre cost twice as much."""

    def cost(self, designs: Tensor) -> Tensor:
        return 1.0 + (designs[:, 0] > CENTRE).double()


def criterion(regressors: Tensor, target: Tensor | None):
    """Log of the information of a regression without a prior: D, or of a matrix ``W``."""

    def evaluate(shares: Tensor) -> Tensor:
        matrix = regressors.mT * shares @ regressors
        if target is None:
            return torch.logdet(matrix) / regressors.shape[1]
        nearly = matrix + 1e-10 * eye(len(matrix))
        return -torch.linalg.solve(nearly, target).trace().log()

    return evaluate


def polynomial(degree: int) -> Tensor:
    return torch.stack([AT**power for power in range(degree + 1)], 1)


def of_row(*row: float) -> Tensor:
    c = tensor(row)
    return torch.outer(c, c)


@pytest.mark.parametrize(
    ("degree", "target", "shares"),
    [
        (1, None, {-1.0: 1 / 2, 1.0: 1 / 2}),
        (2, None, {-1.0: 1 / 3, 0.0: 1 / 3, 1.0: 1 / 3}),
        (2, eye(3), {-1.0: 1 / 4, 0.0: 1 / 2, 1.0: 1 / 4}),
        (1, of_row(0.0, 1.0), {-1.0: 1 / 2, 1.0: 1 / 2}),
        (1, of_row(1.0, 2.0), {-1.0: 1 / 4, 1.0: 3 / 4}),  # Elfving: the value at 2
        (2, of_row(0.0, 0.0, 1.0), {-1.0: 1 / 4, 0.0: 1 / 2, 1.0: 1 / 4}),
    ],
    ids=["line D", "parabola D", "parabola A", "slope", "extrapolation", "curvature"],
)
def test_that_the_measure_is_the_one_of_the_textbook(degree, target, shares):
    evaluate = criterion(polynomial(degree), target)
    found = optimise_shares(evaluate, torch.full_like(AT, 1.0 / len(AT)))
    expected = sum(share * torch.isclose(AT, tensor(at)).double() for at, share in shares.items())
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=0.0)
    value, sensitivity, bound = certify_shares(evaluate, found)
    assert 0.0 <= bound < 1e-4
    assert float(sensitivity.max()) == pytest.approx(1.0, abs=1e-4)
    assert value >= float(evaluate(torch.full_like(AT, 1.0 / len(AT))))


def test_that_the_bound_of_a_poor_measure_holds_and_the_largest_derivative_is_the_number_of_parameters():
    """Kiefer & Wolfowitz: ``max_x f(x)^T M^-1 f(x) = d`` at the optimum alone."""
    regressors = polynomial(2)
    evaluate = criterion(regressors, None)
    uniform = torch.full_like(AT, 1.0 / len(AT))
    best = optimise_shares(evaluate, uniform)
    value, _, bound = certify_shares(evaluate, uniform)
    gain = math.exp(float(evaluate(best)) - value) - 1.0
    assert 0.1 < gain < bound
    variances = torch.einsum(
        "ki,ij,kj->k", regressors, torch.linalg.inv(regressors.mT * best @ regressors), regressors
    )
    assert float(variances.max()) == pytest.approx(3.0, abs=1e-3)


@pytest.mark.parametrize("name", ["D", "mu"])
def test_that_a_line_seen_by_a_simulator_is_shot_at_its_ends(name):
    found = find_line(name)
    rows = found.support
    ends = standard(found.designs[rows, 0]).round(decimals=6)
    assert set(ends.abs().tolist()) == {1.0}
    for end in (-1.0, 1.0):
        assert float(found.shares[rows][ends == end].sum()) == pytest.approx(0.5, abs=0.01)
    assert found.bound <= 0.001


def test_that_the_efficiency_of_shots_is_that_of_their_determinant():
    found = find_line()
    ends = tensor([[100.0, 0.2], [1000.0, 0.2]])
    lopsided = ends[[0, 0, 0, 0, 1]]  # shares of .8 and .2, so sqrt(4 x .8 x .2)
    assert found.efficiency(ends) == pytest.approx(1.0, abs=0.01)
    assert found.efficiency(lopsided) == pytest.approx(0.8, abs=0.01)
    assert found.efficiency(found.allocate_shots()) == pytest.approx(1.0, abs=0.01)


def test_that_shots_that_cost_twice_as_much_get_as_much_of_the_budget_and_half_the_shots():
    found = find_line(space=DearAbove(SPACE.weber, SPACE.rest_radius))
    dear = found.designs[found.support, 0] > CENTRE
    assert float(found.shares[found.support][dear].sum()) == pytest.approx(0.5, abs=0.01)
    whole = found.allocate_shots()  # 3 shots of cost 1, and 3/2 of cost 2
    assert len(whole) == 4
    assert int((whole[:, 0] > CENTRE).sum()) == 1


def test_that_scatter_of_what_is_shot_costs_information_at_the_ends():
    sharp, blurred = find_line("mu"), find_line("mu", scatter=(0.5, 0.0))
    assert blurred.value < sharp.value - 0.1


def test_that_bubbles_that_fail_tell_nothing():
    assert find_line(camera=Line(limit=1.05)).value < find_line().value
    with pytest.raises(InputDataError, match="tells anything"):
        find_line(camera=Line(limit=-9.0))


@pytest.mark.parametrize("name", ["D", "A", "G", "c:G=1,mu=-1"])
def test_that_the_bound_holds_on_a_grid_four_times_as_fine(name):
    options = MeasureOptions(draws=3, grid=(7, 5))
    found = optimal_measure(
        reference_case("soft-pa").prior, PolytropicSimulator(), name, shots=4, options=options
    )
    axes = [
        torch.logspace(math.log10(a), math.log10(b), n, dtype=torch.float64)
        for a, b, n in ((100.0, 1000.0, 49), (0.14, 0.3, 33))
    ]
    together = torch.cat((found.designs, torch.cartesian_prod(*axes)))
    shares = torch.nn.functional.pad(found.shares, (0, len(together) - len(found.designs)))
    value, _, bound = certify_shares(lambda x: found.evaluate(together, 4.0 * x), shares)
    assert found.bound <= 0.001
    assert bound <= 0.01
    assert value == pytest.approx(found.value)
    assert found.efficiency(found.allocate_shots()) > 0.6
    assert found.efficiency(found.choose_sequence(4)) <= 1.0 + bound


@pytest.mark.parametrize("shots", [3, 4, 7, 23])
def test_that_shots_are_apportioned_efficiently(shots):
    """No design has a shot too many for its share while another has one too few."""
    shares = tensor([0.55, 0.3, 0.15])
    counts = apportion_shots(shares, shots).bincount(minlength=3)
    assert int(counts.sum()) == shots
    assert float(((counts - 1.0) / shares).max()) <= float((counts / shares).min()) + 1e-9


@pytest.mark.parametrize("text", ["E", "c:", "c:G=x", "c:G=0", "alpha", "G,nu"])
def test_that_a_criterion_that_is_none_is_refused_with_those_that_are(text):
    with pytest.raises(InputDataError, match=r"expected D, A, one of G, mu, or c:NAME=FACTOR"):
        find_line(text)
