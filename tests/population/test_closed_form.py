"""The closed form of Gaussian shots against dense algebra, with scatters of zero and directions that a shot leaves open."""

import math

import pytest
import torch
from torch import Tensor

from imr_torch.population import GaussianShots


def shots(count: int, size: int, *, seed: int = 0) -> GaussianShots:
    source = torch.Generator().manual_seed(seed)
    root = torch.randn(count, size, size, generator=source, dtype=torch.float64)
    precision = root @ root.mT + 0.3 * torch.eye(size, dtype=torch.float64)
    linear = torch.randn(count, size, generator=source, dtype=torch.float64)
    return GaussianShots(
        precision, linear, torch.randn(count, generator=source, dtype=torch.float64)
    )


def dense(
    likelihoods: GaussianShots, scatter: Tensor, mean: Tensor, precision: Tensor
) -> tuple[float, Tensor, Tensor]:
    """Log evidence, posterior mean and covariance of the centre: the modes of the shots are data with the
    covariance of all that is uncertain.
    """
    count, size = likelihoods.linear.shape
    within = torch.linalg.inv(likelihoods.precision)
    modes = (within @ likelihoods.linear[..., None])[..., 0]
    peak = 0.5 * (likelihoods.linear * modes).sum() + likelihoods.constant.sum()
    heights = 0.5 * (size * math.log(2.0 * math.pi) - torch.logdet(likelihoods.precision)).sum()
    between = torch.ones(count, count, dtype=torch.float64)
    covariance = torch.block_diag(*(within + torch.diag(scatter.square()))) + torch.kron(
        between, torch.linalg.inv(precision).contiguous()
    )
    law = torch.distributions.MultivariateNormal(mean.repeat(count), covariance.contiguous())
    shared = torch.linalg.inv(precision).repeat(1, count)
    gain = shared @ torch.linalg.inv(covariance)
    data = modes.reshape(-1)
    centre = mean + gain @ (data - mean.repeat(count))
    spread = torch.linalg.inv(precision) - gain @ shared.mT
    return float(peak + heights + law.log_prob(data)), centre, spread


@pytest.mark.parametrize("scatter", [(0.0, 0.0), (0.7, 0.0), (0.2, 1.5)])
def test_that_evidence_and_centre_are_those_of_dense_algebra(scatter: tuple[float, float]) -> None:
    likelihoods = shots(5, 2)
    mean = torch.tensor([0.3, -0.8], dtype=torch.float64)
    precision = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    wide = torch.tensor(scatter, dtype=torch.float64)
    found = likelihoods.given(wide[None], mean, precision)
    evidence, centre, spread = dense(likelihoods, wide, mean, precision)
    assert float(found.evidence) == pytest.approx(evidence, abs=1e-9)
    torch.testing.assert_close(found.centre[0], centre, rtol=0, atol=1e-9)
    own = torch.cholesky_inverse(found.chol[0])
    torch.testing.assert_close(own, spread, rtol=0, atol=1e-9)


def test_that_a_shot_without_information_changes_nothing() -> None:
    some = shots(3, 2)
    scatter = torch.tensor([[0.5, 0.0]], dtype=torch.float64)
    more = GaussianShots(
        torch.cat((some.precision, torch.zeros(1, 2, 2, dtype=torch.float64))),
        torch.cat((some.linear, torch.zeros(1, 2, dtype=torch.float64))),
        torch.cat((some.constant, torch.zeros(1, dtype=torch.float64))),
    )
    mean = torch.zeros(2, dtype=torch.float64)
    precision = torch.eye(2, dtype=torch.float64)
    a, b = (x.given(scatter, mean, precision) for x in (some, more))
    torch.testing.assert_close(a.evidence, b.evidence, rtol=0, atol=1e-12)
    torch.testing.assert_close(b.shot_means(b.centre)[0, 3], b.centre[0], rtol=0, atol=1e-12)


def test_that_shots_without_scatter_have_the_gel_of_the_population() -> None:
    found = shots(3, 2).given(
        torch.zeros(1, 2, dtype=torch.float64), torch.zeros(2).double(), torch.eye(2).double()
    )
    torch.testing.assert_close(
        found.shot_means(found.centre)[0], found.centre.expand(3, 2), rtol=0, atol=1e-12
    )
    assert float(found.factor.abs().max()) == 0.0
