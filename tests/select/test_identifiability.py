"""What the data bound, against likelihoods that are known."""

import pytest
import torch
from torch import Tensor

from imr_torch import wide_prior
from imr_torch.float64 import tensor
from imr_torch.material import ModelBelief
from imr_torch.select import Bound, identifiability

PRIOR = wide_prior(["nhkv"])["nhkv"]


def after(centre: float, sd: float) -> ModelBelief:
    """The prior of G times a Gaussian likelihood of its control; nothing is learnt of mu."""
    precision = 1.0 + sd**-2
    mean = tensor([centre * sd**-2 / precision, 0.0])
    return PRIOR.with_gaussian(mean, torch.diag(tensor([precision**-0.5, 1.0])))


@pytest.mark.parametrize(
    ("centre", "sd", "bound"),
    [
        (0.0, 0.1, Bound.BOTH),
        (1.0, 0.7, Bound.BOTH),
        (
            -2.0,
            0.6,
            Bound.ABOVE,
        ),  # the likelihood falls by .35 towards the lower end, and by 28 towards the upper
        (-6.0, 1.5, Bound.ABOVE),  # its maximum is beyond the prior
        (2.0, 0.6, Bound.BELOW),
        (0.0, 5.0, Bound.NEITHER),
        (0.0, 1.2, Bound.BOTH),  # falls by 2.2
        (0.0, 1.4, Bound.NEITHER),  # by 1.6
    ],
)
def test_that_the_bounds_are_those_of_the_likelihood(centre, sd, bound):
    found = identifiability(PRIOR, after(centre, sd))
    assert [f.bound for f in found] == [bound, Bound.NEITHER]
    assert found[1].limit is None


def test_that_the_limit_is_the_quantile_of_the_posterior_in_si():
    posterior = after(-6.0, 1.5)
    (found, _) = identifiability(PRIOR, posterior)
    assert found.limit == pytest.approx(float(posterior.quantile([0.95])[0, 0]))
    said = f"only bounded from above: below {1e-3 * found.limit:.3g} kPa (95 %)"
    assert found.words == f"{said}; the other end is the prior's"


def test_that_correlated_priors_and_coordinates_do_not_matter():
    chol = tensor([[2.0, 0.0], [0.1, 0.5]])
    prior = PRIOR.with_gaussian(tensor([0.5, -1.0]), chol)
    # data on mu
    before = torch.linalg.inv(chol @ chol.mT)
    precision = before + torch.diag(tensor([0.0, 400.0]))

    def posterior(weight: Tensor) -> ModelBelief:
        return prior.with_gaussian(
            prior.mean, torch.linalg.cholesky(torch.linalg.inv(weight))
        )

    bounds = [f.bound for f in identifiability(prior, posterior(precision))]
    assert bounds == [Bound.NEITHER, Bound.BOTH]  # mu tells little of G through the prior
    sharp = before + torch.diag(tensor([400.0, 0.0]))
    assert identifiability(prior, posterior(sharp))[0].bound is Bound.BOTH
