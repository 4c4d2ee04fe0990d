"""The arrow-shaped normal equations against the same equations solved dense."""

from dataclasses import fields

import pytest
import torch
from torch import Tensor

from imr_torch.assimilate import NormalEquations, normal_equations
from imr_torch.assimilate.gauss_newton import Reduced, inverse_chol

SIZE = 3
EXPERIMENTS = 4
FRAMES = 7


def random(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


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
    rows = torch.zeros(EXPERIMENTS, FRAMES, SIZE + 3 * EXPERIMENTS, dtype=torch.float64)
    rows[..., :SIZE] = by_gel
    for e in range(EXPERIMENTS):
        rows[e, :, SIZE + 3 * e : SIZE + 3 * e + 3] = by_nuisance[e]
    matrix = rows.reshape(-1, rows.shape[-1])
    hessian = torch.eye(matrix.shape[1], dtype=torch.float64) + matrix.mT @ matrix
    return hessian, torch.cat((gel, nuisances.reshape(-1))) + matrix.mT @ residual.reshape(-1)


@pytest.mark.parametrize("seed", [0, 10, 20])
def test_that_elimination_gives_the_marginal_covariance_of_the_dense_system(seed: int) -> None:
    given = problem(seed=seed)
    equations = assembled(*given)
    hessian = equations.reduced.hessian
    covariance = torch.linalg.inv(dense(*given)[0])[:SIZE, :SIZE]
    torch.testing.assert_close(torch.linalg.inv(hessian), covariance, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(
        equations.posterior_chol @ equations.posterior_chol.mT, covariance, rtol=1e-10, atol=1e-12
    )
    assert torch.equal(equations.posterior_chol, torch.tril(equations.posterior_chol))


@pytest.mark.parametrize("seed", [0, 10, 20])
def test_that_the_step_is_the_dense_newton_step(seed: int) -> None:
    given = problem(seed=seed)
    hessian, gradient = dense(*given)
    expected = -torch.linalg.solve(hessian, gradient)
    gel, nuisances = assembled(*given).step
    torch.testing.assert_close(
        torch.cat((gel, nuisances.reshape(-1))), expected, rtol=1e-9, atol=1e-10
    )


def test_that_determinants_multiply_to_that_of_the_dense_system() -> None:
    given = problem()
    reduced = assembled(*given).reduced
    total = torch.logdet(reduced.hessian) + reduced.nuisance_log_det
    assert float(total) == pytest.approx(float(torch.logdet(dense(*given)[0])), rel=1e-12)


@pytest.mark.parametrize("seed", [0, 10, 20])
def test_that_the_whitened_gradient_is_the_newton_decrement_of_the_dense_system(seed: int) -> None:
    """``sqrt(g^T H^-1 g)`` over gel and nuisances: the length of the undamped step in posterior
    standard deviations.
    """
    given = problem(seed=seed)
    hessian, gradient = dense(*given)
    expected = (gradient @ torch.linalg.solve(hessian, gradient)).sqrt()
    assert float(assembled(*given).whitened_gradient) == pytest.approx(float(expected), rel=1e-10)


def test_that_the_whitened_gradient_sees_a_nuisance_that_has_not_arrived() -> None:
    """The gel at its conditional optimum and a nuisance away from its own: no minimum yet."""
    gel, _, by_gel, by_nuisance, _ = problem()
    still = torch.zeros(EXPERIMENTS, FRAMES, dtype=torch.float64)
    away = torch.zeros(EXPERIMENTS, 3, dtype=torch.float64)
    away[1, 2] = 2.0
    uncoupled = torch.zeros_like(by_gel)
    assert (
        float(assembled(0.0 * gel, 0.0 * away, uncoupled, by_nuisance, still).whitened_gradient)
        == 0.0
    )
    assert float(assembled(0.0 * gel, away, uncoupled, by_nuisance, still).whitened_gradient) > 0.1


def test_that_the_nuisances_follow_their_conditional_optimum() -> None:
    """The response is the derivative of the optimal ``w`` over ``v``, by solving for ``w`` at fixed ``v``."""
    given = problem()
    reduced = assembled(*given).reduced
    hessian, gradient = dense(*given)
    own = hessian[SIZE:, SIZE:]
    cross = hessian[SIZE:, :SIZE]
    step = -torch.linalg.solve(own, gradient[SIZE:]).reshape(EXPERIMENTS, 3)
    torch.testing.assert_close(reduced.nuisance_step, step, rtol=1e-10, atol=1e-10)
    response = -torch.linalg.solve(own, cross).reshape(EXPERIMENTS, 3, SIZE)
    torch.testing.assert_close(reduced.nuisance_response, response, rtol=1e-10, atol=1e-10)


def test_that_a_batch_is_its_members() -> None:
    given = problem(2, 5)
    batch = assembled(*given)
    for i, j in ((0, 0), (1, 4)):
        alone = assembled(*(x[i, j] for x in given))
        for part in fields(Reduced):
            member = getattr(batch.reduced, part.name)[i, j]
            torch.testing.assert_close(
                member, getattr(alone.reduced, part.name), rtol=1e-12, atol=1e-12
            )
        torch.testing.assert_close(batch.whitened_gradient[i, j], alone.whitened_gradient)
        torch.testing.assert_close(batch.posterior_chol[i, j], alone.posterior_chol)
    gel, nuisances = batch.step
    one = assembled(*(x[1, 4] for x in given)).step
    torch.testing.assert_close(gel[1, 4], one[0], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(nuisances[1, 4], one[1], rtol=1e-12, atol=1e-12)


def test_that_nuisances_without_effect_change_nothing() -> None:
    gel, nuisances, by_gel, by_nuisance, residual = problem()
    equations = assembled(
        gel, torch.zeros_like(nuisances), by_gel, torch.zeros_like(by_nuisance), residual
    ).reduced
    rows = by_gel.reshape(-1, SIZE)
    torch.testing.assert_close(
        equations.hessian, torch.eye(SIZE, dtype=torch.float64) + rows.mT @ rows
    )
    assert float(equations.nuisance_log_det) == 0.0
    assert float(equations.nuisance_step.abs().max()) == 0.0
    assert float(equations.nuisance_response.abs().max()) == 0.0


def test_that_the_inputs_are_not_changed() -> None:
    given = problem()
    copies = [x.clone() for x in given]
    assert len(assembled(*given).step) == 2
    for old, new in zip(copies, given, strict=True):
        torch.testing.assert_close(old, new, rtol=0.0, atol=0.0)


def test_that_sensitivities_of_any_size_leave_a_definite_hessian_and_a_factor_of_its_inverse() -> (
    None
):
    """At the edge of where bubbles can be simulated a slope may be 1e9 standard deviations, and rounding 1e18 times 1e-16."""
    gel, nuisances, by_gel, by_nuisance, residual = problem(6)
    by_gel[3:] *= 1e9
    by_nuisance[3:] = by_gel[
        3:
    ]  # a nuisance that moves the curve as the gel does: the elimination cancels
    found = assembled(gel, nuisances, by_gel, by_nuisance, residual)
    smooth = assembled(gel[:3], nuisances[:3], by_gel[:3], by_nuisance[:3], residual[:3])
    assert bool((torch.linalg.cholesky_ex(found.reduced.hessian).info == 0).all())
    assert bool(torch.isfinite(found.posterior_chol).all())
    assert bool((found.posterior_chol.diagonal(dim1=-2, dim2=-1) > 0.0).all())
    assert bool(torch.isfinite(found.whitened_gradient).all())
    assert torch.allclose(found.posterior_chol[:3], smooth.posterior_chol, rtol=1e-12)


def test_that_nuisances_that_move_a_curve_alike_and_very_far_can_be_eliminated() -> None:
    """Their own Hessian then has a row twice, and rounding takes the prior's 1 from its sum with 1e18."""
    gel, nuisances, by_gel, by_nuisance, residual = problem(6)
    by_nuisance[3:] = 1e9 * by_nuisance[3:, ..., :1]
    found = assembled(gel, nuisances, by_gel, by_nuisance, residual)
    smooth = assembled(gel[:3], nuisances[:3], by_gel[:3], by_nuisance[:3], residual[:3])
    assert bool((torch.linalg.cholesky_ex(found.nuisance_hessian).info == 0).all())
    for step in found.step:
        assert bool(torch.isfinite(step).all())
    assert bool(torch.isfinite(found.whitened_gradient).all())
    torch.testing.assert_close(
        found.nuisance_hessian[:3], smooth.nuisance_hessian, rtol=0.0, atol=0.0
    )


def test_that_the_factor_of_an_ill_conditioned_inverse_is_lower_and_right() -> None:
    slopes = random(1, 4, 4, seed=9) * torch.tensor([1e7, 1.0, 1.0, 1e-2], dtype=torch.float64)
    hessian = torch.eye(4, dtype=torch.float64) + slopes.mT @ slopes
    ways = [
        inverse_chol(hessian),
        inverse_chol(torch.cat((hessian, torch.diag(torch.tensor([1e30, 1.0, 1.0, 1e-30]))[None])))[
            :1
        ],
    ]
    for chol in ways:
        assert torch.equal(chol, chol.tril())
        assert torch.allclose(
            chol @ chol.mT @ hessian, torch.eye(4, dtype=torch.float64), atol=1e-6
        )
