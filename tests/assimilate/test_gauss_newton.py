"""The arrow-shaped normal equations against the same equations solved dense."""

import pytest
import torch
from torch import Tensor

from imr_torch.assimilate import NormalEquations, normal_equations
from imr_torch.float64 import eye, randn, zeros
from imr_torch.random import generator

SIZE = 3
EXPERIMENTS = 4
FRAMES = 7


def random(*shape: int, seed: int) -> Tensor:
    return randn(*shape, generator=generator(seed))


def problem(*batch: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Controls ``v`` and ``w``, sensitivities to them, and whitened residuals."""
    return (
        random(*batch, SIZE, seed=seed),
        random(*batch, EXPERIMENTS, 3, seed=seed + 1),
        random(*batch, EXPERIMENTS, FRAMES, SIZE, seed=seed + 2),
        random(*batch, EXPERIMENTS, FRAMES, 3, seed=seed + 3),
        random(*batch, EXPERIMENTS, FRAMES, seed=seed + 4),
    )


def assembled(
    gel: Tensor, nuisances: Tensor, by_gel: Tensor, by_nuisance: Tensor, residual: Tensor
) -> NormalEquations:
    gradients = (
        (by_gel.mT @ residual[..., None])[..., 0].sum(-2),
        (by_nuisance.mT @ residual[..., None])[..., 0],
    )
    return normal_equations(gradients, (by_gel, by_nuisance)).with_prior(gel, nuisances)


def dense(
    gel: Tensor, nuisances: Tensor, by_gel: Tensor, by_nuisance: Tensor, residual: Tensor
) -> tuple[Tensor, Tensor]:
    """Hessian and gradient of ``|x|^2/2 + |residual|^2/2`` over ``x = (v, w)``."""
    rows = zeros(EXPERIMENTS, FRAMES, SIZE + 3 * EXPERIMENTS)
    rows[..., :SIZE] = by_gel
    for e in range(EXPERIMENTS):
        rows[e, :, SIZE + 3 * e : SIZE + 3 * e + 3] = by_nuisance[e]
    matrix = rows.reshape(-1, rows.shape[-1])
    hessian = eye(matrix.shape[1]) + matrix.mT @ matrix
    return hessian, torch.cat((gel, nuisances.reshape(-1))) + matrix.mT @ residual.reshape(
        -1
    )


@pytest.mark.parametrize("seed", [0, 10, 20])
def test_that_the_whitened_gradient_is_the_newton_decrement_of_the_dense_system(seed):
    """``sqrt(g^T H^-1 g)`` over gel and nuisances: the length of the undamped step in posterior
    standard deviations.
    """
    given = problem(seed=seed)
    hessian, gradient = dense(*given)
    expected = (gradient @ torch.linalg.solve(hessian, gradient)).sqrt()
    assert assembled(*given).whitened_gradient == pytest.approx(float(expected), rel=1e-10)


def test_that_sensitivities_of_any_size_leave_a_definite_hessian_and_a_factor_of_its_inverse():
    """At the edge of where bubbles can be simulated a slope may be 1e9 standard deviations, and rounding 1e18 times 1e-16."""
    gel, nuisances, by_gel, by_nuisance, residual = problem(6)
    by_gel[3:] *= 1e9
    # a nuisance that moves the curve as the gel does: the elimination cancels
    by_nuisance[3:] = by_gel[3:]
    found = assembled(gel, nuisances, by_gel, by_nuisance, residual)
    smooth = assembled(gel[:3], nuisances[:3], by_gel[:3], by_nuisance[:3], residual[:3])
    assert (torch.linalg.cholesky_ex(found.reduced.hessian).info == 0).all()
    assert torch.isfinite(found.posterior_chol).all()
    assert (found.posterior_chol.diagonal(dim1=-2, dim2=-1) > 0.0).all()
    assert torch.isfinite(found.whitened_gradient).all()
    assert torch.allclose(found.posterior_chol[:3], smooth.posterior_chol, rtol=1e-12)
