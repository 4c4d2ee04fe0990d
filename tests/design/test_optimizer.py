import math
import warnings
from dataclasses import replace

import pytest
import torch

from imr_torch.design import (
    STRATEGIES,
    DesignOptimizer,
    DesignSpace,
    ExpectedInformationGain,
    Laplace,
    Strategy,
    search_design,
)
from imr_torch.errors import InputDataError, ShapeError
from tests.design.linear_camera import ONE, LinearCamera, plan

SPACE = DesignSpace()
PEAK = torch.tensor([700.0, 0.2], dtype=torch.float64)


def utility(X):
    scaled = (X - PEAK) / (SPACE.bounds[1] - SPACE.bounds[0])
    return 5.0 - 8.0 * scaled.square().sum(-1, keepdim=True)


def run(strategy, evaluations, *, seed=0, sd=0.05, space=SPACE, cost=None):
    noise = torch.Generator().manual_seed(seed)
    optimizer = DesignOptimizer(
        space, seed=seed, initial=5, strategy=STRATEGIES[strategy], cost=cost
    )
    while len(optimizer.train_X) < evaluations:
        X = optimizer.ask()
        Y = utility(X) + sd * torch.randn(len(X), 1, generator=noise, dtype=torch.float64)
        optimizer.tell(X, Y, torch.full_like(Y, sd**2))
    return optimizer


def grid(*counts):
    low, high = SPACE.bounds.tolist()
    axes = [
        torch.linspace(a, b, n, dtype=torch.float64)
        for a, b, n in zip(low, high, counts, strict=True)
    ]
    return torch.cartesian_prod(*axes)


def told(space, utility, *, points=None, sd=1e-3, strategy=None, cost=None):
    """An optimizer that was told the utility at a grid of designs."""
    points = grid(13, 5) if points is None else points
    optimizer = DesignOptimizer(space, seed=0, initial=2, strategy=strategy, cost=cost)
    optimizer.tell(
        points, utility(points), torch.full((len(points), 1), sd**2, dtype=torch.float64)
    )
    return optimizer


@pytest.mark.parametrize("strategy", ["qLogNEI", "qEI"])
def test_the_recommendation_finds_the_maximum_of_a_noisy_utility(strategy):
    best = run(strategy, 12).recommend()
    assert float(utility(best.design[None])) > 4.9
    assert abs(best.mean - float(utility(best.design[None]))) < 5.0 * best.sd + 0.02


def test_a_utility_known_almost_exactly_is_fitted_without_a_word():
    optimizer = told(SPACE, utility, points=grid(5, 5), sd=1e-5)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        mean = optimizer.model().posterior(PEAK[None]).mean
    assert not [w for w in said if "Very small noise" in str(w.message)]
    assert float(mean) == pytest.approx(5.0, abs=0.05)


def test_the_recommendation_is_not_the_best_noisy_value():
    optimizer = run("qLogNEI", 8)
    lucky = torch.tensor([[150.0, 0.29]], dtype=torch.float64)
    poor = torch.full((1, 1), float(utility(lucky)), dtype=torch.float64)
    for shift in (-1.0, 1.0, 6.0, -6.0):  # one lucky value among unlucky ones at a poor design
        optimizer.tell(lucky, poor + shift, torch.full((1, 1), 20.0, dtype=torch.float64))
    assert float(optimizer.train_Y.max()) > 4.0
    assert float((optimizer.recommend().design - PEAK).abs()[1]) < 0.05


def test_the_same_tells_give_the_same_asks_whatever_the_global_generator_does():
    first = run("qLogNEI", 7, seed=3).ask(2)
    torch.manual_seed(1234)
    second = run("qLogNEI", 7, seed=3).ask(2)
    assert torch.equal(first, second)
    assert first.shape == (2, 2)
    assert not torch.equal(first, run("qLogNEI", 7, seed=4).ask(2))


def test_asking_leaves_the_global_generator_alone():
    optimizer = run("qLogNEI", 6)
    torch.manual_seed(5)
    before = torch.get_rng_state()
    optimizer.ask()
    optimizer.recommend()
    assert torch.equal(before, torch.get_rng_state())


def test_initial_asks_fill_the_space_and_do_not_repeat():
    optimizer = DesignOptimizer(SPACE, seed=0, initial=6)
    first = optimizer.ask(4)
    value = utility(first)
    optimizer.tell(first, value, torch.full_like(value, 0.01))
    more = optimizer.ask(2)
    every = torch.cat((first, more))
    SPACE.check(every)
    assert len({tuple(row) for row in every.tolist()}) == 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Y": float("nan")}, r"Y\[0\] is nan at design \[300.0, 0.2\]; expected a finite number"),
        (
            {"Yvar": float("inf")},
            r"Yvar\[0\] is inf at design .*expected a finite positive variance",
        ),
        ({"Yvar": 0.0}, r"Yvar\[0\] is 0.0 at design .*expected a finite positive variance"),
        (
            {"X": [30.0, 0.2]},
            r"\(30, 0.2\) is outside We \[100.0, 1000.0\], R_inf\* \[0.14, 0.3\]; shoot inside",
        ),
        ({"X": [300.0, float("nan")]}, r"\(300, nan\) is outside We"),
    ],
)
def test_a_bad_tell_is_refused_and_nothing_is_recorded(changes, message):
    optimizer = DesignOptimizer(SPACE, seed=0)
    values = {"X": [300.0, 0.2], "Y": 1.0, "Yvar": 0.1} | changes
    with pytest.raises(InputDataError, match=message):
        optimizer.tell(
            *(torch.tensor(v, dtype=torch.float64).reshape(1, -1) for v in values.values())
        )
    assert len(optimizer.train_X) == len(optimizer.train_Y) == 0


def test_wrong_shapes_and_names_are_refused():
    optimizer = DesignOptimizer(SPACE, seed=0)
    one = torch.ones(1, 1, dtype=torch.float64)
    with pytest.raises(ShapeError, match=r"X has shape \(1, 1\); expected \.\.\. x 2"):
        optimizer.tell(one, one, one)
    with pytest.raises(InputDataError, match="tell expects X n x 2, Y n x 1"):
        optimizer.tell(PEAK[None], one[0], one)
    with pytest.raises(InputDataError, match="at least 2 told designs"):
        optimizer.recommend()


def test_pending_designs_are_not_asked_again():
    optimizer = DesignOptimizer(SPACE, seed=0, initial=4)
    first = optimizer.ask(2)
    assert torch.equal(optimizer.ask(2, pending=first), optimizer.ask(4)[2:])
    optimizer = run("qLogNEI", 8)
    asked = optimizer.ask()
    other = optimizer.ask(pending=asked)
    span = SPACE.bounds[1] - SPACE.bounds[0]
    assert float(((other - asked) / span).norm()) > 0.02
    assert torch.equal(optimizer.ask(pending=asked), other)


def test_the_published_strategy_recommends_the_best_observed_value_and_wants_an_improvement():
    optimizer = told(SPACE, utility, strategy=STRATEGIES["paper"])
    lucky = torch.tensor([[150.0, 0.29]], dtype=torch.float64)
    optimizer.tell(
        lucky,
        torch.full((1, 1), 9.0, dtype=torch.float64),
        torch.full((1, 1), 4.0, dtype=torch.float64),
    )
    best = optimizer.recommend()
    assert torch.equal(best.design, lucky[0])
    assert (best.mean, best.sd) == (9.0, 2.0)
    assert STRATEGIES["paper"] == Strategy("qEI", 0.01, "best observed")


def test_an_improvement_that_cannot_be_had_is_worth_nothing():
    X = PEAK[None, None] + torch.tensor([0.0, 0.01])
    values = []
    for improvement in (0.0, 0.5):
        optimizer = told(SPACE, utility, strategy=Strategy("qEI", improvement), sd=0.1)
        values.append(
            float(optimizer._acquisition(torch.empty(0, 2, dtype=torch.float64))(X).detach())
        )
    assert values[0] > 10.0 * values[1]


LISTED = ((200.0, 0.15), (400.0, 0.2), (650.0, 0.19), (650.0, 0.28), (900.0, 0.22))
AXES = {
    "weber_settings": (150.0, 400.0, 650.0, 900.0),
    "rest_radius_settings": (0.15, 0.18, 0.22, 0.28),
}


@pytest.mark.parametrize(
    "space",
    [
        DesignSpace(designs=LISTED),
        DesignSpace(**AXES),
        DesignSpace(weber_settings=AXES["weber_settings"]),
        DesignSpace(rest_radius_settings=AXES["rest_radius_settings"]),
    ],
    ids=["list", "both axes", "We", "R_inf*"],
)
def test_only_designs_that_can_be_set_are_asked_and_recommended(space):
    optimizer = run("qLogNEI", 10, space=space)
    designs = torch.cat((optimizer.train_X, optimizer.recommend().design[None], optimizer.ask(1)))
    if space.designs:
        assert all(tuple(row) in LISTED for row in designs.tolist())
    for axis, settings in enumerate((space.weber_settings, space.rest_radius_settings)):
        assert not settings or all(value in settings for value in designs[:, axis].tolist())
    found = float(utility(optimizer.recommend().design[None]))
    best = (
        float(utility(space.settle(PEAK[None])))
        if not space.designs
        else float(utility(torch.tensor(LISTED)).max())
    )
    assert found > best - 0.3


def test_initial_asks_of_a_list_are_each_design_once():
    optimizer = DesignOptimizer(DesignSpace(designs=LISTED), seed=0, initial=10)
    assert optimizer.initial == 5
    assert {tuple(row) for row in optimizer.ask(5).tolist()} == set(LISTED)


def test_a_list_without_free_designs_is_refused():
    optimizer = run("qLogNEI", 6, space=DesignSpace(designs=LISTED))
    with pytest.raises(
        InputDataError, match="3 designs were asked for and 2 of the 5 in the space are free"
    ):
        optimizer.ask(3, pending=torch.tensor(LISTED[:3], dtype=torch.float64))


def two_hills(X):
    """A ridge of 2.0 that is narrow in We at 300, and a broad hill of 1.7 at 700."""
    weber = X[:, :1]
    return 2.0 * torch.exp(-(((weber - 300.0) / 50.0) ** 2)) + 1.7 * torch.exp(
        -(((weber - 700.0) / 250.0) ** 2)
    )


def test_scatter_of_what_is_achieved_moves_the_recommendation_to_the_broad_hill():
    points = grid(25, 3)
    exact = told(SPACE, two_hills, points=points).recommend()
    assert abs(float(exact.design[0]) - 300.0) < 30.0
    scattered = told(DesignSpace(scatter=(0.3, 0.0)), two_hills, points=points).recommend()
    assert 550.0 < float(scattered.design[0]) < 850.0
    z = torch.randn(20000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    achieved = (scattered.design[0] * torch.exp(0.3 * z)).clamp(100.0, 1000.0)
    assert scattered.mean == pytest.approx(float(two_hills(achieved[:, None]).mean()), abs=0.06)


@pytest.mark.parametrize("strategy", ["qLogNEI", "qEI"])
def test_the_search_goes_where_the_achieved_designs_are_good(strategy):
    points = grid(13, 2)
    optimizer = told(
        DesignSpace(scatter=(0.3, 0.0)),
        two_hills,
        points=points,
        sd=0.05,
        strategy=STRATEGIES[strategy],
    )
    assert 450.0 < float(optimizer.ask()[0, 0]) < 950.0


def test_costs_move_the_recommendation_to_information_per_cost():
    def dear(X):
        return 1.0 + X[:, 0] / 200.0

    free, paid = (told(SPACE, utility, sd=0.05, cost=cost).recommend() for cost in (None, dear))
    assert abs(float(free.design[0]) - 700.0) < 20.0
    weber = torch.linspace(100.0, 1000.0, 901, dtype=torch.float64)
    per_cost = utility(torch.stack((weber, torch.full_like(weber, 0.2)), 1))[:, 0] / (
        1.0 + weber / 200.0
    )
    assert float(paid.design[0]) == pytest.approx(float(weber[per_cost.argmax()]), abs=30.0)
    assert paid.mean == pytest.approx(float(per_cost.max()), abs=0.1)


@pytest.mark.parametrize("cost", [lambda X: 0.0 * X[:, 0], lambda X: X, lambda X: X[:, 0] / 0.0])
def test_a_cost_that_is_none_is_refused(cost):
    with pytest.raises(InputDataError, match="expected as many finite positive numbers"):
        told(SPACE, utility, cost=cost).recommend()


def test_failed_evaluations_are_recorded_not_told_and_not_asked_again():
    acquisition = ExpectedInformationGain(
        ONE, PartlyFailing(), Laplace(draws=4), plan=plan(), space=SPACE
    )
    search = search_design(acquisition, seed=1, evaluations=9, initial=5)
    failed = torch.tensor([gain.failed for gain in search.gains])
    assert 0 < int(failed.sum()) < 7
    assert bool((search.designs[failed, 0] > 600.0).all())
    assert len(search.designs) == 9
    assert len(search.optimizer.train_X) == 9 - int(failed.sum())
    assert all(
        math.isnan(gain.value) == bad
        for gain, bad in zip(search.gains, failed.tolist(), strict=True)
    )
    assert len({tuple(row) for row in search.designs.tolist()}) == 9


class PartlyFailing(LinearCamera):
    """Whose bubbles fail above We 600."""

    def __call__(self, parameters, designs, times):
        solution = super().__call__(parameters, designs, times)
        bad = (designs[..., :1] > 600.0).expand(solution.radius.shape)
        return replace(solution, radius=torch.where(bad, torch.nan, solution.radius))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Strategy("thompson"), "expected 'qLogNEI' or 'qEI'"),
        (
            lambda: Strategy(incumbent="last"),
            "Strategy.incumbent is 'last'; expected 'posterior mean' or 'best observed'",
        ),
        (
            lambda: Strategy(improvement=0.1),
            "Strategy.improvement is 0.1; expected a finite number >= 0, and 0 for 'qLogNEI'",
        ),
        (
            lambda: DesignSpace(weber_settings=(50.0,)),
            r"weber_settings is \(50.0,\); expected different values within \[100",
        ),
        (
            lambda: DesignSpace(rest_radius_settings=(0.2, 0.2)),
            "rest_radius_settings is .*expected different values",
        ),
        (
            lambda: DesignSpace(designs=LISTED, **AXES),
            "a list of designs or settings of each axis, not both",
        ),
        (lambda: DesignSpace(designs=((200.0, 0.2), (200.0, 0.2))), "names a design twice"),
        (lambda: DesignSpace(designs=((50.0, 0.2),)), r"\(50, 0.2\) is outside We"),
        (
            lambda: DesignSpace(scatter=(0.1, -0.1)),
            r"expected two relative standard deviations in \[0, 1\)",
        ),
    ],
)
def test_impossible_strategies_and_laboratories_are_refused(make, message):
    with pytest.raises(InputDataError, match=message):
        make()


@pytest.mark.parametrize(
    "bad", [{"weber": (500.0, 100.0)}, {"weber": (0.0, 100.0)}, {"rest_radius": (0.2, 1.5)}]
)
def test_an_impossible_space_is_refused(bad):
    with pytest.raises(InputDataError, match="expected 0 < lower < upper"):
        DesignSpace(**bad)
