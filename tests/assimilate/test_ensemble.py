"""One analysis of an ensemble: the Kalman filter's where predictions are linear, and a step towards
the most probable point where they are not.
"""

import pytest
import torch
from torch.testing import assert_close

from imr_torch.assimilate import analyse_ensemble
from imr_torch.errors import InputDataError, ShapeError
from imr_torch.float64 import eye, linspace, randn, tensor, zeros
from imr_torch.random import generator
from tests.refusals import refused

SIZE = 3
DATA = 7


def draw_problem(seed=0, members=12):
    """Members, a linear model ``d x m``, data, and a full noise covariance."""
    source = generator(seed)
    model = randn(SIZE, DATA, generator=source)
    root = 0.3 * eye(DATA) + 0.05 * randn(DATA, DATA, generator=source)
    data = randn(DATA, generator=source)
    return randn(members, SIZE, generator=source), model, data, root @ root.mT


def kalman(model, data, noise, mean, covariance):
    """Posterior mean and covariance in the gain form, which the analysis does not use."""
    gain = covariance @ model @ torch.linalg.inv(model.mT @ covariance @ model + noise)
    return mean + gain @ (data - mean @ model), covariance - gain @ model.mT @ covariance


def assert_kalman(found, *problem):
    """Mean and covariance, which are returned."""
    truth, spread = kalman(*problem)
    assert_close(found.mean, truth)
    assert_close(found.chol @ found.chol.mT, spread)
    return truth, spread


@pytest.mark.parametrize("own_prior", [False, True])
def test_that_it_is_the_kalman_filter_of_a_linear_model(own_prior):
    members, model, data, noise = draw_problem()
    mean = members.mean(0)
    covariance = members.mT.cov()
    if own_prior:
        mean = tensor([0.5, -0.2, 0.1])
        covariance = tensor([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 0.5]])
    prior = (mean, covariance) if own_prior else None
    found = analyse_ensemble(members, members @ model, data, noise, prior=prior)
    truth, spread = assert_kalman(found, model, data, noise, mean, covariance)
    moved = found.move_members(members)
    assert_close(moved.mean(0), truth)
    assert_close(moved.mT.cov(), spread)


def test_that_variances_are_a_diagonal_covariance_and_failed_members_are_left_out():
    members, model, data, _ = draw_problem()
    variances = linspace(0.01, 0.2, DATA)
    predictions = members @ model
    predictions[3, 2] = torch.nan
    prior = zeros(SIZE), eye(SIZE)
    found = analyse_ensemble(members, predictions, data, variances, prior=prior)
    assert_kalman(found, model, data, variances.diag(), *prior)


def test_that_spread_is_relaxed_towards_what_it_was():
    members, model, data, noise = draw_problem()
    found = analyse_ensemble(members, members @ model, data, noise)
    before, after = members.std(0), found.move_members(members).std(0)
    relaxed = found.move_members(members, relaxation=0.7)
    assert_close(relaxed.std(0), 0.3 * after + 0.7 * before)
    assert_close(relaxed.mean(0), found.mean)


def test_that_influence_lets_few_members_serve_many_coordinates():
    """Two shared coordinates and one of each of six data blocks, by five members."""
    source = generator(1)
    blocks = 6
    size = 2 + blocks
    influence = torch.zeros(size, 4 * blocks, dtype=torch.bool)
    influence[:2] = True
    for block in range(blocks):
        influence[2 + block, 4 * block : 4 * block + 4] = True
    model = torch.where(influence, randn(*influence.shape, generator=source), 0.0)
    data = randn(4 * blocks, generator=source)
    members = randn(5, size, generator=source)
    prior = zeros(size), eye(size)
    noise = 0.04 * eye(4 * blocks)
    found = analyse_ensemble(
        members, members @ model, data, noise, prior=prior, influence=influence
    )
    assert_kalman(found, model, data, noise, *prior)
    with refused("ensemble has 5 members of 8 coordinates", ShapeError):
        found.move_members(members)


def test_that_a_loop_of_ones_own_ends_at_the_most_probable_point():
    """Of ``x -> exp(x)``: there the derivative of the cost, written by hand, is zero."""
    data = tensor([2.0])
    noise = tensor([0.01])
    prior = zeros(1), eye(1)
    members = 0.3 * randn(40, 1, generator=generator(2))
    for _ in range(8):
        found = analyse_ensemble(
            members,
            members.exp(),
            data,
            noise,
            prior=prior,
            mean_prediction=members.mean(0).exp(),
        )
        members = found.move_members(members)
    x = float(found.mean)
    top = torch.tensor(x).exp()
    assert abs(x + ((top - 2.0) * top) / 0.01) < 0.02 * (top**2) / 0.01
    assert found.whitened_step.norm() < 1e-3


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        (
            {"predictions": zeros(12, 6)},
            ShapeError,
            r"predictions is \(12, 6\); expected 12",
        ),
        ({"prior": (zeros(2), eye(3))}, ShapeError, r"mean of prior is \(2,\); expected 3"),
        (
            {"influence": zeros(7, 3).bool()},
            ShapeError,
            r"influence is \(7, 3\); expected 3 x 7",
        ),
        ({"ensemble": zeros(12)}, ShapeError, r"ensemble is \(12,\); expected members x"),
        ({"data": zeros(1, 7)}, ShapeError, r"data is \(1, 7\); expected one dimension"),
        (
            {"noise_covariance": zeros(6)},
            ShapeError,
            r"noise_covariance is \(6,\); expected 7",
        ),
        (
            {"predictions": torch.full((12, 7), torch.nan).double()},
            InputDataError,
            "predictions of 0 of 12 members are finite",
        ),
    ],
)
def test_that_bad_input_is_named(changes, error, message):
    members, model, data, noise = draw_problem()
    given = {
        "ensemble": members,
        "predictions": members @ model,
        "data": data,
        "noise_covariance": noise,
    }
    with pytest.raises(error, match=message):
        analyse_ensemble(**given | changes)
    with refused(r"relaxation is 2\.0; expected a share"):
        analyse_ensemble(**given).move_members(members, relaxation=2.0)
