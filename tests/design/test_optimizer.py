import math
from dataclasses import replace

import pytest
import torch

from imr_torch.design import (
    DesignOptimizer,
    DesignSpace,
    ExpectedInformationGain,
    Laplace,
    search_design,
)
from imr_torch.errors import ShapeError
from imr_torch.float64 import full, linspace, ones, randn, tensor
from imr_torch.random import generator
from tests.design.linear_camera import ONE, LinearCamera, plan
from tests.refusals import refused

SPACE = DesignSpace()
PEAK = tensor([700.0, 0.2])


def utility(X):
    scaled = (X - PEAK) / (SPACE.bounds[1] - SPACE.bounds[0])
    return 5.0 - 8.0 * scaled.square().sum(-1, keepdim=True)


def run(evaluations, *, seed=0, sd=0.05):
    noise = generator(seed)
    optimizer = DesignOptimizer(SPACE, seed=seed, initial=5)
    while len(optimizer.train_X) < evaluations:
        X = optimizer.ask()
        Y = utility(X) + sd * randn(len(X), 1, generator=noise)
        optimizer.tell(X, Y, torch.full_like(Y, sd**2))
    return optimizer


def grid(*counts):
    low, high = SPACE.bounds.tolist()
    axes = [linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    return torch.cartesian_prod(*axes)


def told(space, utility, *, points=None, sd=1e-3):
    """An optimizer that was told the utility at a grid of designs."""
    points = grid(13, 5) if points is None else points
    optimizer = DesignOptimizer(space, seed=0, initial=2)
    optimizer.tell(points, utility(points), full((len(points), 1), sd**2))
    return optimizer


def test_the_recommendation_finds_the_maximum_of_a_noisy_utility():
    best = run(12).recommend()
    assert utility(best.design[None]) > 4.9
    assert abs(best.mean - utility(best.design[None])) < 5.0 * best.sd + 0.02


def test_the_same_tells_give_the_same_asks_whatever_the_global_generator_does():
    first = run(7, seed=3).ask(2)
    torch.manual_seed(1234)
    second = run(7, seed=3).ask(2)
    assert torch.equal(first, second)
    assert first.shape == (2, 2)
    assert not torch.equal(first, run(7, seed=4).ask(2))


def test_initial_asks_fill_the_space_and_do_not_repeat():
    optimizer = DesignOptimizer(SPACE, seed=0, initial=6)
    first = optimizer.ask(4)
    value = utility(first)
    optimizer.tell(first, value, torch.full_like(value, 0.01))
    more = optimizer.ask(2)
    every = torch.cat((first, more))
    SPACE.check_inside(every)
    assert len({tuple(row) for row in every.tolist()}) == 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"Y": float("nan")},
            r"Y\[0\] is nan at design \[300.0, 0.2\]; expected a finite number",
        ),
        (
            {"Yvar": float("inf")},
            r"Yvar\[0\] is inf at design .*expected a finite positive variance",
        ),
        (
            {"Yvar": 0.0},
            r"Yvar\[0\] is 0.0 at design .*expected a finite positive variance",
        ),
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
    with refused(message):
        optimizer.tell(*(tensor(v).reshape(1, -1) for v in values.values()))
    assert len(optimizer.train_X) == len(optimizer.train_Y) == 0


def test_wrong_shapes_and_names_are_refused():
    optimizer = DesignOptimizer(SPACE, seed=0)
    one = ones(1, 1)
    with refused(r"X has shape \(1, 1\); expected \.\.\. x 2", ShapeError):
        optimizer.tell(one, one, one)
    with refused("tell expects X n x 2, Y n x 1"):
        optimizer.tell(PEAK[None], one[0], one)
    with refused("at least 2 told designs"):
        optimizer.recommend()


def test_pending_designs_are_not_asked_again():
    optimizer = DesignOptimizer(SPACE, seed=0, initial=4)
    first = optimizer.ask(2)
    assert torch.equal(optimizer.ask(2, pending=first), optimizer.ask(4)[2:])
    optimizer = run(8)
    asked = optimizer.ask()
    other = optimizer.ask(pending=asked)
    span = SPACE.bounds[1] - SPACE.bounds[0]
    assert ((other - asked) / span).norm() > 0.02
    assert torch.equal(optimizer.ask(pending=asked), other)


def test_failed_evaluations_are_recorded_not_told_and_not_asked_again():
    acquisition = ExpectedInformationGain(
        ONE, PartlyFailing(), Laplace(draws=4), plan=plan(), space=SPACE
    )
    search = search_design(acquisition, seed=1, evaluations=9, initial=5)
    failed = torch.tensor([gain.failed for gain in search.gains])
    assert 0 < int(failed.sum()) < 7
    assert (search.designs[failed, 0] > 600.0).all()
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
    "bad", [{"weber": (500.0, 100.0)}, {"weber": (0.0, 100.0)}, {"rest_radius": (0.2, 1.5)}]
)
def test_an_impossible_space_is_refused(bad):
    with refused("expected 0 < lower < upper"):
        DesignSpace(**bad)
