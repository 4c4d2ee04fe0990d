import math

import pytest
import torch

from imr_torch.design import linear_gaussian_gain
from imr_torch.errors import ShapeError

EYE = torch.eye(2, dtype=torch.float64)


def test_one_number_seen_with_noise_tells_half_the_log_of_its_signal_to_noise():
    gain = linear_gaussian_gain(torch.tensor([[2.0]]).double(), torch.tensor([[0.25]]).double())
    assert float(gain) == pytest.approx(0.5 * math.log(1.0 + 16.0))


def test_the_gain_is_that_of_entropies_of_the_parameters():
    A = torch.tensor([[1.0, 0.5], [0.2, -1.0], [0.7, 0.1]], dtype=torch.float64)
    prior = torch.tensor([[2.0, 0.6], [0.6, 1.0]], dtype=torch.float64)
    noise = 0.3 * torch.eye(3, dtype=torch.float64)
    posterior = torch.linalg.inv(torch.linalg.inv(prior) + A.mT @ torch.linalg.solve(noise, A))
    entropies = 0.5 * (torch.logdet(prior) - torch.logdet(posterior))
    assert float(linear_gaussian_gain(A, noise, prior)) == pytest.approx(float(entropies))


def test_it_is_additive_over_independent_parameters_and_batched():
    A = torch.diag(torch.tensor([1.0, 3.0]).double())
    each = [float(linear_gaussian_gain(A[i : i + 1, i : i + 1], EYE[:1, :1])) for i in range(2)]
    batch = linear_gaussian_gain(torch.stack((A, 2.0 * A)), EYE)
    assert batch.shape == (2,)
    assert float(batch[0]) == pytest.approx(sum(each))


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(
        ShapeError,
        match=r"needs noise \.\.\. x 3 x 3 and prior \.\.\. x 2 x 2; got \(2, 2\) and \(2, 2\)",
    ):
        linear_gaussian_gain(torch.ones(3, 2).double(), EYE)
