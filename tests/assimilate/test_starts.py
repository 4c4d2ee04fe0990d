"""Starts about an earlier optimum: as far away as they say, with nuisances where they are most
probable at their gels.
"""

import pytest
import torch

from imr_torch.assimilate import Posterior, SearchOptions, assimilate
from imr_torch.assimilate.starts import given_starts, starts_beside
from imr_torch.observe import Nuisance
from imr_torch.random import generator
from tests.linear import LinearSimulator, experiments, prior, tensor

OPTIONS = SearchOptions(raw_samples=24, starts=4)
BATCH = experiments(3, nuisance=Nuisance(time_zero=0.2, rest_radius=0.3))


def test_that_starts_beside_an_optimum_cost_what_their_distance_says() -> None:
    """Half the square of the posterior standard deviations between them, exactly where the model is linear."""
    belief = prior(("nhkv",))
    fit = assimilate(belief, BATCH, LinearSimulator(), seed=1, options=OPTIONS).fits[0]
    posterior = Posterior(belief.models[0], BATCH, LinearSimulator())
    point = starts_beside(posterior, fit, OPTIONS, generator(2))
    away = torch.linalg.solve_triangular(fit.chol, (point.gel - fit.mean).mT, upper=False).norm(
        dim=0
    )
    above = -posterior.log_joint(point) - fit.cost
    assert float(away[0]) == 0.0
    assert bool((away[1:] > 0.1).all())
    assert bool((away < 4.0 * OPTIONS.descent.restart).all())
    torch.testing.assert_close(above, 0.5 * away.square(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("many", [False, True], ids=["the same for all", "of each start"])
def test_that_nuisances_are_given_for_all_starts_or_for_each(many: bool) -> None:
    posterior = Posterior(prior(("nhkv",)).models[0], BATCH, LinearSimulator())
    gels = tensor([0.0, 0.0], [1.0, -1.0])
    nuisances = torch.randn(2, 3, 3, generator=generator(0), dtype=torch.float64)
    (point,) = given_starts([posterior], [gels], [nuisances if many else nuisances[0]])
    torch.testing.assert_close(
        point.nuisances, nuisances if many else nuisances[:1].expand(2, -1, -1)
    )
