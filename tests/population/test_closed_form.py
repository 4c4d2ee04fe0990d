"""The closed form of Gaussian shots against dense algebra, with scatters of zero."""

import math

import pytest
import torch
from torch.distributions import MultivariateNormal
from torch.testing import assert_close

from imr_torch.float64 import eye, randn, tensor
from imr_torch.population import GaussianShots
from imr_torch.random import generator

COUNT = 5


@pytest.mark.parametrize("scatter", [(0.0, 0.0), (0.7, 0.0), (0.2, 1.5)])
def test_that_evidence_and_centre_are_those_of_dense_algebra(scatter):
    """The modes of the shots are data with the covariance of all that is uncertain."""
    source = generator(0)
    root = randn(COUNT, 2, 2, generator=source)
    linear = randn(COUNT, 2, generator=source)
    shots = GaussianShots(
        root @ root.mT + 0.3 * eye(2), linear, randn(COUNT, generator=source)
    )
    mean = tensor([0.3, -0.8])
    precision = tensor([[2.0, 0.5], [0.5, 1.0]])
    found = shots.given(tensor([scatter]), mean, precision)
    within = torch.linalg.inv(shots.precision)
    modes = (within @ linear[..., None])[..., 0]
    heights = shots.constant + 0.5 * (linear * modes).sum(1)
    heights += math.log(2.0 * math.pi) - 0.5 * torch.logdet(shots.precision)
    prior = torch.linalg.inv(precision)
    between = prior.repeat(COUNT, COUNT)
    law = MultivariateNormal(
        mean.repeat(COUNT),
        between + torch.block_diag(*(within + tensor(scatter).square().diag())),
    )
    gain = between[:2] @ torch.linalg.inv(law.covariance_matrix)
    data = modes.flatten()
    assert found.evidence == pytest.approx(float(heights.sum() + law.log_prob(data)))
    assert_close(found.centre[0], mean + gain @ (data - law.mean))
    assert_close(torch.cholesky_inverse(found.chol[0]), prior - gain @ between[:, :2])
